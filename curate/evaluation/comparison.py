"""Figures of repeated experiments: their mean and spread, and their paired difference to others.

The interval of a paired difference is Student's t interval over the pairs (Student, "The Probable
Error of a Mean", Biometrika 1908): the pairs share a seed, so what the seed does to both drops out.
"""

from dataclasses import dataclass

import numpy as np

from curate.shapes import Float


@dataclass(frozen=True)
class Spread:
    """Repeated measurements of one figure.

    Attributes:
        mean: NaN without any.
        std: sample standard deviation (n - 1); NaN with fewer than two.
        count: n.
    """

    mean: float
    std: float
    count: int


@dataclass(frozen=True)
class PairedDifference:
    """How much greater a figure is than another one that was measured with it.

    Attributes:
        mean: of the differences; NaN without any.
        low: lower bound of its interval; NaN with fewer than two pairs.
        high: upper bound.
        count: pairs.
    """

    mean: float
    low: float
    high: float
    count: int


def spread(values: Float[np.ndarray, " n"]) -> Spread:
    """Mean and standard deviation of (n,) values; NaN values are left out."""
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
        values: (n,), NaN where it was not measured.
        others: (n,) of the same experiments, NaN likewise; such pairs are left out.
        level: coverage of the interval.
    """
    from scipy.stats import t

    found = spread(values - others)
    reach = np.nan
    if found.count > 1:
        quantile = t.ppf((1 + level) / 2, found.count - 1)
        reach = float(quantile) * found.std / np.sqrt(found.count)
    return PairedDifference(found.mean, found.mean - reach, found.mean + reach, found.count)
