"""Match detections ("results") to labeled objects ("labels") by KITTI's rules, for all frames.

The overlapping pairs are computed once. Every category, difficulty and score threshold then walks
through the same list of pairs. Source: the evaluation program of KITTI's object development kit.

Example: Car, IoU above 0.7, score threshold 0.5. One frame has the labels A (Car), B (Car) and
C (Van, a neighbour category) and the results 0 to 3, all of them Car.

    label  state    overlaps with                               takes   outcome
    A      COUNTED  0 (IoU 0.75, score 0.9), 1 (0.80, 0.8)      1       true positive
    B      COUNTED  3 (IoU 0.85, score 0.4)                     none    missed: 3 is below 0.5
    C      IGNORED  2 (IoU 0.90, score 0.6)                     2       2 is ignored

The pairs are stored by label: starts [0, 2, 3, 4], results [0, 1, 3, 2], overlaps [0.75, 0.80,
0.85, 0.90]. `match_results` returns [1, -1, 2]: A takes 1, which has the greatest IoU, although 0
has a higher score. Result 0 then has no label left: it is a false positive. Result 3 takes no part.
`count_at_thresholds` counts 1 TP and 1 FP at 0.5, and 2 TP and 1 FP at 0.4, where B takes 3.
`true_positive_scores` returns [0.9, 0.4]: there A takes 0, which has the highest score.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np
from numba import njit

from curate.datasets.kitti.labels import DONT_CARE, KittiObjects
from curate.geometry.overlap import overlapping_pairs
from curate.shapes import Bool, Float, Int, Shaped

METRICS = ("image", "bev", "3d")


@dataclass(frozen=True)
class PooledFrames:
    """The objects of many frames, concatenated.

    Attributes:
        objects: all objects, frame by frame.
        starts: (frames + 1,) int64; frame f has the objects starts[f] to starts[f + 1] - 1.
    """

    objects: KittiObjects
    starts: Int[np.ndarray, " frames_plus_1"]

    @classmethod
    def of(cls, frames: Sequence[KittiObjects]) -> Self:
        """Concatenate the objects of the frames, in the given order."""
        starts = np.zeros(len(frames) + 1, dtype=np.int64)
        np.cumsum([len(frame) for frame in frames], out=starts[1:])
        parts = [KittiObjects.empty(), *frames]
        columns = (
            np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(KittiObjects)
        )
        return cls(KittiObjects(*columns), starts)

    def select(self, keep: Bool[np.ndarray, " n"]) -> Self:
        """Return the frames with only the objects in the mask `keep`."""
        kept_before = np.concatenate([[0], np.cumsum(keep)])
        return type(self)(self.objects.select(keep), kept_before[self.starts])


class Candidates(NamedTuple):
    """Overlapping pairs; label i has the pairs starts[i] to starts[i + 1] - 1, by ascending result.

    Attributes:
        starts: (labels + 1,) int64.
        results: (pairs,) int64 row of the result of each pair.
        overlaps: (pairs,) float64 in (0, 1].
    """

    starts: np.ndarray
    results: np.ndarray
    overlaps: np.ndarray


class MatchInputs(NamedTuple):
    """The inputs of the matching for one category and difficulty.

    Attributes:
        label_states: (labels,) int8 COUNTED, IGNORED or ABSENT, see `kitti_rules`.
        result_states: (results,) int8, as for the labels.
        scores: (results,) float64.
        min_overlap: only pairs with an overlap above this can match.
    """

    label_states: np.ndarray
    result_states: np.ndarray
    scores: np.ndarray
    min_overlap: float


def candidates_by_metric(
    labels: PooledFrames, results: PooledFrames, *, in_image: bool = True
) -> dict[str, Candidates]:
    """Return the pairs that overlap within a frame, for each metric of `METRICS`.

    Args:
        labels: the objects.
        results: the detections.
        in_image: whether to include the metric "image", which needs 2D boxes.
    """
    count = len(labels.objects)
    rows, columns, bev, volumes = overlapping_pairs(
        camera_boxes(labels.objects), labels.starts, camera_boxes(results.objects), results.starts
    )
    found = {
        "bev": _by_label(count, rows, columns, bev),
        "3d": _by_label(count, rows, columns, volumes),
    }
    if not in_image:
        return found
    on_image = _image_pairs(
        labels.objects.boxes_2d, labels.starts, results.objects.boxes_2d, results.starts
    )
    return {"image": _by_label(count, *on_image), **found}


def dont_care_shares(labels: PooledFrames, results: PooledFrames) -> Float[np.ndarray, " results"]:
    """Return (results,) the largest share of each 2D box that lies in one DontCare region."""
    regions = labels.select(labels.objects.categories == DONT_CARE)
    return _covered_shares(
        regions.objects.boxes_2d, regions.starts, results.objects.boxes_2d, results.starts
    )


def camera_boxes(objects: KittiObjects) -> Float[np.ndarray, "n 7"]:
    """Return (n, 7) boxes at their centre in a frame with x right, y forward and z up, in metres.

    This is the camera frame turned by 90 degrees, not the LiDAR frame, because overlaps need no
    calibration. The yaw is -rotation_y: seen from above, rotation_y turns clockwise.
    """
    x, y, z = objects.locations.T
    height, width, length = objects.dimensions.T
    return np.stack([x, z, height / 2 - y, length, width, height, -objects.rotations_y], axis=1)


def objects_in_lidar_frame(
    boxes: Float[np.ndarray, "n 7"],
    categories: Shaped[np.ndarray, " n"],
    scores: Float[np.ndarray, " n"] | None = None,
) -> KittiObjects:
    """Return boxes as KITTI objects of a camera at the LiDAR's origin that looks along x.

    This frame has the LiDAR's axes: overlaps and distances are those in the LiDAR frame. The
    objects have no 2D box, occlusion or truncation.

    Args:
        boxes: (n, 7) in the LiDAR frame; NaN for DontCare regions, which get no extent.
        categories: (n,) category of each.
        scores: (n,) score of each; None for ground truth.
    """
    x, y, z, length, width, height, yaw = np.nan_to_num(boxes, nan=0.0).T
    unknown = np.zeros(len(boxes))
    return KittiObjects(
        categories,
        unknown,
        unknown.astype(np.int64),
        unknown,
        np.zeros((len(boxes), 4)),
        np.stack([height, width, length], axis=1),
        np.stack([-y, height / 2 - z, x], axis=1),
        -yaw - np.pi / 2,
        np.full(len(boxes), np.nan) if scores is None else scores,
    )


def _by_label(
    count: int, rows: np.ndarray, columns: np.ndarray, overlaps: np.ndarray
) -> Candidates:
    """Return pairs sorted by row as `Candidates`, without those that do not overlap."""
    overlapping = overlaps > 0
    starts = np.searchsorted(rows[overlapping], np.arange(count + 1))
    return Candidates(starts, columns[overlapping], overlaps[overlapping])


@njit(cache=True, nogil=True)
def _common_pixels(a: np.ndarray, i: int, b: np.ndarray, j: int) -> float:
    """Return the intersection area of two 2D boxes (left, top, right, bottom)."""
    width = min(a[i, 2], b[j, 2]) - max(a[i, 0], b[j, 0])
    height = min(a[i, 3], b[j, 3]) - max(a[i, 1], b[j, 1])
    return width * height if width > 0 and height > 0 else 0.0


@njit(cache=True, nogil=True)
def _pixels(boxes: np.ndarray, i: int) -> float:
    """Return the area of a 2D box."""
    return float((boxes[i, 2] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 1]))


@njit(cache=True, nogil=True)
def _image_pairs(
    a: np.ndarray, starts_a: np.ndarray, b: np.ndarray, starts_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return row in a, row in b and IoU of the 2D boxes that overlap in a frame, in this order."""
    # numba infers the type of an empty list from the elements of the comprehension.
    rows_a, rows_b = [0 for _ in range(0)], [0 for _ in range(0)]
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
    """Return the largest share of each box that lies in one region of its frame."""
    shares = np.zeros(len(boxes))
    for frame in range(len(starts) - 1):
        for j in range(starts[frame], starts[frame + 1]):
            for i in range(region_starts[frame], region_starts[frame + 1]):
                common = _common_pixels(regions, i, boxes, j)
                if common > 0:
                    shares[j] = max(shares[j], common / _pixels(boxes, j))
    return shares


