"""A selection of labels with a bound on the share of wrong ones, by conformal p-values.

Sources: Jin and Candes, "Selection by Prediction with Conformal p-values", JMLR 24(244), 2023;
Benjamini and Hochberg, "Controlling the False Discovery Rate", JRSS B 57(1), 1995. Labels of one
frame depend on each other, so the unit of exchangeability is the frame, or the sequence where its
frames resemble each other. For labels in groups see Lee, Barber and Willett, "Distribution-free
inference with hierarchical data", 2023.

N held-out units have known truth, M units are selected from; each has any number of labels. For a
label with probability p, let a be the number of held-out wrong labels with at least this
probability, and b its rank within its own unit: the number of labels there with at least p. If its
own unit were a held-out one, a + b would be at least the rank of the label among all the wrong
labels of the N + 1 units, if it is wrong. No more than c labels have a rank of at most c. Units are
exchangeable, so each of the N + 1 contributes the same number in expectation, and

    E[number of wrong labels of a unit with a + b <= c] <= c / (N + 1).

The p-value is (a + b) / (N + 1) divided by the mean number m / M of labels of a unit. For one label
per unit it is that of Jin and Candes, with b = 1. Benjamini and Hochberg's step then selects the k
labels with the least p-values, for the greatest k with p_(k) <= max_wrong k / m, or

    M (a + b) / (N + 1) <= max_wrong k,

which bounds the number of wrong labels that the units would contribute by the allowed one.
"""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from curate.shapes import Bool, Float, Int

Unit = Literal["frame", "sequence"]
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class HeldOut:
    """The wrong labels of units that neither the teacher nor the fit has used.

    Attributes:
        unit: what is exchangeable with the units to select from: a frame or a whole sequence.
        units: number of held-out units with labels.
        wrong: (w,) probabilities of their wrong labels, ascending.
    """

    unit: Unit
    units: int
    wrong: Float[np.ndarray, " w"]

    @classmethod
    def of_labels(
        cls,
        unit: Unit,
        unit_index: Int[np.ndarray, " n"],
        probability: Float[np.ndarray, " n"],
        wrong: Bool[np.ndarray, " n"],
    ) -> Self:
        """Return the held-out labels of some units, with truth.

        Args:
            unit: frame or sequence.
            unit_index: number of the unit of each label; any numbering.
            probability: probability that each label is correct, by the calibration.
            wrong: whether each label is wrong; neither correct nor neutral ones are.
        """
        return cls(unit, len(np.unique(unit_index)), np.sort(probability[wrong]))


def p_values(
    held_out: HeldOut,
    probability: Float[np.ndarray, " m"],
    unit_index: Int[np.ndarray, " m"],
) -> Float[np.ndarray, " m"]:
    """Return the conformal p-value of the hypothesis that each label is wrong.

    Args:
        held_out: the held-out wrong labels.
        probability: probability that each label is correct, by the same calibration.
        unit_index: number of the unit of each label; any numbering.
    """
    if not len(probability):
        return np.zeros(0)
    above = len(held_out.wrong) - np.searchsorted(held_out.wrong, probability, side="left")
    units = len(np.unique(unit_index))
    labels_per_unit = len(probability) / units
    rank = _rank_in_unit(probability, unit_index)
    p = (above + rank) / ((held_out.units + 1) * labels_per_unit)
    return np.asarray(np.minimum(p, 1.0))


def benjamini_hochberg(p: Float[np.ndarray, " m"], max_wrong: float) -> Bool[np.ndarray, " m"]:
    """Return the labels to select, of which a share of `max_wrong` is expected to be wrong."""
    bounds = _bounds(p)
    selected = np.flatnonzero(bounds <= max_wrong * (1.0 + _ROUNDING))
    if not len(selected):
        return np.zeros(len(p), dtype=bool)
    return np.asarray(p <= np.sort(p)[selected[-1]])


def least_bound(p: Float[np.ndarray, " m"]) -> float:
    """Return the least `max_wrong` for which any label is selected; infinite without labels."""
    return float(_bounds(p).min(initial=np.inf))


def _bounds(p: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Return m p_(k) / k: the bound that a selection of the k labels with the least p has."""
    return np.sort(p) * len(p) / np.arange(1, len(p) + 1)


def _rank_in_unit(
    probability: Float[np.ndarray, " m"], unit_index: Int[np.ndarray, " m"]
) -> Int[np.ndarray, " m"]:
    """Return how many labels of its unit, itself included, are at least as probable as each."""
    order = np.lexsort((-probability, unit_index))
    unit, value = unit_index[order], probability[order]
    place = np.arange(len(order))
    new_unit = np.r_[True, unit[1:] != unit[:-1]]
    start = np.maximum.accumulate(np.where(new_unit, place, 0))
    # Of equal probabilities the last place counts.
    last_of_equals = np.r_[new_unit[1:] | (value[1:] != value[:-1]), True]
    ends = np.where(last_of_equals, place, len(order))
    last = np.minimum.accumulate(ends[::-1])[::-1]
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = last - start + 1
    return rank
