"""Average precision of KITTI's object benchmark on the CPU: image, orientation, BEV and 3D.

Sources: Geiger et al., "Are we ready for Autonomous Driving?", CVPR 2012, and its development kit
(the figures here equal the kit's); Simonelli et al., "Disentangling Monocular 3D Object Detection",
ICCV 2019, for the 40 recall positions (R40) in addition to the original 11 (R11).

The kit samples the precision at 41 scores, one for each 1/40 of recall. With fewer than 41 objects
there are fewer scores, and the kit sets the precision at the remaining positions to 0: a perfect
detector then gets only 2.5 per object. Here the scores are placed at their true recall instead, and
a perfect detector gets 100 with any number of objects. `kit_sampling=True` gives the kit's figure.
Both are the same from 41 objects on.

A figure that cannot be computed is NaN, and None in `as_dict`: that of a category and level in
which no object counts (the kit prints 0), or in which no detection has a 2D box, and those in the
image for levels that need no image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.errors import DataError
from curate.evaluation.counts import Counts
from curate.evaluation.difficulties import KITTI, Difficulty
from curate.evaluation.kitti_matching import (
    Candidates,
    MatchInputs,
    PooledFrames,
    candidates_by_metric,
    count_at_thresholds,
    dont_care_shares,
    match_results,
    true_positive_scores,
)
from curate.evaluation.kitti_rules import COUNTED, MIN_OVERLAPS
from curate.evaluation.kitti_states import Rules
from curate.shapes import Float, Int

FIGURES = ("image", "aos", "bev", "3d")
"""The averaged figures: precision by 2D, BEV and 3D overlap; aos: orientation similarity by 2D."""

_POSITIONS = 41  # recall 0, 1/40, ..., 1
UNKNOWN_ALPHA = -10.0


@dataclass(frozen=True)
class KittiEvaluation:
    """The result of evaluating detections against labels; c categories, d levels of difficulty.

    Attributes:
        min_overlaps: the evaluated categories and the overlap that a true positive must exceed.
        difficulty: the levels; KITTI's are easy, moderate and hard.
        curves: (c, 4, d, 41) precision in [0, 1] by category, figure of `FIGURES`, level, and
            recall 0, 1/40, ..., 1. Each value is the best precision at this or a higher recall. NaN
            if it cannot be computed.
        objects: (c, d) int64 counted objects.
        recall_overlaps: (r,) 3D overlaps of `recall_3d`.
        recall_3d: (c, r, d) share of the counted objects that a detection of any score matches; NaN
            if it cannot be computed.
        has_orientation: whether all detections have an observation angle; aos needs it.
        counts: which objects of the ground truth count, and why the others do not.
        result_counts: the same for the detections.
    """

    min_overlaps: Mapping[str, float]
    difficulty: Difficulty
    curves: Float[np.ndarray, "c 4 d 41"]
    objects: Int[np.ndarray, "c d"]
    recall_overlaps: tuple[float, ...]
    recall_3d: Float[np.ndarray, "c r d"]
    has_orientation: bool
    counts: Counts
    result_counts: Counts

    @property
    def ap_r11(self) -> Float[np.ndarray, "c 4 d"]:
        """(c, 4, d) mean precision at recall 0, 0.1, ..., 1, in percent."""
        return _percent(self.curves[..., ::4])

    @property
    def ap_r40(self) -> Float[np.ndarray, "c 4 d"]:
        """(c, 4, d) mean precision at recall 1/40, 2/40, ..., 1, in percent."""
        return _percent(self.curves[..., 1:])

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON, in percent: `AP_R40` and `AP_R11` by category and figure.

        Each value is a list over the levels, with None for a value that cannot be computed. "image"
        is None for levels that need no image, "aos" also without orientations.
        """
        recalls = [f"{overlap:g}" for overlap in self.recall_overlaps]
        return {
            "AP_R40": self._by_figure(self.ap_r40),
            "AP_R11": self._by_figure(self.ap_r11),
            "thresholds": dict(self.min_overlaps),
            "difficulty": self.difficulty.kind,
            "difficulties": list(self.difficulty.levels),
            "limits": dict(zip(self.difficulty.levels, self.difficulty.limits(), strict=True)),
            "objects": dict(zip(self.min_overlaps, self.objects.tolist(), strict=True)),
            "recall_3d": {
                category: dict(zip(recalls, map(_known, (100 * table).tolist()), strict=True))
                for category, table in zip(self.min_overlaps, self.recall_3d, strict=True)
            },
            "counts": {"objects": self.counts.as_dict(), "results": self.result_counts.as_dict()},
        }

    def _by_figure(self, averages: np.ndarray) -> dict[str, dict[str, list[float | None] | None]]:
        return {
            category: {
                figure: _known(values) if self._is_measured(figure) else None
                for figure, values in zip(FIGURES, table, strict=True)
            }
            for category, table in zip(self.min_overlaps, averages.tolist(), strict=True)
        }

    def _is_measured(self, figure: str) -> bool:
        in_image = self.difficulty.in_image or figure not in ("image", "aos")
        return in_image and (figure != "aos" or self.has_orientation)


