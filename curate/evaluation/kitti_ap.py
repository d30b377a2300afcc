"""Average precision of KITTI's object benchmark on the CPU: image, orientation, BEV and 3D.

Sources: Geiger et al., "Are we ready for Autonomous Driving?", CVPR 2012, and its development kit,
whose figures this reproduces; Simonelli et al., "Disentangling Monocular 3D Object Detection", ICCV
2019, for the 40 recall positions (R40) beside the original 11 (R11).

The kit samples precision at 41 scores, one per 1/40 of recall. With fewer than 41 objects there are
not that many scores, and it leaves the positions behind the last one at 0: a perfect detector gets
2.5 per object. Here those few scores are read at their true recall, so that perfection is 100 from
the first object on; `kit_sampling=True` gives the kit's own figure. From 41 objects on both agree.
Without objects the average precision is 0, as in the kit; `objects` tells the two cases apart.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.errors import DataError
from curate.evaluation.kitti_matching import (
    Candidates,
    Contest,
    PooledFrames,
    candidates_by_metric,
    dont_care_shares,
    match_results,
    scores_of_found,
    tally,
)
from curate.evaluation.kitti_rules import (
    COUNTED,
    DIFFICULTIES,
    MIN_OVERLAPS,
    label_states,
    result_states,
)
from curate.shapes import Float, Int

FIGURES = ("image", "aos", "bev", "3d")
"""What is averaged: precision by 2D, BEV and 3D overlap; "aos", orientation similarity by 2D."""

_POSITIONS = 41  # recall 0, 1/40, ..., 1
_UNKNOWN_ALPHA = -10.0


@dataclass(frozen=True)
class KittiEvaluation:
    """Detections compared with labels; c categories, 3 difficulties.

    Attributes:
        min_overlaps: the evaluated categories and the overlap that finds one.
        curves: (c, 4, 3, 41) precision in [0, 1] by category, figure of `FIGURES`, difficulty, and
            recall 0, 1/40, ..., 1; at each recall the best precision from there on.
        objects: (c, 3) int64 counted objects.
        recall_overlaps: (r,) 3D overlaps of `recall_3d`.
        recall_3d: (c, r, 3) share of the objects that any detection finds, whatever its score.
        has_orientation: whether all detections have an observation angle; if not, no aos.
    """

    min_overlaps: Mapping[str, float]
    curves: Float[np.ndarray, "c 4 3 41"]
    objects: Int[np.ndarray, "c 3"]
    recall_overlaps: tuple[float, ...]
    recall_3d: Float[np.ndarray, "c r 3"]
    has_orientation: bool

    @property
    def ap_r11(self) -> Float[np.ndarray, "c 4 3"]:
        """(c, 4, 3) mean over recall 0, 0.1, ..., 1, in percent."""
        return _percent(self.curves[..., ::4])

    @property
    def ap_r40(self) -> Float[np.ndarray, "c 4 3"]:
        """(c, 4, 3) mean over recall 1/40, 2/40, ..., 1, in percent."""
        return _percent(self.curves[..., 1:])

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON, in percent: `AP_R40` and `AP_R11` by category and figure.

        Each is a list over the difficulties; "aos" is None where there is no orientation.
        """
        recalls = [f"{overlap:g}" for overlap in self.recall_overlaps]
        return {
            "AP_R40": self._by_figure(self.ap_r40),
            "AP_R11": self._by_figure(self.ap_r11),
            "thresholds": dict(self.min_overlaps),
            "difficulties": list(DIFFICULTIES),
            "objects": dict(zip(self.min_overlaps, self.objects.tolist(), strict=True)),
            "recall_3d": {
                category: dict(zip(recalls, (100 * table).tolist(), strict=True))
                for category, table in zip(self.min_overlaps, self.recall_3d, strict=True)
            },
        }

    def _by_figure(self, averages: np.ndarray) -> dict[str, dict[str, list[float] | None]]:
        return {
            category: {
                figure: None if figure == "aos" and not self.has_orientation else values
                for figure, values in zip(FIGURES, table, strict=True)
            }
            for category, table in zip(self.min_overlaps, averages.tolist(), strict=True)
        }


def evaluate(
    labels: Sequence[KittiObjects],
    results: Sequence[KittiObjects],
    *,
    min_overlaps: Mapping[str, float] = MIN_OVERLAPS,
    recall_overlaps: Sequence[float] = (0.3, 0.5, 0.7),
    kit_sampling: bool = False,
) -> KittiEvaluation:
    """Return KITTI's average precision of detections: image, aos, BEV and 3D, R11 and R40.

    Sources: Geiger et al., CVPR 2012, and its development kit; Simonelli et al., ICCV 2019, for
    R40. `evaluate_folders` does the same for folders of text files.

    Args:
        labels: the objects of each frame.
        results: the detections of each frame, in the same order; they need scores and 2D boxes.
        min_overlaps: the categories to evaluate, and the overlap that a detection must exceed.
        recall_overlaps: 3D overlaps at which the recall is given.
        kit_sampling: for fewer than 41 objects, sample recall as KITTI's program does.

    Raises:
        DataError: if the numbers of frames differ, or a detection has no score.
    """
    check_frames(labels, results)
    pooled_labels, pooled_results = PooledFrames.of(labels), PooledFrames.of(results)
    match = _Match(pooled_labels, pooled_results)
    shape = (len(min_overlaps), len(DIFFICULTIES))
    curves = np.zeros((shape[0], len(FIGURES), shape[1], _POSITIONS))
    objects = np.zeros(shape, dtype=np.int64)
    recalls = np.zeros((shape[0], len(recall_overlaps), shape[1]))
    for c, (category, min_overlap) in enumerate(min_overlaps.items()):
        for d in range(len(DIFFICULTIES)):
            states = match.states(category, d)
            objects[c, d] = count = int(np.sum(states[0] == COUNTED))
            for metric in match.candidates:
                precision, similarity = match.curves(metric, *states, min_overlap)
                if not kit_sampling:
                    precision = _at_true_recall(precision, count)
                    similarity = _at_true_recall(similarity, count)
                curves[c, FIGURES.index(metric), d] = precision
                if metric == "image":
                    curves[c, FIGURES.index("aos"), d] = similarity
            recalls[c, :, d] = [match.recall_3d(*states, overlap) for overlap in recall_overlaps]
    has_orientation = bool(np.all(pooled_results.objects.alpha != _UNKNOWN_ALPHA))
    return KittiEvaluation(
        dict(min_overlaps), curves, objects, tuple(recall_overlaps), recalls, has_orientation
    )


