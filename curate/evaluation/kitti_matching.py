"""Matching of detections to labelled objects by KITTI's rules, over all frames at once.

Only pairs that overlap are ever looked at: they are found once, and every category, difficulty and
score threshold visits the same list. Source: the KITTI object development kit's evaluation program.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np
from numba import njit

from curate.datasets.kitti.labels import DONT_CARE, KittiObjects
from curate.geometry.overlap import overlapping_pairs
from curate.shapes import Bool, Float, Int

METRICS = ("image", "bev", "3d")


@dataclass(frozen=True)
class PooledFrames:
    """The objects of many frames in one array each.

    Attributes:
        objects: all objects, frame by frame.
        starts: (frames + 1,) int64; frame f is objects starts[f] to starts[f + 1].
    """

    objects: KittiObjects
    starts: Int[np.ndarray, " frames_plus_1"]

    @classmethod
    def of(cls, frames: Sequence[KittiObjects]) -> Self:
        """Return the frames, in their order."""
        starts = np.zeros(len(frames) + 1, dtype=np.int64)
        np.cumsum([len(frame) for frame in frames], out=starts[1:])
        whole = [KittiObjects.empty(), *frames]
        columns = (
            np.concatenate([getattr(frame, field.name) for frame in whole])
            for field in fields(KittiObjects)
        )
        return cls(KittiObjects(*columns), starts)

    def select(self, keep: Bool[np.ndarray, " n"]) -> Self:
        """Return the frames with only the objects in the mask `keep`."""
        kept_before = np.concatenate([[0], np.cumsum(keep)])
        return type(self)(self.objects.select(keep), kept_before[self.starts])


class Candidates(NamedTuple):
    """Overlapping pairs: those of label i are starts[i] to starts[i + 1], ascending by result.

    Attributes:
        starts: (labels + 1,) int64.
        results: (pairs,) int64 row of the result.
        overlaps: (pairs,) float64 in (0, 1].
    """

    starts: np.ndarray
    results: np.ndarray
    overlaps: np.ndarray


class Contest(NamedTuple):
    """What decides the matching for one category, difficulty and metric.

    Attributes:
        label_states: (labels,) int8, see `kitti_rules`.
        result_states: (results,) int8.
        scores: (results,) float64.
        min_overlap: a pair must overlap more than this.
    """

    label_states: np.ndarray
    result_states: np.ndarray
    scores: np.ndarray
    min_overlap: float


def candidates_by_metric(labels: PooledFrames, results: PooledFrames) -> dict[str, Candidates]:
    """Return the overlapping pairs within frames, per metric."""
    count = len(labels.objects)
    on_image = _image_pairs(
        labels.objects.boxes_2d, labels.starts, results.objects.boxes_2d, results.starts
    )
    rows, columns, bev, volumes = overlapping_pairs(
        camera_boxes(labels.objects), labels.starts, camera_boxes(results.objects), results.starts
    )
    return {
        "image": _by_label(count, *on_image),
        "bev": _by_label(count, rows, columns, bev),
        "3d": _by_label(count, rows, columns, volumes),
    }


def dont_care_shares(labels: PooledFrames, results: PooledFrames) -> Float[np.ndarray, " results"]:
    """(results,) largest share of each detection's 2D box that lies in one DontCare region."""
    regions = labels.select(labels.objects.categories == DONT_CARE)
    return _covered_shares(
        regions.objects.boxes_2d, regions.starts, results.objects.boxes_2d, results.starts
    )


def camera_boxes(objects: KittiObjects) -> Float[np.ndarray, "n 7"]:
    """Return (n, 7) centre boxes in a frame with x to the right, y forward and z up, in metres.

    The camera's frame turned by 90 degrees, not the LiDAR frame: overlaps need no calibration.
    Seen from above, rotation_y turns clockwise.
    """
    x, y, z = objects.locations.T
    height, width, length = objects.dimensions.T
    return np.stack([x, z, height / 2 - y, length, width, height, -objects.rotations_y], axis=1)


def _by_label(
    count: int, rows: np.ndarray, columns: np.ndarray, overlaps: np.ndarray
) -> Candidates:
    """Pairs that ascend by row, as `Candidates`; pairs without overlap are left out."""
    real = overlaps > 0
    starts = np.searchsorted(rows[real], np.arange(count + 1))
    return Candidates(starts, columns[real], overlaps[real])


@njit(cache=True, nogil=True)
def _common_pixels(a: np.ndarray, i: int, b: np.ndarray, j: int) -> float:
    """Area that two 2D boxes (left, top, right, bottom) share."""
    width = min(a[i, 2], b[j, 2]) - max(a[i, 0], b[j, 0])
    height = min(a[i, 3], b[j, 3]) - max(a[i, 1], b[j, 1])
    return width * height if width > 0 and height > 0 else 0.0


@njit(cache=True, nogil=True)
def _pixels(boxes: np.ndarray, i: int) -> float:
    """Area of a 2D box."""
    return float((boxes[i, 2] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 1]))


