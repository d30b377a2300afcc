"""Evaluate pseudo-labels and their weights on frames with ground truth.

The labels of these frames are made and weighted as if the frames were unlabeled. The ground truth
then shows how many are correct, and how well the weights of each policy separate correct labels
from wrong ones: overall, by category, by distance from the LiDAR, and by LiDAR points in the box.
Intervals come from a bootstrap over frames, because frames are what was sampled; if the data set
has sequences, over sequences, because frames of one sequence are alike. Policies are compared on
the same draws.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from curate.evaluation.audit_sample import Resampling, Sample, measure
from curate.evaluation.counts import Counts
from curate.evaluation.evaluated_labels import ALL, WHOLE, EvaluatedLabels, Slice, slices
from curate.evaluation.reliability import (
    ReliabilityBins,
    chance_calibration_errors,
    rank_labels,
    reliability_bins,
)
from curate.evaluation.resampling import draw_frames
from curate.shapes import Float

COMPARED = ("auroc", "average_precision", "equal_recall_precision", "calibration_error")
"""The figures of `Figures` by which policies are compared."""

FEWEST_SEQUENCES = 6
"""Below this number of sequences, every difference may be chance.

If two policies are equally good, all of k sequences favour the same one with probability 2 / 2^k:
6 % for five sequences, 3 % for six.
"""


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
            value: the figure. If it is NaN, so is the interval.
            replicates: (r,) bootstrap replicates; NaN is skipped. If all are NaN, so is the
                interval.
            level: coverage of the interval.
        """
        defined = replicates[~np.isnan(replicates)]
        if np.isnan(value) or not len(defined):
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
        equal_recall_precision: weighted precision of the weights to the power `equal_recall_power`.
        equal_recall_power: power at which the weights have the same weighted recall as those of
            `Audit.reference` in the same category and slice; NaN if there is none.
        calibration_error: expected difference between the weight and the share of correct labels.
        calibration_error_by_chance: mean calibration error of perfectly calibrated weights, for
            these labels and weights.
        calibration_error_limit: the calibration error that perfectly calibrated weights exceed with
            a probability of 1 - `Audit.level`.
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
    equal_recall_precision: Estimate
    equal_recall_power: float
    calibration_error: Estimate
    calibration_error_by_chance: float
    calibration_error_limit: float
    bins: ReliabilityBins

    @property
    def calibrated(self) -> bool:
        """Whether the calibration error is no larger than chance explains."""
        return self.calibration_error.value <= self.calibration_error_limit


