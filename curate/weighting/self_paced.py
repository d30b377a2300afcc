"""SPSL-3D and PSPSL-3D: easy labels first, harder ones in later rounds (Eqs. 4, 7, 11).

Source: An et al., Remote Sensing 15(3):627, 2023. Eq. 7 minimises v L + lambda (v^2 / 2 - v) over v
in [0, 1]. Eq. 11 minimises the same with v / rho in place of v, over v in [0, rho].

Example: four labels with L = 0.2, 0.4, 1.2 and NaN (no match), E = 4 rounds, quantile None.
The matched losses have mean 0.6 and maximum 1.2.

    round e = 1:  lambda = 1/4 * 1.2 + 3/4 * 0.6 = 0.75   v = 1 - 0.2/0.75 = 0.733, 0.467, 0, 0
    round e = 4:  lambda = 1.2                            v = 0.833, 0.667, 0, 0

The second label gains weight as lambda grows. The hardest label has L = lambda in the last round
and weight 0, and so has the label without a match in every round. With PSPSL each v is multiplied
by the rho_det of its label: rho_det = 0.5 changes 0.733 to 0.367.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from curate.errors import ConfigError
from curate.ranges import PositiveShare
from curate.shapes import Bool, Float
from curate.weighting.base import Age, Evidence, Policy, Weights

Scope = Literal["round", "category", "frame"]


@dataclass(frozen=True)
class SPSL(Policy):
    """v = 1 - L / lambda if L < lambda, else 0 (Eq. 7).

    Attributes:
        scope: labels that share one lambda: all labels of the round, of a category, or of a frame.
            A frame is the paper's batch of one: its hardest label has weight 0 in the last round,
            and the only label of a frame has weight 0 in every round.
        quantile: quantile of the losses that replaces their maximum in lambda, in (0, 1]; None for
            the maximum.
    """

    scope: Scope = "round"
    quantile: PositiveShare | None = None
    name: ClassVar[str] = "spsl"

    def __post_init__(self) -> None:
        """Raise ConfigError if a setting is invalid."""
        if self.scope not in get_args(Scope):
            choices = ", ".join(get_args(Scope))
            raise ConfigError(
                f"policy {self.name}: unknown scope {self.scope!r}; choose one of {choices}"
            )
        if self.quantile is not None and not 0 < self.quantile <= 1:
            raise ConfigError(
                f"policy {self.name}: quantile must be in (0, 1], not {self.quantile}"
            )

    @property
    def reads(self) -> tuple[str, ...]:
        """The columns of `Evidence` that the policy reads."""
        return ("loss", "category") if self.scope == "category" else ("loss",)

    def weigh(self, evidence: Evidence, age: Age) -> Weights:
        """Return the weight of every label; 0 if no reprediction matched."""
        lambda_u = age_parameter(evidence, age, self.scope, self.quantile)
        return Weights(easiness(evidence.loss, lambda_u), lambda_u)


@dataclass(frozen=True)
class PSPSL(SPSL):
    """v = rho_det * (1 - L / lambda) if L < lambda, else 0 (Eq. 11).

    Attributes:
        self_paced: false removes the factor 1 - L / lambda, to measure the effect of the schedule:
            v = rho_det for every label that matched, else 0. If no label of the round matched, as
            for a detector without a second pass, v = rho_det for every label.

    A label without image evidence weighs at most as much as the best label with it.
    """

    self_paced: bool = True
    name: ClassVar[str] = "pspsl"

    def weigh(self, evidence: Evidence, age: Age) -> Weights:
        """Return the weight of every label; see `self_paced` for labels without a match."""
        if not self.self_paced:
            counted = evidence.matched | (not evidence.matched.any())
            v = np.where(counted, evidence.rho_det, 0.0)
            return Weights.without_age(limit_unseen(v, evidence.unseen))
        lambda_u = age_parameter(evidence, age, self.scope, self.quantile)
        v = evidence.rho_det * easiness(evidence.loss, lambda_u)
        return Weights(limit_unseen(v, evidence.unseen), lambda_u)


def limit_unseen(
    v: Float[np.ndarray, " n"], unseen: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return (n,) weights in which no label without image evidence outweighs the best one with it.

    The weights stay as they are if no label with image evidence has a weight above 0.
    """
    limit = v.max(where=~unseen, initial=0.0)
    return np.where(unseen, np.minimum(v, limit), v) if limit > 0 else v


