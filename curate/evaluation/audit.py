"""Evaluate pseudo-labels and their weights on frames with ground truth.

The labels of these frames are made and weighted as if the frames were unlabeled. The ground truth
then shows how many are correct, and how well the weights of each policy separate correct labels
from wrong ones: overall, by category, by distance from the LiDAR, and by LiDAR points in the box.
Intervals come from a bootstrap over frames, because frames are what was sampled. Policies are
compared on the same draws.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from curate.evaluation.counts import Counts
from curate.evaluation.evaluated_labels import ALL, WHOLE, EvaluatedLabels, Slice, slices
from curate.evaluation.reliability import (
    ReliabilityBins,
    auroc,
    average_precision,
    expected_calibration_error,
    rank_labels,
    reliability_bins,
    weighted_precision,
    weighted_recall,
)
from curate.evaluation.resampling import draw_frames, ranked_replicates
from curate.shapes import Float


@dataclass(frozen=True)
class Estimate:
    """A figure with its confidence interval; NaN where it is undefined."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, replicates: Float[np.ndarray, " r"], level: float) -> Self:
        """Return the figure with the interval that contains a share `level` of its replicates.

        Args:
            value: the figure.
            replicates: (r,) bootstrap replicates; NaN is skipped. If all are NaN, so is the
                interval.
            level: coverage of the interval.
        """
        defined = replicates[~np.isnan(replicates)]
        if not len(defined):
            return cls(float(value), np.nan, np.nan)
        low, high = np.quantile(defined, [(1 - level) / 2, (1 + level) / 2])
        return cls(float(value), float(low), float(high))


@dataclass(frozen=True)
class Figures:
    """The quality of the labels of a category in a slice, and of a policy's weights for them.

    Attributes:
        policy: the policy that gave the weights.
        category: the category, or `ALL`.
        slice: see `Slice`.
        labels: number of labels that are correct or wrong.
        neutral: number of further labels that are neither.
        right: number of correct labels.
        objects: number of ground truth objects; None if it is unknown which are in the slice.
        share_right: right / labels.
        auroc: probability that a correct label weighs more than a wrong one.
        average_precision: average precision of the labels ranked by weight.
        weighted_precision: share of the weight that is on correct labels.
        weighted_recall: weight on correct labels per object.
        calibration_error: expected difference between the weight and the share of correct labels.
        bins: labels, precision and recall by weight.
    """

    policy: str
    category: str
    slice: Slice
    labels: int
    neutral: int
    right: int
    objects: int | None
    share_right: Estimate
    auroc: Estimate
    average_precision: Estimate
    weighted_precision: Estimate
    weighted_recall: Estimate
    calibration_error: Estimate
    bins: ReliabilityBins


@dataclass(frozen=True)
class Comparison:
    """The difference between the AUROC of two policies on the same frames: policy - other."""

    category: str
    policy: str
    other: str
    difference: Estimate

    @property
    def beyond_chance(self) -> bool:
        """Whether the interval of the difference excludes 0."""
        return self.difference.low > 0 or self.difference.high < 0


@dataclass(frozen=True)
class Audit:
    """All figures of an audit.

    Attributes:
        frames: number of audited frames.
        level: coverage of the intervals.
        counts: which objects count, and why the others do not.
        label_counts: the same for the labels.
        figures: the figures by category, slice and policy.
        comparisons: the comparison of every two policies, by category.
    """

    frames: int
    level: float
    counts: Counts
    label_counts: Counts
    figures: tuple[Figures, ...]
    comparisons: tuple[Comparison, ...]

    def whole(self, category: str = ALL) -> dict[str, Figures]:
        """Return the figures over all distances and point counts, by policy."""
        return {
            found.policy: found
            for found in self.figures
            if found.slice == WHOLE and found.category == category
        }

    def compare(self, policy: str, other: str, category: str = ALL) -> Comparison:
        """Return the comparison of two policies, as policy - other."""
        for found in self.comparisons:
            if (found.category, found.policy, found.other) == (category, policy, other):
                return found
        found = self.compare(other, policy, category)
        negated = Estimate(-found.difference.value, -found.difference.high, -found.difference.low)
        return Comparison(category, policy, other, negated)


def audit(
    labels: EvaluatedLabels,
    weights: Mapping[str, Float[np.ndarray, " n"]],
    categories: Sequence[str],
    generator: np.random.Generator,
    *,
    replicates: int = 1000,
    level: float = 0.95,
    bins: int = 10,
) -> Audit:
    """Return all figures with their intervals.

    Args:
        labels: see `EvaluatedLabels`.
        weights: (n,) weights in [0, 1], by policy; all NaN if they could not be measured.
        categories: the categories to audit, each by itself and all together.
        generator: random generator for the bootstrap.
        replicates: number of bootstrap draws.
        level: coverage of the intervals.
        bins: number of bins of the weight.
    """
    draws = draw_frames(generator, labels.frames, replicates)
    figures: list[Figures] = []
    comparisons: list[Comparison] = []
    for category in (ALL, *categories):
        for part in (WHOLE, *slices(labels)):
            sample = _sample(labels, category, part)
            aurocs: dict[str, np.ndarray] = {}
            for policy, policy_weights in weights.items():
                found, aurocs[policy] = _figures(policy, policy_weights, sample, draws, level, bins)
                figures.append(found)
            if part == WHOLE:
                comparisons += _comparisons(figures[-len(weights) :], aurocs, level)
    counts = labels.counts(categories)
    return Audit(labels.frames, level, *counts, tuple(figures), tuple(comparisons))


