"""Weighted precision at equal weighted recall: weights compared once they are equally sharp.

Weights that are small for all but a few labels have a high weighted precision, even if they rank
the labels badly, because v^2 has a higher one than v. Before weights v are compared with reference
weights u, they are therefore raised to the power g at which both have the same weighted recall:

    sum over correct labels of v^g  =  target  =  sum over correct labels of u
    precision at equal recall       =  target / sum over all labels of v^g

The left side falls with g, from the number of correct labels with v > 0 (g -> 0) to the number of
those with v = 1 (g -> infinity). Weights that have no power with this recall are treated as the
limits: a target above the range cannot be reached, and the precision is NaN. For a target below
the range, only the labels of weight 1 remain, scaled down together, which does not change their
precision. The number of objects cancels out, so it need not be known.

Example: v is 0.9, 0.5, 0.4, 0.1 of labels that are correct, correct, wrong, wrong. At g = 1 the
correct labels have 1.4 and the precision is 1.4 / 1.9 = 0.737; at g = 2 they have 1.06 and the
precision is 1.06 / 1.23 = 0.862.
"""

import numpy as np
from numba import njit

from curate.shapes import Bool, Float, Int

_LARGEST = 25.0
"""Natural logarithm of the largest power that is tried; its inverse is the smallest."""
_STEPS = 2.0 ** np.array([-4, -2, -1, -0.5, -0.25, 0, 0.25, 0.5, 1, 2, 4, 6, 9])
"""Powers at which replicates are computed, relative to the power of the whole sample."""


def equal_recall_power(
    weights: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], target: float
) -> float:
    """Return the power g at which the correct labels have the target as their total weight.

    Args:
        weights: (n,) in [0, 1], NaN if they were not measured.
        correct: (n,) bool.
        target: total weight of the correct labels, see the module's documentation.

    Returns:
        The power; 0 and infinity are the limits; NaN if the target cannot be reached or is 0.
    """
    from scipy.optimize import brentq

    own = weights[correct & (weights > 0)]
    if np.isnan(weights).any() or not 0 < target <= len(own) * (1 + 1e-9):
        return float("nan")
    if target <= (own == 1).sum():
        return float("inf")
    logarithms = np.log(own)

    def excess(log_power: float) -> float:
        return float(np.exp(np.exp(log_power) * logarithms).sum() - target)

    if excess(-_LARGEST) <= 0:
        return 0.0
    if excess(_LARGEST) >= 0:
        return float("inf")
    return float(np.exp(brentq(excess, -_LARGEST, _LARGEST, xtol=1e-13)))


def equal_recall_precision(
    weights: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], power: float
) -> float:
    """Return the weighted precision of the weights to a power.

    Args:
        weights: (n,) in [0, 1].
        correct: (n,) bool.
        power: see `equal_recall_power`; infinity leaves the labels of weight 1.

    Returns:
        The precision; NaN if the power is NaN.
    """
    if np.isnan(power):
        return power
    # 0 stays 0 even if the power is 0.
    raised = weights == 1 if np.isinf(power) else np.where(weights > 0, weights**power, 0.0)
    return float(raised[correct].sum() / raised.sum())


def power_sums(
    weights: Float[np.ndarray, " n"],
    correct: Bool[np.ndarray, " n"],
    frame_index: Int[np.ndarray, " n"],
    frames: int,
    power: float,
) -> Float[np.ndarray, "f two_p"]:
    """Return the sums of each frame from which `equal_recall_replicates` computes.

    Args:
        weights: (n,) in [0, 1], without NaN.
        correct: (n,) bool.
        frame_index: (n,) integer in [0, f).
        frames: number of frames, f.
        power: the power of the whole sample; nearby powers are computed.

    Returns:
        (f, 2 p) for p rising powers from 0 to infinity: the sums over the correct labels, then
        those over all labels.
    """
    centre = power if 0 < power < np.inf else 1.0
    powers = np.concatenate([[0.0], centre * _STEPS, [np.inf]])
    return _power_sums(weights, correct, frame_index, frames, powers)


def equal_recall_replicates(
    sums: Float[np.ndarray, "r two_p"], targets: Float[np.ndarray, " r"]
) -> Float[np.ndarray, " r"]:
    """Return the precision at equal recall in each draw of frames.

    Both sums of v^g fall with g, and the logarithm of one is almost a straight line over that of
    the other. The sum over all labels is therefore interpolated between the two powers with sums
    over the correct labels that enclose the target.

    Args:
        sums: (r, 2 p) `power_sums`, added up over the frames of each draw.
        targets: (r,) total weight that the reference gives to the correct labels of each draw.

    Returns:
        (r,) precision; NaN where the target cannot be reached or is 0.
    """
    own, whole = np.split(sums, 2, axis=1)
    last, rows = own.shape[1] - 1, np.arange(len(own))
    # The powers before and after the target; beyond the largest one, its precision.
    after = np.minimum((own >= targets[:, None]).sum(axis=1), last)
    before = np.maximum(after - 1, 0)
    reachable = (targets > 0) & (targets <= own[:, 0] * (1 + 1e-9))
    precision = np.full(len(own), np.nan)
    lower, upper = own[rows, after], own[rows, before]
    beyond = targets <= own[:, -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(upper / targets) / np.log(upper / lower)
        share = np.where((lower > 0) & (upper > lower), share, 0.0)
        between = whole[rows, before] ** (1 - share) * whole[rows, after] ** share
        value = np.where(beyond, own[:, -1] / whole[:, -1], targets / between)
        # No label of weight 1 is drawn: the precision at the largest finite power.
        value = np.where(lower > 0, value, upper / whole[rows, before])
    precision[reachable] = value[reachable]
    return precision


@njit(cache=True, nogil=True, error_model="numpy")
def _power_sums(
    weights: np.ndarray,
    correct: np.ndarray,
    frame_index: np.ndarray,
    frames: int,
    powers: np.ndarray,
) -> np.ndarray:
    """Return (f, 2 p) sums of the powers of each frame's weights, of correct and of all labels."""
    count = len(powers)
    sums = np.zeros((frames, 2 * count))
    for i in range(len(weights)):
        if weights[i] == 0.0:
            continue
        logarithm = np.log(weights[i])
        row = sums[frame_index[i]]
        for p in range(count):
            one = logarithm == 0.0 or powers[p] == 0.0  # infinity times 0 would be NaN
            raised = 1.0 if one else np.exp(powers[p] * logarithm)
            row[count + p] += raised
            if correct[i]:
                row[p] += raised
    return sums