def easiness(
    loss: Float[np.ndarray, " n"], lambda_u: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return (n,) 1 - L / lambda if L < lambda, else 0 (Eq. 7); 0 if L is NaN.

    If both L and lambda are 0, every v minimises the objective. The result is 1, the limit for
    lambda from above, because no label can be easier.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        v = np.where(loss < lambda_u, 1.0 - loss / lambda_u, 0.0)
    return np.where((loss == 0) & (lambda_u == 0), 1.0, v)


def age_parameter(
    evidence: Evidence, age: Age, scope: Scope = "round", quantile: float | None = None
) -> Float[np.ndarray, " n"]:
    """Return (n,) lambda = (e/E) max(L) + (1 - e/E) mean(L) of each label's group (Eq. 4).

    Unmatched labels do not contribute to lambda, but get that of their group: NaN if no label of
    the group matched.

    Args:
        evidence: the labels of the round.
        age: round e of E.
        scope: labels that share one lambda, see `SPSL`.
        quantile: quantile that replaces the maximum, see `SPSL`.
    """
    group, groups = _group(evidence, scope)
    matched = evidence.matched
    loss, member = evidence.loss[matched], group[matched]
    count = np.bincount(member, minlength=groups)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(member, weights=loss, minlength=groups) / count
    maximum = _maximum(loss, member, count)
    hardest = maximum if quantile is None else _quantile(loss, member, count, quantile)
    parameter = age.share * hardest + (1.0 - age.share) * mean
    # Rounding can move the mean of equal losses above all of them: L < lambda would hold for them.
    lambda_u: np.ndarray = np.minimum(parameter, maximum)[group]
    return lambda_u


def _group(evidence: Evidence, scope: Scope) -> tuple[np.ndarray, int]:
    """Return (n,) int64 number of each label's group, and the number of groups."""
    if scope == "round":
        return np.zeros(len(evidence), dtype=np.int64), 1
    if scope == "frame":
        names, group = np.unique(evidence.frame_index, return_inverse=True)
        return group, len(names)
    return _number_categories(evidence.category)


def _number_categories(category: np.ndarray) -> tuple[np.ndarray, int]:
    """Return (n,) the group of each category, and the number of groups.

    Unlike np.unique, this does not sort millions of strings with a few distinct values.
    """
    group = np.full(len(category), -1, dtype=np.int64)
    groups = 0
    while True:
        first = np.argmax(group < 0) if len(group) else 0
        if not len(group) or group[first] >= 0:
            return group, groups
        group[category == category[first]] = groups
        groups += 1


def _maximum(loss: np.ndarray, member: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return (g,) largest loss of each group, NaN for an empty group."""
    largest = np.where(count > 0, -np.inf, np.nan)
    np.maximum.at(largest, member, loss)
    return largest


def _quantile(
    loss: np.ndarray, member: np.ndarray, count: np.ndarray, quantile: float
) -> np.ndarray:
    """Return (g,) linearly interpolated quantile of each group's losses, NaN for an empty group."""
    if len(count) == 1:
        return np.array([np.quantile(loss, quantile) if len(loss) else np.nan])
    ordered = loss[np.lexsort((loss, member))]
    start = np.cumsum(count) - count
    position = quantile * np.maximum(count - 1, 0)
    below = np.floor(position).astype(np.int64)
    above = np.minimum(below + 1, np.maximum(count - 1, 0))
    quantiles = np.full(len(count), np.nan)
    filled = count > 0
    low, high = ordered[(start + below)[filled]], ordered[(start + above)[filled]]
    quantiles[filled] = low + (position - below)[filled] * (high - low)
    return quantiles