def check_frames(labels: Sequence[KittiObjects], results: Sequence[KittiObjects]) -> None:
    """Raise `DataError` unless there are as many results as labels and all have scores."""
    if len(labels) != len(results):
        raise DataError(
            f"labels of {len(labels)} frames cannot be compared with results of {len(results)}: "
            f"give one of each per frame, empty ones included"
        )
    for index, frame in enumerate(results):
        if np.isnan(frame.scores).any():
            raise DataError(
                f"results of frame {index}, object {int(np.argmax(np.isnan(frame.scores)))}: "
                f"no score; result lines need a 16th field"
            )


class _Match:
    """The overlapping pairs of all frames, and what is counted from them."""

    def __init__(self, labels: PooledFrames, results: PooledFrames) -> None:
        self.candidates = candidates_by_metric(labels, results)
        self._labels, self._results = labels.objects, results.objects
        self._dont_care = dont_care_shares(labels, results)
        self._gains = {
            metric: self._orientation_gains(pairs) if metric == "image" else np.zeros(len(pairs[1]))
            for metric, pairs in self.candidates.items()
        }

    def states(self, category: str, difficulty: int) -> tuple[np.ndarray, np.ndarray]:
        """States of the labels and of the results."""
        return (
            label_states(self._labels, category, difficulty),
            result_states(self._results, category, difficulty),
        )

    def curves(
        self, metric: str, of_labels: np.ndarray, of_results: np.ndarray, min_overlap: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """(41,) precision and (41,) orientation similarity at the kit's score thresholds."""
        candidates = self.candidates[metric]
        contest = Contest(of_labels, of_results, self._results.scores, min_overlap)
        found = scores_of_found(candidates, contest)
        thresholds = score_thresholds(found, int(np.sum(of_labels == COUNTED)))
        # DontCare regions are 2D boxes: only the image metric knows them.
        in_dont_care = (self._dont_care > min_overlap) & (metric == "image")
        totals = tally(candidates, contest, thresholds, in_dont_care, self._gains[metric])
        positives = np.maximum(totals[:, 0] + totals[:, 1], 1)
        return _running_maximum(totals[:, 0] / positives), _running_maximum(
            totals[:, 2] / positives
        )

    def recall_3d(self, of_labels: np.ndarray, of_results: np.ndarray, min_overlap: float) -> float:
        """Share of the counted objects that a detection of any score finds."""
        contest = Contest(of_labels, of_results, self._results.scores, min_overlap)
        matches = match_results(self.candidates["3d"], contest, -np.inf)
        counted = of_labels == COUNTED
        found = counted & (matches >= 0)
        found[found] = of_results[matches[found]] == COUNTED
        return float(np.sum(found) / max(np.sum(counted), 1))

    def _orientation_gains(self, pairs: Candidates) -> np.ndarray:
        """Return (pairs,) (1 + cos of the difference of the observation angles) / 2."""
        rows = np.repeat(np.arange(len(self._labels)), np.diff(pairs.starts))
        apart = self._labels.alpha[rows] - self._results.alpha[pairs.results]
        gains: np.ndarray = (1 + np.cos(apart)) / 2
        return gains


def score_thresholds(scores: Float[np.ndarray, " n"], count: int) -> Float[np.ndarray, " t"]:
    """Return the kit's score thresholds: at most 41, each the nearest to the next 1/40 of recall.

    Args:
        scores: (n,) of the detections that found an object.
        count: number of objects.

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


def _percent(precision: np.ndarray) -> np.ndarray:
    """Mean over the last axis, in percent; exactly 100 where all are 1."""
    means: np.ndarray = 100 * np.sum(precision, axis=-1) / precision.shape[-1]
    return means


def _running_maximum(values: np.ndarray) -> np.ndarray:
    """(41,) running maximum from the end of (t,) values, 0 after the last."""
    curve = np.zeros(_POSITIONS)
    curve[: len(values)] = np.maximum.accumulate(values[::-1])[::-1]
    return curve


def _at_true_recall(curve: np.ndarray, count: int) -> np.ndarray:
    """Return the curve of fewer than 41 objects, whose positions are objects, by recall."""
    if count >= _POSITIONS or count == 0:
        return curve
    # Position k of 40 needs ceil(k * count / 40) objects; the first of them is at index 0.
    needed = -(-np.arange(_POSITIONS) * count // (_POSITIONS - 1))
    return curve[np.maximum(needed - 1, 0)]
