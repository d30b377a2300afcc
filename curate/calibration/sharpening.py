"""Weights p^gamma, with the gamma that gives them a requested precision.

The expected weighted precision of the weights p^gamma is

    precision(gamma) = sum(p * p^gamma) / sum(p^gamma),

the share of weight on correct labels if p is right. It grows with gamma: its derivative is the
covariance of p and ln p under the weights.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from curate.shapes import Float

LEAST_WEIGHT = 0.01
"""Smaller weights become 0."""
LEAST_MAXIMUM = 0.1
"""A gamma is not so great that the most probable label weighs less."""


@dataclass(frozen=True)
class Sharpening:
    """The exponent of weights p^gamma.

    Attributes:
        gamma: the exponent, at least 1.
        precision: expected weighted precision; below the requested one if that is out of reach, and
            above it if plain p is more precise. NaN without labels.
    """

    gamma: float
    precision: float

    def weights(self, probability: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return p^gamma for every label, and 0 where that is below 0.01."""
        weight = probability**self.gamma
        return np.where(weight < LEAST_WEIGHT, 0.0, weight)


def sharpen(probability: Float[np.ndarray, " n"], precision: float) -> Sharpening:
    """Return the least gamma >= 1 with which the weights p^gamma reach a precision.

    A precision that is out of reach gives the greatest gamma that leaves a weight of 0.1 to the
    most probable label, and with it the greatest precision.

    Args:
        probability: probability p that each label is correct.
        precision: the requested weighted precision, in (0, 1).
    """
    greatest = probability.max(initial=0.0)
    if greatest <= 0.0:
        return Sharpening(1.0, np.nan if len(probability) == 0 else 0.0)
    # Relative to the greatest, no power underflows for all labels, and the quotient is the same.
    relative = probability / greatest

    def reached(gamma: float) -> float:
        weight = relative**gamma
        return float((probability * weight).sum() / weight.sum())

    if greatest == 1.0:
        limit = 1e6
    else:
        limit = max(1.0, float(np.log(LEAST_MAXIMUM) / np.log(greatest)))
    if reached(1.0) >= precision:
        gamma = 1.0
    elif reached(limit) <= precision:
        gamma = limit
    else:
        gamma = float(brentq(lambda each: reached(each) - precision, 1.0, limit, rtol=1e-12))
    return Sharpening(gamma, reached(gamma))
