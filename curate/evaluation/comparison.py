"""Figures of repeated experiments: their mean, their spread, and the difference between pairs.

The interval of a paired difference is Student's t interval over the pairs (Student, "The Probable
Error of a Mean", Biometrika 1908). Both experiments of a pair use the same seed, so the effect that
the seed has on both cancels out.
"""

from dataclasses import dataclass

import numpy as np

from curate.shapes import Float


@dataclass(frozen=True)
class Spread:
    """Mean and spread of repeated measurements of one figure.

    Attributes:
        mean: NaN without measurements.
        std: sample standard deviation (n - 1); NaN with fewer than two measurements.
        count: number of measurements, n.
    """

    mean: float
    std: float
    count: int


@dataclass(frozen=True)
class PairedDifference:
    """The mean difference of two figures over pairs of experiments, with its interval.

    Attributes:
        mean: mean of the differences; NaN without pairs.
        low: lower bound of its interval; NaN with fewer than two pairs.
        high: upper bound of its interval; NaN with fewer than two pairs.
        count: number of pairs.
    """

    mean: float
    low: float
    high: float
    count: int


def known_mean(values: Float[np.ndarray, " *shape"], axes: int) -> Float[np.ndarray, " *rest"]:
    """Return the mean over the last axes without NaN; NaN where all values are NaN.

    Args:
        values: NaN for figures that cannot be computed.
        axes: number of axes to average over.
    """
    over = tuple(range(values.ndim - axes, values.ndim))
    known = ~np.isnan(values)
    counts = known.sum(axis=over)
    sums = np.sum(values, axis=over, where=known)
    means: np.ndarray = sums / np.where(counts > 0, counts, np.nan)
    return means


def spread(values: Float[np.ndarray, " n"]) -> Spread:
    """Return the mean and standard deviation of (n,) values; NaN values are skipped."""
    values = values[~np.isnan(values)]
    count = len(values)
    mean = float(values.mean()) if count else np.nan
    std = float(values.std(ddof=1)) if count > 1 else np.nan
    return Spread(mean, std, count)


def paired_difference(
    values: Float[np.ndarray, " n"], others: Float[np.ndarray, " n"], level: float = 0.95
) -> PairedDifference:
    """Return the mean of values - others with its t interval.

    Args:
        values: (n,), NaN where it was not measured; such pairs are skipped.
        others: (n,) values to compare with, in the same order of experiments; NaN likewise.
        level: coverage of the interval.
    """
    from scipy.stats import t

    difference = spread(values - others)
    mean, count, half_width = difference.mean, difference.count, np.nan
    if count > 1:
        quantile = t.ppf((1 + level) / 2, count - 1)
        half_width = float(quantile) * difference.std / np.sqrt(count)
    return PairedDifference(mean, mean - half_width, mean + half_width, count)