@dataclass(frozen=True)
class Comparison:
    """The differences between the figures of two policies on the same frames: policy - other.

    Attributes:
        category: the category, or `ALL`.
        policy: the first policy.
        other: the policy that it is compared with; its figures are subtracted.
        differences: the difference by figure, for the figures in `COMPARED`.
        conclusive: False if too few sequences were drawn to distinguish a difference from chance.
    """

    category: str
    policy: str
    other: str
    differences: Mapping[str, Estimate]
    conclusive: bool = True

    @property
    def difference(self) -> Estimate:
        """The difference of the AUROC."""
        return self.differences["auroc"]

    @property
    def beyond_chance(self) -> bool:
        """Whether the interval of the difference of the AUROC excludes 0."""
        return self.is_real("auroc")

    def is_real(self, figure: str) -> bool:
        """Return whether the interval of a difference excludes 0; if not, it may be chance."""
        found = self.differences[figure]
        return self.conclusive and (found.low > 0 or found.high < 0)

    def negated(self) -> "Comparison":
        """Return the comparison of the same policies in the other order."""
        return Comparison(
            self.category,
            self.other,
            self.policy,
            {
                name: Estimate(-found.value, -found.high, -found.low)
                for name, found in self.differences.items()
            },
            self.conclusive,
        )


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
        sequences: number of sequences of the frames, which were resampled unless there is only one;
            None if the frames are not in sequences.
        reference: the policy with the weighted recall at which weights are compared; None if no
            weights can be.
    """

    frames: int
    level: float
    counts: Counts
    label_counts: Counts
    figures: tuple[Figures, ...]
    comparisons: tuple[Comparison, ...]
    sequences: int | None = None
    reference: str | None = None

    @property
    def resampled(self) -> str:
        """What the intervals are computed over, such as "25 frames"."""
        if self.sequences in (None, 1):
            return f"{self.frames} frames"
        return f"{self.sequences} sequences"

    @property
    def conclusive(self) -> bool:
        """Whether the frames are of enough sequences to distinguish a difference from chance."""
        return self.sequences is None or self.sequences >= FEWEST_SEQUENCES

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
        return self.compare(other, policy, category).negated()


def audit(
    labels: EvaluatedLabels,
    weights: Mapping[str, Float[np.ndarray, " n"]],
    categories: Sequence[str],
    generator: np.random.Generator,
    *,
    reference: str | None = None,
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
        reference: the policy with the weighted recall at which weights are compared. By default, or
            if it gives no weight, the first policy that gives any.
        replicates: number of bootstrap draws.
        level: coverage of the intervals.
        bins: number of bins of the weight.
    """
    unit = labels.resampling_unit
    units = int(unit.max(initial=-1)) + 1
    sequences = units if units < labels.frames else None
    if sequences == 1:
        unit, units = np.arange(labels.frames), labels.frames
    resampling = Resampling(draw_frames(generator, units, replicates), unit, bins)
    seed = int(generator.integers(2**32))
    reference = _usable_reference(weights, reference)
    conclusive = sequences is None or sequences >= FEWEST_SEQUENCES
    figures: list[Figures] = []
    comparisons: list[Comparison] = []
    for category in (ALL, *categories):
        for part in (WHOLE, *slices(labels)):
            sample = Sample.of(labels, category, part, resampling, weights.get(reference or ""))
            replicated: dict[str, Mapping[str, np.ndarray]] = {}
            for policy, v in weights.items():
                of_chance = np.random.default_rng(seed)  # the same whatever else is audited
                found, replicated[policy] = _figures(policy, v, sample, level, of_chance)
                figures.append(found)
            if part == WHOLE:
                comparisons += _comparisons(
                    figures[-len(weights) :], replicated, level, conclusive=conclusive
                )
    counts = labels.counts(categories)
    return Audit(
        labels.frames, level, *counts, tuple(figures), tuple(comparisons), sequences, reference
    )


def _usable_reference(weights: Mapping[str, np.ndarray], wanted: str | None) -> str | None:
    """Return the wanted policy if it gives weight, else the first that does; None without any."""
    usable = [name for name, v in weights.items() if rank_labels(v)]
    return wanted if wanted in usable else next(iter(usable), None)


def _figures(
    policy: str, weights: np.ndarray, sample: Sample, level: float, generator: np.random.Generator
) -> tuple[Figures, Mapping[str, np.ndarray]]:
    """Return the figures of one policy, and their replicates by name."""
    v, bins = weights[sample.index], sample.resampling.bins
    values, replicates, power = measure(v, sample)
    by_chance = chance_calibration_errors(v, generator, bins=bins)
    estimates = {
        name: Estimate.of(value, replicates[name], level) for name, value in values.items()
    }
    return Figures(
        policy=policy,
        category=sample.category,
        slice=sample.part,
        labels=len(v),
        neutral=sample.neutral,
        right=int(sample.correct.sum()),
        objects=sample.objects,
        **estimates,
        equal_recall_power=power,
        calibration_error_by_chance=float(by_chance.mean()),
        calibration_error_limit=float(np.quantile(by_chance, level)),
        bins=reliability_bins(v, sample.correct, sample.objects or 0, bins),
    ), replicates


def _comparisons(
    figures: Sequence[Figures],
    replicated: Mapping[str, Mapping[str, np.ndarray]],
    level: float,
    *,
    conclusive: bool,
) -> list[Comparison]:
    """Compare every policy with each policy after it."""
    return [
        Comparison(
            one.category,
            one.policy,
            other.policy,
            {
                name: Estimate.of(
                    getattr(one, name).value - getattr(other, name).value,
                    replicated[one.policy][name] - replicated[other.policy][name],
                    level,
                )
                for name in COMPARED
            },
            conclusive,
        )
        for i, one in enumerate(figures)
        for other in figures[i + 1 :]
    ]
