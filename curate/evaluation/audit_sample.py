"""The labels of one category and slice of an audit, and the figures of their weights in each draw.

A draw is stored as the number of times that each unit, a frame or a sequence, was drawn. Figures
that are computed from sums over the labels need these sums per unit only; see `resampling` for
those that depend on the order of the labels.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from curate.evaluation.equal_recall import (
    equal_recall_power,
    equal_recall_precision,
    equal_recall_replicates,
    power_sums,
)
from curate.evaluation.evaluated_labels import ALL, EvaluatedLabels, Slice
from curate.evaluation.reliability import (
    auroc,
    average_precision,
    bin_of,
    expected_calibration_error,
    rank_labels,
    weighted_precision,
    weighted_recall,
)
from curate.evaluation.resampling import ranked_replicates
from curate.shapes import Bool, Float, Int


@dataclass(frozen=True)
class Resampling:
    """How the labels of an audit are resampled and binned.

    Attributes:
        draws: (r, u) counts of each unit, see `draw_frames`.
        unit: (f,) unit of each frame.
        bins: number of bins of the weight.
    """

    draws: Float[np.ndarray, "r u"]
    unit: Int[np.ndarray, " f"]
    bins: int


@dataclass(frozen=True)
class Sample:
    """The n counted labels of a category and slice, with what is the same for every policy.

    Attributes:
        resampling: see `Resampling`.
        category: the category, or `ALL`.
        part: the slice.
        index: (n,) the labels among those of the audit.
        unit: (n,) the unit of each label.
        correct: (n,) bool.
        neutral: number of further labels that are neither correct nor wrong.
        objects: number of objects; None if it is unknown which are in the slice.
        target: total weight that the reference policy gives to the correct labels.
        label_draws: (r,) number of labels in each draw.
        correct_draws: (r,) number of correct labels in each draw.
        target_draws: (r,) target in each draw.
        object_draws: (r,) number of objects in each draw; 0 if it is unknown.
    """

    resampling: Resampling
    category: str
    part: Slice
    index: Int[np.ndarray, " n"]
    unit: Int[np.ndarray, " n"]
    correct: Bool[np.ndarray, " n"]
    neutral: int
    objects: int | None
    target: float
    label_draws: Float[np.ndarray, " r"]
    correct_draws: Float[np.ndarray, " r"]
    target_draws: Float[np.ndarray, " r"]
    object_draws: Float[np.ndarray, " r"]

    @classmethod
    def of(
        cls,
        labels: EvaluatedLabels,
        category: str,
        part: Slice,
        resampling: Resampling,
        reference: Float[np.ndarray, " n"] | None,
    ) -> Self:
        """Select the labels of a category and slice.

        Args:
            labels: all labels of the audit.
            category: the category, or `ALL`.
            part: the slice.
            resampling: see `Resampling`.
            reference: (n,) weights of the reference policy for all labels; None without one.
        """
        of_category = np.full(len(labels), True) if category == ALL else labels.category == category
        objects = np.full(len(labels.object_frame), True)
        if category != ALL:
            objects = labels.object_category == category
        if part.by != "all":
            of_category &= part.holds(getattr(labels, part.by))
            # Points are counted inside labels only, so the point counts of objects are unknown.
            objects &= part.holds(labels.object_distance) & (part.by != "points")
        index = np.flatnonzero(of_category & labels.counted)
        correct, units = labels.correct[index], resampling.draws.shape[1]
        unit = resampling.unit[labels.frame_index[index]]
        target = np.zeros(len(index)) if reference is None else reference[index] * correct
        columns = (
            *(np.bincount(unit, column, units) for column in (None, correct, target)),
            np.bincount(resampling.unit[labels.object_frame[objects]], minlength=units),
        )
        return cls(
            *(resampling, category, part, index, unit, correct),
            int((of_category & ~labels.counted).sum()),
            None if part.by == "points" else int(objects.sum()),
            float(target.sum()),
            *(resampling.draws @ np.stack(columns, axis=1)).T,
        )


def measure(
    v: Float[np.ndarray, " n"], sample: Sample
) -> tuple[Mapping[str, float], Mapping[str, Float[np.ndarray, " r"]], float]:
    """Return the figures of a policy's weights of a sample, with their replicates.

    Args:
        v: (n,) weights of the labels of the sample, NaN if they were not measured.
        sample: see `Sample`.

    Returns:
        The figures of `audit.Figures` by name, their (r,) replicates, and the power of the weights
        for the precision at equal recall.
    """
    correct, bins = sample.correct, sample.resampling.bins
    power = equal_recall_power(v, correct, sample.target)
    ranks = rank_labels(v)
    values = {
        "share_right": float(correct.mean()) if len(v) else float("nan"),
        "auroc": auroc(v, correct) if ranks else float("nan"),
        "average_precision": average_precision(v, correct) if ranks else float("nan"),
        "weighted_precision": weighted_precision(v, correct),
        "weighted_recall": weighted_recall(v, correct, sample.objects or 0),
        "equal_recall_precision": equal_recall_precision(v, correct, power),
        "calibration_error": expected_calibration_error(v, correct, bins),
    }
    replicates = {"share_right": _ratio(sample.correct_draws, sample.label_draws)}
    undefined = np.full(len(sample.label_draws), np.nan)
    ranked = undefined, undefined
    if ranks:
        ranked = ranked_replicates(v, correct, sample.unit, sample.resampling.draws)
    replicates["auroc"], replicates["average_precision"] = ranked
    if np.isnan(v).any():
        return values, dict.fromkeys(values, undefined) | replicates, power
    return values, replicates | _summed(v, sample, power), power


def _summed(v: np.ndarray, sample: Sample, power: float) -> dict[str, np.ndarray]:
    """Return the (r,) replicates of the figures that are computed from sums over the labels."""
    correct, bins = sample.correct, sample.resampling.bins
    units = sample.resampling.draws.shape[1]
    # The calibration error is a sum over the bins of |correct labels - sum of weights|.
    cell = sample.unit * bins + bin_of(v, bins)
    columns = (
        np.bincount(sample.unit, v, units)[:, None],
        np.bincount(sample.unit, v * correct, units)[:, None],
        np.bincount(cell, correct - v, units * bins).reshape(-1, bins),
        power_sums(v, correct, sample.unit, units, power),
    )
    # One product of matrices is several times faster than one per column.
    summed = sample.resampling.draws @ np.concatenate(columns, axis=1)
    weight, trusted = summed[:, :2].T
    gaps, sums = np.split(summed[:, 2:], [bins], axis=1)
    return {
        "weighted_precision": _ratio(trusted, weight),
        "weighted_recall": _ratio(trusted, sample.object_draws),
        "calibration_error": _ratio(np.abs(gaps).sum(axis=1), sample.label_draws),
        "equal_recall_precision": equal_recall_replicates(sums, sample.target_draws),
    }


def _ratio(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return (r,) part / whole, NaN if the whole is 0."""
    return np.asarray(part / np.where(whole > 0, whole, np.nan))