def evaluate(
    labels: Sequence[KittiObjects],
    results: Sequence[KittiObjects],
    *,
    min_overlaps: Mapping[str, float] = MIN_OVERLAPS,
    recall_overlaps: Sequence[float] = (0.3, 0.5, 0.7),
    kit_sampling: bool = False,
    difficulty: Difficulty = KITTI,
    points: Sequence[Int[np.ndarray, " n"]] | None = None,
) -> KittiEvaluation:
    """Return KITTI's average precision of detections: image, aos, BEV and 3D, R11 and R40.

    Sources: Geiger et al., CVPR 2012, and its development kit; Simonelli et al., ICCV 2019, for
    R40. `evaluate_folders` does the same for folders of text files.

    Args:
        labels: the objects of each frame.
        results: the detections of each frame, in the same order, with scores and 2D boxes.
        min_overlaps: the categories to evaluate, and the overlap that a true positive must exceed.
        recall_overlaps: 3D overlaps at which to compute the recall.
        kit_sampling: with fewer than 41 objects, sample the recall as KITTI's program does.
        difficulty: the levels of difficulty; those by points or distance need no 2D boxes.
        points: for levels by points, the LiDAR points in each object of each frame.

    Raises:
        DataError: if the numbers of frames differ, or a detection has no score.
        ConfigError: if the levels need points, and there are none.
    """
    check_frames(labels, results)
    pooled_labels, pooled_results = PooledFrames.of(labels), PooledFrames.of(results)
    rules = Rules.of(
        difficulty, min_overlaps, pooled_labels.objects, pooled_results.objects, points
    )
    match = _Match(pooled_labels, pooled_results, in_image=difficulty.in_image)
    shape = (len(min_overlaps), len(difficulty.levels))
    curves = np.full((shape[0], len(FIGURES), shape[1], _POSITIONS), np.nan)
    objects = np.zeros(shape, dtype=np.int64)
    recalls = np.full((shape[0], len(recall_overlaps), shape[1]), np.nan)
    for c, (category, min_overlap) in enumerate(min_overlaps.items()):
        for d in range(len(difficulty.levels)):
            states = rules.states(category, d)
            objects[c, d] = count = int(np.sum(states[0] == COUNTED))
            if count == 0 or rules.lacks_boxes(category, d):
                continue
            for metric in match.candidates:
                precision, similarity = match.curves(metric, *states, min_overlap)
                if not kit_sampling:
                    precision = _at_true_recall(precision, count)
                    similarity = _at_true_recall(similarity, count)
                curves[c, FIGURES.index(metric), d] = precision
                if metric == "image":
                    curves[c, FIGURES.index("aos"), d] = similarity
            recalls[c, :, d] = [
                match.recall_3d(*states[:2], overlap) for overlap in recall_overlaps
            ]
    has_orientation = bool(np.all(pooled_results.objects.alpha != UNKNOWN_ALPHA))
    return KittiEvaluation(
        dict(min_overlaps),
        difficulty,
        curves,
        objects,
        tuple(recall_overlaps),
        recalls,
        has_orientation,
        *rules.counts(),
    )


def check_frames(labels: Sequence[KittiObjects], results: Sequence[KittiObjects]) -> None:
    """Check that labels and results have the same number of frames and all results have scores.

    Raises:
        DataError: if the numbers of frames differ, or a detection has no score.
    """
    if len(labels) != len(results):
        raise DataError(
            f"{len(labels)} frames of labels, but {len(results)} frames of results: "
            f"pass one of each per frame, also for frames without objects"
        )
    for index, frame in enumerate(results):
        if np.isnan(frame.scores).any():
            raise DataError(
                f"results of frame {index}, object {int(np.argmax(np.isnan(frame.scores)))}: "
                f"no score; result lines need a 16th field"
            )