@njit(cache=True, nogil=True)
def true_positive_scores(candidates: Candidates, inputs: MatchInputs) -> np.ndarray:
    """Return the scores of the true positives, in the order of the labels.

    Here each label takes the free result with the highest score. KITTI uses this matching to choose
    the score thresholds; it counts with `match_results`.
    """
    taken = np.zeros(len(inputs.scores), np.bool_)
    found = np.empty(len(inputs.label_states))
    number = 0
    for label in range(len(inputs.label_states)):
        if inputs.label_states[label] < 0:
            continue
        best = -1
        for pair in range(candidates.starts[label], candidates.starts[label + 1]):
            row = candidates.results[pair]
            if (
                candidates.overlaps[pair] > inputs.min_overlap
                and inputs.result_states[row] >= 0
                and not taken[row]
                and (best < 0 or inputs.scores[row] > inputs.scores[best])
            ):
                best = row
        if best >= 0:
            taken[best] = True
            if inputs.label_states[label] == 0 and inputs.result_states[best] == 0:
                found[number] = inputs.scores[best]
                number += 1
    return found[:number]


@njit(cache=True, nogil=True)
def match_results(candidates: Candidates, inputs: MatchInputs, threshold: float) -> np.ndarray:
    """Return (labels,) int64 row of the result that each label takes, -1 for none.

    The labels choose one after the other among the results that are still free and have a score of
    at least `threshold`. A label takes the counted result with the greatest overlap, or the first
    ignored result if no counted one overlaps enough.
    """
    taken = np.zeros(len(inputs.scores), np.bool_)
    matches = np.full(len(inputs.label_states), -1)
    for label in range(len(inputs.label_states)):
        if inputs.label_states[label] < 0:
            continue
        best, best_overlap = -1, 0.0
        for pair in range(candidates.starts[label], candidates.starts[label + 1]):
            row, overlap = candidates.results[pair], candidates.overlaps[pair]
            if overlap <= inputs.min_overlap or taken[row] or inputs.scores[row] < threshold:
                continue
            if inputs.result_states[row] == 0 and overlap > best_overlap:
                best, best_overlap = row, overlap
            elif inputs.result_states[row] == 1 and best < 0:
                best = row
        if best >= 0:
            taken[best] = True
            matches[label] = best
    return matches