@dataclass(frozen=True)
class _Sample:
    """The counted labels of a category and slice; `objects` is (f,) per frame, or None."""

    category: str
    part: Slice
    index: np.ndarray
    frame_index: np.ndarray
    correct: np.ndarray
    neutral: int
    objects: np.ndarray | None


def _sample(labels: EvaluatedLabels, category: str, part: Slice) -> _Sample:
    of_category = np.full(len(labels), True) if category == ALL else labels.category == category
    objects = np.full(len(labels.object_frame), True)
    if category != ALL:
        objects = labels.object_category == category
    if part.by != "all":
        of_category &= part.holds(getattr(labels, part.by))
        objects &= part.holds(labels.object_distance)
    index = np.flatnonzero(of_category & labels.counted)
    return _Sample(
        category,
        part,
        index,
        labels.frame_index[index],
        labels.correct[index],
        int((of_category & ~labels.counted).sum()),
        # Points are counted inside labels only, so the point counts of objects are unknown.
        None
        if part.by == "points"
        else np.bincount(labels.object_frame[objects], minlength=labels.frames),
    )


def _figures(
    policy: str,
    weights: np.ndarray,
    sample: _Sample,
    draws: np.ndarray,
    level: float,
    bins: int,
) -> tuple[Figures, np.ndarray]:
    """Return the figures of one policy, and the replicates of its AUROC."""
    v, correct = weights[sample.index], sample.correct
    frames = draws.shape[1]
    objects = 0 if sample.objects is None else int(sample.objects.sum())
    values, ranked = _ranked(v, sample, draws)
    counts, found, weight, trusted = (
        draws @ np.bincount(sample.frame_index, column, minlength=frames)
        for column in (np.ones(len(v)), correct, v, v * correct)
    )
    of_objects = draws @ (np.zeros(frames) if sample.objects is None else sample.objects)
    error = _calibration_replicates(v, sample, draws, bins) / np.where(counts, counts, np.nan)

    def estimate(value: float, replicates: np.ndarray) -> Estimate:
        return Estimate.of(value, replicates, level)

    return Figures(
        policy=policy,
        category=sample.category,
        slice=sample.part,
        labels=len(v),
        neutral=sample.neutral,
        right=int(correct.sum()),
        objects=None if sample.objects is None else objects,
        share_right=estimate(_mean(correct), _ratio(found, counts)),
        auroc=estimate(values[0], ranked[0]),
        average_precision=estimate(values[1], ranked[1]),
        weighted_precision=estimate(weighted_precision(v, correct), _ratio(trusted, weight)),
        weighted_recall=estimate(weighted_recall(v, correct, objects), _ratio(trusted, of_objects)),
        calibration_error=estimate(expected_calibration_error(v, correct, bins), error),
        bins=reliability_bins(v, correct, objects, bins),
    ), ranked[0]


def _ranked(
    v: np.ndarray, sample: _Sample, draws: np.ndarray
) -> tuple[tuple[float, float], tuple[np.ndarray, np.ndarray]]:
    """Return AUROC and average precision, and their replicates; NaN if the weights rank nothing."""
    if not rank_labels(v):
        undefined = np.full(len(draws), np.nan)
        return (np.nan, np.nan), (undefined, undefined)
    values = auroc(v, sample.correct), average_precision(v, sample.correct)
    return values, ranked_replicates(v, sample.correct, sample.frame_index, draws)


def _calibration_replicates(
    v: np.ndarray, sample: _Sample, draws: np.ndarray, bins: int
) -> np.ndarray:
    """Return (r,) the calibration error times the number of labels.

    This is the sum over the bins of |correct labels - sum of weights|.
    """
    edges = np.arange(bins + 1) / bins
    member = np.clip(np.searchsorted(edges, v, side="right") - 1, 0, bins - 1)
    cell = sample.frame_index * bins + member
    gap = np.bincount(cell, sample.correct - v, minlength=draws.shape[1] * bins)
    return np.asarray(np.abs(draws @ gap.reshape(-1, bins)).sum(axis=1))


def _comparisons(
    figures: Sequence[Figures], aurocs: Mapping[str, np.ndarray], level: float
) -> list[Comparison]:
    """Compare every policy with each policy after it."""
    return [
        Comparison(
            one.category,
            one.policy,
            other.policy,
            Estimate.of(
                one.auroc.value - other.auroc.value,
                aurocs[one.policy] - aurocs[other.policy],
                level,
            ),
        )
        for i, one in enumerate(figures)
        for other in figures[i + 1 :]
    ]


def _ratio(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return (r,) part / whole, NaN if the whole is 0."""
    return np.asarray(part / np.where(whole > 0, whole, np.nan))


def _mean(correct: np.ndarray) -> float:
    return float(correct.mean()) if len(correct) else float("nan")