class _Match:
    """The overlapping pairs of all frames, and the counts over them."""

    def __init__(self, labels: PooledFrames, results: PooledFrames, *, in_image: bool) -> None:
        self.candidates = candidates_by_metric(labels, results, in_image=in_image)
        self._labels, self._results = labels.objects, results.objects
        self._dont_care = dont_care_shares(labels, results)
        self._gains = {
            metric: self._orientation_gains(pairs) if metric == "image" else np.zeros(len(pairs[1]))
            for metric, pairs in self.candidates.items()
        }

    def curves(
        self,
        metric: str,
        of_labels: np.ndarray,
        of_results: np.ndarray,
        spared: np.ndarray,
        min_overlap: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (41,) precision and (41,) orientation similarity at the kit's thresholds."""
        candidates = self.candidates[metric]
        inputs = MatchInputs(of_labels, of_results, self._results.scores, min_overlap)
        found = true_positive_scores(candidates, inputs)
        thresholds = score_thresholds(found, int(np.sum(of_labels == COUNTED)))
        # DontCare regions are 2D boxes, so they apply to the image metric only.
        in_dont_care = (self._dont_care > min_overlap) & (metric == "image")
        totals = count_at_thresholds(
            candidates, inputs, thresholds, in_dont_care | spared, self._gains[metric]
        )
        positives = np.maximum(totals[:, 0] + totals[:, 1], 1)
        return _running_maximum(totals[:, 0] / positives), _running_maximum(
            totals[:, 2] / positives
        )

    def recall_3d(self, of_labels: np.ndarray, of_results: np.ndarray, min_overlap: float) -> float:
        """Return the share of the counted objects that a detection of any score matches."""
        inputs = MatchInputs(of_labels, of_results, self._results.scores, min_overlap)
        matches = match_results(self.candidates["3d"], inputs, -np.inf)
        counted = of_labels == COUNTED
        found = counted & (matches >= 0)
        found[found] = of_results[matches[found]] == COUNTED
        return float(np.sum(found) / np.sum(counted))

    def _orientation_gains(self, pairs: Candidates) -> np.ndarray:
        """Return (pairs,) (1 + cos of the difference of the observation angles) / 2."""
        rows = np.repeat(np.arange(len(self._labels)), np.diff(pairs.starts))
        difference = self._labels.alpha[rows] - self._results.alpha[pairs.results]
        gains: np.ndarray = (1 + np.cos(difference)) / 2
        return gains


def score_thresholds(scores: Float[np.ndarray, " n"], count: int) -> Float[np.ndarray, " t"]:
    """Return the kit's score thresholds, at most 41: the score nearest to each 1/40 of recall.

    Args:
        scores: (n,) scores of the true positives.
        count: number of counted objects.

    Returns:
        (t,) descending.
    """
    scores = np.sort(scores)[::-1]
    chosen = []
    recall = 0.0
    for position, score in enumerate(scores):
        here = (position + 1) / count
        is_last = position == len(scores) - 1
        if not is_last and (position + 2) / count - recall < recall - here:
            continue
        chosen.append(score)
        recall += 1 / (_POSITIONS - 1)
    return np.array(chosen)


def _known(values: Sequence[float]) -> list[float | None]:
    """Return the values with None for NaN."""
    return [None if np.isnan(value) else value for value in values]


def _percent(precision: np.ndarray) -> np.ndarray:
    """Return the mean over the last axis in percent."""
    # The sum is multiplied before the division: a row of ones gives exactly 100.
    means: np.ndarray = 100 * np.sum(precision, axis=-1) / precision.shape[-1]
    return means


def _running_maximum(values: np.ndarray) -> np.ndarray:
    """Return (41,) the running maximum of (t,) values from the end, 0 after the last value."""
    curve = np.zeros(_POSITIONS)
    curve[: len(values)] = np.maximum.accumulate(values[::-1])[::-1]
    return curve


def _at_true_recall(curve: np.ndarray, count: int) -> np.ndarray:
    """Return the curve with its values at their true recall, if there are fewer than 41 objects.

    With so few objects, position k of the curve belongs to object k, not to recall k / 40.
    """
    if count >= _POSITIONS or count == 0:
        return curve
    # Position k of 40 needs ceil(k * count / 40) objects; the first of them is at index 0.
    needed = -(-np.arange(_POSITIONS) * count // (_POSITIONS - 1))
    return curve[np.maximum(needed - 1, 0)]
