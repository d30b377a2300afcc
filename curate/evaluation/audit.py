"""What pseudo-labels and their weights are worth, on frames whose ground truth is known.

The labels of such frames are made and weighed as if the frames were unlabeled. Then the truth is
asked how many are right, and how well each policy's weight tells right from wrong: over all, by
category, by distance from the LiDAR, and by LiDAR points in the box. Intervals come from a
bootstrap over frames, the unit that was sampled; policies are compared within the same draws.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from curate.evaluation.judged_labels import ALL, WHOLE, JudgedLabels, Slice, slices
from curate.evaluation.reliability import (
    ReliabilityBins,
    auroc,
    average_precision,
    expected_calibration_error,
    reliability_bins,
    weighted_precision,
    weighted_recall,
)
from curate.evaluation.resampling import draw_frames, ranked_replicates
from curate.shapes import Float


@dataclass(frozen=True)
class Estimate:
    """A figure with its interval; NaN where it is undefined."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, replicates: Float[np.ndarray, " r"], level: float) -> Self:
        """Return the figure, and the interval that holds the share `level` of its (r,) replicates.

        Undefined replicates are left out; the interval is NaN where all of them are.
        """
        defined = replicates[~np.isnan(replicates)]
        if not len(defined):
            return cls(float(value), np.nan, np.nan)
        low, high = np.quantile(defined, [(1 - level) / 2, (1 + level) / 2])
        return cls(float(value), float(low), float(high))


@dataclass(frozen=True)
class Figures:
    """How good the labels of a category in a slice are, and how well a policy's weight judges them.

    Attributes:
        policy: whose weight.
        category: or `ALL`.
        slice: see `Slice`.
        labels: that are right or wrong.
        neutral: further labels that are neither.
        right: of the labels.
        objects: to be found; None where it is not known which belong to the slice.
        share_right: right / labels.
        auroc: chance that a right label weighs more than a wrong one.
        average_precision: of the labels ranked by weight.
        weighted_precision: share of the weight that lies on right labels.
        weighted_recall: weight on right labels per object.
        calibration_error: expected distance of the weight and the share of right labels.
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
    """By how much the AUROC of one policy exceeds that of another, over the same frames."""

    category: str
    policy: str
    other: str
    difference: Estimate

    @property
    def beyond_chance(self) -> bool:
        """Whether the interval of the difference leaves 0 out."""
        return self.difference.low > 0 or self.difference.high < 0


@dataclass(frozen=True)
class Audit:
    """All figures of an audit.

    Attributes:
        frames: that were audited.
        level: coverage of the intervals.
        figures: by category, slice and policy.
        comparisons: of every two policies, by category.
    """

    frames: int
    level: float
    figures: tuple[Figures, ...]
    comparisons: tuple[Comparison, ...]

    def whole(self, category: str = ALL) -> dict[str, Figures]:
        """Return the figures of all distances and point counts, by policy."""
        return {
            found.policy: found
            for found in self.figures
            if found.slice == WHOLE and found.category == category
        }

    def compare(self, policy: str, other: str, category: str = ALL) -> Comparison:
        """Return the comparison of two policies, in this order."""
        for found in self.comparisons:
            if (found.category, found.policy, found.other) == (category, policy, other):
                return found
        found = self.compare(other, policy, category)
        turned = Estimate(-found.difference.value, -found.difference.high, -found.difference.low)
        return Comparison(category, policy, other, turned)


def audit(
    labels: JudgedLabels,
    weights: Mapping[str, Float[np.ndarray, " n"]],
    categories: Sequence[str],
    generator: np.random.Generator,
    *,
    replicates: int = 1000,
    level: float = 0.95,
    bins: int = 10,
) -> Audit:
    """Return all figures, with intervals.

    Args:
        labels: see `JudgedLabels`.
        weights: (n,) in [0, 1] by policy.
        categories: to be looked at one by one, and all together.
        generator: source of the draws.
        replicates: number of draws.
        level: coverage of the intervals.
        bins: of the weight.
    """
    draws = draw_frames(generator, labels.frames, replicates)
    figures: list[Figures] = []
    comparisons: list[Comparison] = []
    for category in (ALL, *categories):
        for part in (WHOLE, *slices(labels)):
            sample = _sample(labels, category, part)
            aurocs: dict[str, np.ndarray] = {}
            for policy, of_all in weights.items():
                found, aurocs[policy] = _figures(policy, of_all, sample, draws, level, bins)
                figures.append(found)
            if part == WHOLE:
                comparisons += _comparisons(figures[-len(weights) :], aurocs, level)
    return Audit(labels.frames, level, tuple(figures), tuple(comparisons))


@dataclass(frozen=True)
class _Sample:
    """The counted labels of a category and slice; `objects` is (f,), None where unknown."""

    category: str
    part: Slice
    index: np.ndarray
    frame_index: np.ndarray
    right: np.ndarray
    neutral: int
    objects: np.ndarray | None


def _sample(labels: JudgedLabels, category: str, part: Slice) -> _Sample:
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
        labels.right[index],
        int((of_category & ~labels.counted).sum()),
        # Points are counted in labels only, so nobody knows how many objects have few of them.
        None
        if part.by == "points"
        else np.bincount(labels.object_frame[objects], minlength=labels.frames),
    )


def _figures(
    policy: str,
    of_all: np.ndarray,
    sample: _Sample,
    draws: np.ndarray,
    level: float,
    bins: int,
) -> tuple[Figures, np.ndarray]:
    """Return the figures of one policy, and the replicates of its AUROC."""
    v, right = of_all[sample.index], sample.right
    frames = draws.shape[1]
    objects = 0 if sample.objects is None else int(sample.objects.sum())
    ranked = ranked_replicates(v, right, sample.frame_index, draws)
    counts, found, weight, trusted = (
        draws @ np.bincount(sample.frame_index, column, minlength=frames)
        for column in (np.ones(len(v)), right, v, v * right)
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
        right=int(right.sum()),
        objects=None if sample.objects is None else objects,
        share_right=estimate(_mean(right), _ratio(found, counts)),
        auroc=estimate(auroc(v, right), ranked[0]),
        average_precision=estimate(average_precision(v, right), ranked[1]),
        weighted_precision=estimate(weighted_precision(v, right), _ratio(trusted, weight)),
        weighted_recall=estimate(weighted_recall(v, right, objects), _ratio(trusted, of_objects)),
        calibration_error=estimate(expected_calibration_error(v, right, bins), error),
        bins=reliability_bins(v, right, objects, bins),
    ), ranked[0]


def _calibration_replicates(
    v: np.ndarray, sample: _Sample, draws: np.ndarray, bins: int
) -> np.ndarray:
    """(r,) sum over the bins of |right labels - weight|: the calibration error times the labels."""
    edges = np.arange(bins + 1) / bins
    member = np.clip(np.searchsorted(edges, v, side="right") - 1, 0, bins - 1)
    cell = sample.frame_index * bins + member
    gap = np.bincount(cell, sample.right - v, minlength=draws.shape[1] * bins)
    return np.asarray(np.abs(draws @ gap.reshape(-1, bins)).sum(axis=1))


def _comparisons(
    figures: Sequence[Figures], aurocs: Mapping[str, np.ndarray], level: float
) -> list[Comparison]:
    """Return every policy with each that follows it."""
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
    """Return (r,) part / whole, NaN where the whole is 0."""
    return np.asarray(part / np.where(whole > 0, whole, np.nan))


def _mean(right: np.ndarray) -> float:
    return float(right.mean()) if len(right) else float("nan")