@njit(cache=True, nogil=True)
def count_at_thresholds(
    candidates: Candidates,
    inputs: MatchInputs,
    thresholds: np.ndarray,
    in_dont_care: np.ndarray,
    orientation_gains: np.ndarray,
) -> np.ndarray:
    """Count true and false positives at each score threshold.

    Args:
        candidates: overlapping pairs.
        inputs: states, scores and minimum overlap.
        thresholds: (t,) scores.
        in_dont_care: (results,) bool; these results are not false positives.
        orientation_gains: (pairs,) what a true positive adds to the orientation similarity.

    Returns:
        (t, 3) true positives, false positives, sum of the orientation gains.
    """
    totals = np.zeros((len(thresholds), 3))
    for position in range(len(thresholds)):
        matches = match_results(candidates, inputs, thresholds[position])
        for row in range(len(inputs.scores)):
            if (
                inputs.result_states[row] == 0
                and not in_dont_care[row]
                and inputs.scores[row] >= thresholds[position]
            ):
                totals[position, 1] += 1
        for label in range(len(matches)):
            row = matches[label]
            if row < 0 or inputs.result_states[row] != 0:
                continue
            if not in_dont_care[row]:
                totals[position, 1] -= 1
            if inputs.label_states[label] == 0:
                totals[position, 0] += 1
                for pair in range(candidates.starts[label], candidates.starts[label + 1]):
                    if candidates.results[pair] == row:
                        totals[position, 2] += orientation_gains[pair]
    return totals