@njit(cache=True, nogil=True)
def _image_pairs(
    a: np.ndarray, starts_a: np.ndarray, b: np.ndarray, starts_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row in a, row in b and IoU of the 2D boxes that overlap within a frame, ascending."""
    rows_a, rows_b = [0 for _ in range(0)], [0 for _ in range(0)]  # typed by their elements
    overlaps = [0.0 for _ in range(0)]
    for frame in range(len(starts_a) - 1):
        for i in range(starts_a[frame], starts_a[frame + 1]):
            for j in range(starts_b[frame], starts_b[frame + 1]):
                common = _common_pixels(a, i, b, j)
                if common > 0:
                    rows_a.append(i)
                    rows_b.append(j)
                    overlaps.append(common / (_pixels(a, i) + _pixels(b, j) - common))
    return np.array(rows_a), np.array(rows_b), np.array(overlaps)


@njit(cache=True, nogil=True)
def _covered_shares(
    regions: np.ndarray, region_starts: np.ndarray, boxes: np.ndarray, starts: np.ndarray
) -> np.ndarray:
    """Return the kernel of `dont_care_shares`."""
    shares = np.zeros(len(boxes))
    for frame in range(len(starts) - 1):
        for j in range(starts[frame], starts[frame + 1]):
            for i in range(region_starts[frame], region_starts[frame + 1]):
                common = _common_pixels(regions, i, boxes, j)
                if common > 0:
                    shares[j] = max(shares[j], common / _pixels(boxes, j))
    return shares


@njit(cache=True, nogil=True)
def scores_of_found(candidates: Candidates, contest: Contest) -> np.ndarray:
    """Scores of the counted detections that find a counted object, in the order of the objects.

    Here each object takes the free detection with the highest score: KITTI's way of choosing the
    score thresholds, not of counting.
    """
    taken = np.zeros(len(contest.scores), np.bool_)
    found = np.empty(len(contest.label_states))
    number = 0
    for label in range(len(contest.label_states)):
        if contest.label_states[label] < 0:
            continue
        best = -1
        for pair in range(candidates.starts[label], candidates.starts[label + 1]):
            row = candidates.results[pair]
            if (
                candidates.overlaps[pair] > contest.min_overlap
                and contest.result_states[row] >= 0
                and not taken[row]
                and (best < 0 or contest.scores[row] > contest.scores[best])
            ):
                best = row
        if best >= 0:
            taken[best] = True
            if contest.label_states[label] == 0 and contest.result_states[best] == 0:
                found[number] = contest.scores[best]
                number += 1
    return found[:number]


@njit(cache=True, nogil=True)
def match_results(candidates: Candidates, contest: Contest, threshold: float) -> np.ndarray:
    """Return (labels,) int64 row of the detection that each object takes, -1 where none.

    Objects choose in the order of the labels, among the free detections with a score of at least
    `threshold`: the counted one with the greatest overlap, else the first ignored one.
    """
    taken = np.zeros(len(contest.scores), np.bool_)
    matches = np.full(len(contest.label_states), -1)
    for label in range(len(contest.label_states)):
        if contest.label_states[label] < 0:
            continue
        best, best_overlap = -1, 0.0
        for pair in range(candidates.starts[label], candidates.starts[label + 1]):
            row, overlap = candidates.results[pair], candidates.overlaps[pair]
            if overlap <= contest.min_overlap or taken[row] or contest.scores[row] < threshold:
                continue
            if contest.result_states[row] == 0 and overlap > best_overlap:
                best, best_overlap = row, overlap
            elif contest.result_states[row] == 1 and best < 0:
                best = row
        if best >= 0:
            taken[best] = True
            matches[label] = best
    return matches


@njit(cache=True, nogil=True)
def tally(
    candidates: Candidates,
    contest: Contest,
    thresholds: np.ndarray,
    in_dont_care: np.ndarray,
    orientation_gains: np.ndarray,
) -> np.ndarray:
    """Count at each score threshold.

    Args:
        candidates: overlapping pairs.
        contest: who takes part.
        thresholds: (t,) scores.
        in_dont_care: (results,) bool; such a detection is no false positive.
        orientation_gains: (pairs,) what a true positive adds to the orientation similarity.

    Returns:
        (t, 3) true positives, false positives, sum of the orientation gains.
    """
    totals = np.zeros((len(thresholds), 3))
    for position in range(len(thresholds)):
        matches = match_results(candidates, contest, thresholds[position])
        for row in range(len(contest.scores)):
            if (
                contest.result_states[row] == 0
                and not in_dont_care[row]
                and contest.scores[row] >= thresholds[position]
            ):
                totals[position, 1] += 1
        for label in range(len(matches)):
            row = matches[label]
            if row < 0 or contest.result_states[row] != 0:
                continue
            if not in_dont_care[row]:
                totals[position, 1] -= 1
            if contest.label_states[label] == 0:
                totals[position, 0] += 1
                for pair in range(candidates.starts[label], candidates.starts[label + 1]):
                    if candidates.results[pair] == row:
                        totals[position, 2] += orientation_gains[pair]
    return totals
