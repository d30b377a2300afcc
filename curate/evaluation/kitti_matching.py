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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np
from numba import njit

from curate.datasets.kitti.labels import DONT_CARE, KittiObjects
from curate.evaluation.kitti_rules import COUNTED
from curate.geometry.overlap import overlapping_pairs, pairs_within_groups
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
        by_score: whether a label takes the free result with the highest score, not that with the
            greatest overlap.
    """

    label_states: np.ndarray
    result_states: np.ndarray
    scores: np.ndarray
    min_overlap: float
    by_score: bool = False


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
    parts = [
        (rows, columns, common / (areas_a + areas_b - common))
        for rows, columns, common, areas_a, areas_b in _common_pixels(labels, results)
    ]
    rows, columns, overlaps = (np.concatenate(column) for column in zip(*parts, strict=True))
    return {"image": _by_label(count, rows, columns, overlaps), **found}


def dont_care_shares(labels: PooledFrames, results: PooledFrames) -> Float[np.ndarray, " results"]:
    """Return (results,) the largest share of each 2D box that lies in one DontCare region."""
    regions = labels.select(labels.objects.categories == DONT_CARE)
    shares = np.zeros(len(results.objects))
    for _, columns, common, _, areas in _common_pixels(regions, results):
        np.maximum.at(shares, columns, common / areas)
    return shares


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


def _common_pixels(
    a: PooledFrames, b: PooledFrames
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the pairs of 2D boxes that intersect within a frame, in blocks, ascending by row.

    Each block has the row in a, the row in b, the area of the intersection, and those of both
    boxes.
    """
    boxes_a, boxes_b = a.objects.boxes_2d, b.objects.boxes_2d
    areas_a, areas_b = (
        np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) for boxes in (boxes_a, boxes_b)
    )
    for rows, columns in pairs_within_groups(a.starts, b.starts):
        of_a, of_b = boxes_a[rows], boxes_b[columns]
        sides = np.minimum(of_a[:, 2:], of_b[:, 2:]) - np.maximum(of_a[:, :2], of_b[:, :2])
        common = np.flatnonzero((sides > 0).all(axis=1))
        in_a, in_b = rows[common], columns[common]
        yield in_a, in_b, np.prod(sides[common], axis=1), areas_a[in_a], areas_b[in_b]


def true_positive_scores(
    candidates: Candidates, inputs: MatchInputs
) -> Float[np.ndarray, " true_positives"]:
    """Return the scores of the true positives, in the order of the labels.

    Here each label takes the free result with the highest score. KITTI uses this matching to choose
    the score thresholds; it counts with `match_results`.
    """
    matches = match_results(candidates, inputs._replace(by_score=True), -np.inf)
    found = matches[(matches >= 0) & (inputs.label_states == COUNTED)]
    scores: np.ndarray = inputs.scores[found[inputs.result_states[found] == COUNTED]]
    return scores


def match_results(
    candidates: Candidates, inputs: MatchInputs, threshold: float
) -> Int[np.ndarray, " labels"]:
    """Return (labels,) int64 row of the result that each label takes, -1 for none.

    The labels choose one after the other among the results that are still free and have a score of
    at least `threshold`. A label takes the counted result with the greatest overlap, or the first
    ignored result if no counted one overlaps enough.
    """
    taken = np.empty(len(inputs.scores), dtype=bool)
    matches = np.empty(len(inputs.label_states), dtype=np.int64)
    fill_matches(candidates, inputs, threshold, taken, matches)
    return matches


# The kernels write into arrays that the caller has made: the compilation of np.zeros and its like
# would take longer than that of the loops.
@njit(cache=True, nogil=True)
def fill_matches(
    candidates: Candidates,
    inputs: MatchInputs,
    threshold: float,
    taken: np.ndarray,
    matches: np.ndarray,
) -> None:
    """Write the matches of `match_results`; `taken` (results,) bool has any content before."""
    for row in range(len(taken)):
        taken[row] = False
    for label in range(len(inputs.label_states)):
        matches[label] = -1
        best, best_overlap = -1, 0.0
        for pair in range(candidates.starts[label], candidates.starts[label + 1]):
            row, overlap = candidates.results[pair], candidates.overlaps[pair]
            state = inputs.result_states[row]
            absent = inputs.label_states[label] < 0 or overlap <= inputs.min_overlap
            if absent or taken[row] or inputs.scores[row] < threshold:
                continue
            if inputs.by_score:
                if state >= 0 and (best < 0 or inputs.scores[row] > inputs.scores[best]):
                    best = row
            elif state == 0 and overlap > best_overlap:
                best, best_overlap = row, overlap
            elif state == 1 and best < 0:
                best = row
        if best >= 0:
            taken[best] = True
            matches[label] = best


def count_at_thresholds(
    candidates: Candidates,
    inputs: MatchInputs,
    thresholds: np.ndarray,
    in_dont_care: np.ndarray,
    orientation_gains: np.ndarray,
) -> Float[np.ndarray, "t 3"]:
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
    taken = np.empty(len(inputs.scores), dtype=bool)
    matches = np.empty(len(inputs.label_states), dtype=np.int64)
    work = (taken, matches)
    add_counts(candidates, inputs, thresholds, in_dont_care, orientation_gains, work, totals)
    return totals


@njit(cache=True, nogil=True)
def add_counts(
    candidates: Candidates,
    inputs: MatchInputs,
    thresholds: np.ndarray,
    in_dont_care: np.ndarray,
    orientation_gains: np.ndarray,
    work: tuple[np.ndarray, np.ndarray],
    totals: np.ndarray,
) -> None:
    """Add the counts of `count_at_thresholds` to (t, 3) totals."""
    taken, matches = work
    for position in range(len(thresholds)):
        fill_matches(candidates, inputs, thresholds[position], taken, matches)
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
