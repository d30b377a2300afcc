"""SPSL-3D and PSPSL-3D: easy labels first, harder ones as the detector grows (Eqs. 4, 7, 11).

Source: An et al., Remote Sensing 15(3):627, 2023. Eq. 7 minimises v L + lambda (v^2 / 2 - v) over v
in [0, 1]. Eq. 11 minimises the same with v / rho in place of v, over v in [0, rho].
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from curate.errors import ConfigError
from curate.shapes import Float
from curate.weighting.base import Age, Evidence, Policy, Weights

Scope = Literal["round", "category", "frame"]


@dataclass(frozen=True)
class SPSL(Policy):
    """v = 1 - L / lambda where L < lambda, else 0 (Eq. 7).

    Attributes:
        scope: the labels that share one lambda: all of the round, those of a category, or those of
            a frame (the paper's batch of one; a frame's hardest label then always weighs 0 in the
            last round, and so does the only label of a frame in every round).
        quantile: of the losses, in place of their maximum, in (0, 1]; None for the maximum.
    """

    scope: Scope = "round"
    quantile: float | None = None
    name: ClassVar[str] = "spsl"

    def __post_init__(self) -> None:
        """Raise ConfigError for a setting without meaning."""
        if self.scope not in get_args(Scope):
            known = ", ".join(get_args(Scope))
            raise ConfigError(
                f"policy {self.name}: unknown scope {self.scope!r}; choose one of {known}"
            )
        if self.quantile is not None and not 0 < self.quantile <= 1:
            raise ConfigError(
                f"policy {self.name}: quantile must be in (0, 1], not {self.quantile}"
            )

    @property
    def reads(self) -> tuple[str, ...]:
        """The columns that it looks at."""
        return ("loss", "category") if self.scope == "category" else ("loss",)

    def weigh(self, evidence: Evidence, age: Age) -> Weights:
        """Return the weight of every label; 0 where no reprediction matched."""
        lambda_u = age_parameter(evidence, age, self.scope, self.quantile)
        return Weights(easiness(evidence.loss, lambda_u), lambda_u)


@dataclass(frozen=True)
class PSPSL(SPSL):
    """v = rho_det * (1 - L / lambda) where L < lambda, else 0 (Eq. 11).

    Attributes:
        self_paced: false leaves the factor 1 - L / lambda out: v = rho_det of every label that
            matched, to see what the schedule is good for; of every label where none of the round
            matched, for a detector without a second pass.
    """

    self_paced: bool = True
    name: ClassVar[str] = "pspsl"

    def weigh(self, evidence: Evidence, age: Age) -> Weights:
        """Return the weight of every label; 0 where no reprediction matched."""
        if not self.self_paced:
            asked = evidence.matched | (not evidence.matched.any())
            return Weights.without_age(np.where(asked, evidence.rho_det, 0.0))
        lambda_u = age_parameter(evidence, age, self.scope, self.quantile)
        return Weights(evidence.rho_det * easiness(evidence.loss, lambda_u), lambda_u)


def easiness(
    loss: Float[np.ndarray, " n"], lambda_u: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return (n,) 1 - L / lambda where L < lambda, else 0 (Eq. 7); 0 where L is NaN.

    At lambda = 0 every v minimises the objective of a label with L = 0. It gets 1, the limit from
    above: such a label is as easy as can be.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        v = np.where(loss < lambda_u, 1.0 - loss / lambda_u, 0.0)
    return np.where((loss == 0) & (lambda_u == 0), 1.0, v)


def age_parameter(
    evidence: Evidence, age: Age, scope: Scope = "round", quantile: float | None = None
) -> Float[np.ndarray, " n"]:
    """Return (n,) lambda = (e/E) max(L) + (1 - e/E) mean(L) of each label's group (Eq. 4).

    Unmatched labels do not count; they get their group's lambda, NaN in a group without a match.
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
    # Rounding can lift the mean of equal losses above them all, and would let them pass.
    lambda_u: np.ndarray = np.minimum(parameter, maximum)[group]
    return lambda_u


def _group(evidence: Evidence, scope: Scope) -> tuple[np.ndarray, int]:
    """Return (n,) int64 number of each label's group, and how many groups there are."""
    if scope == "round":
        return np.zeros(len(evidence), dtype=np.int64), 1
    if scope == "frame":
        names, group = np.unique(evidence.frame_index, return_inverse=True)
        return group, len(names)
    return _number_categories(evidence.category)


def _number_categories(category: np.ndarray) -> tuple[np.ndarray, int]:
    """Like np.unique's inverse, without sorting millions of strings that take a few values."""
    group = np.full(len(category), -1, dtype=np.int64)
    groups = 0
    while True:
        rest = np.argmax(group < 0) if len(group) else 0
        if not len(group) or group[rest] >= 0:
            return group, groups
        group[category == category[rest]] = groups
        groups += 1


def _maximum(loss: np.ndarray, member: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return (g,) largest loss of each group, NaN where it has none."""
    largest = np.where(count > 0, -np.inf, np.nan)
    np.maximum.at(largest, member, loss)
    return largest


def _quantile(
    loss: np.ndarray, member: np.ndarray, count: np.ndarray, quantile: float
) -> np.ndarray:
    """Return (g,) linearly interpolated quantile of each group's losses, NaN where it has none."""
    if len(count) == 1:
        return np.array([np.quantile(loss, quantile) if len(loss) else np.nan])
    ordered = loss[np.lexsort((loss, member))]
    start = np.cumsum(count) - count
    position = quantile * np.maximum(count - 1, 0)
    below = np.floor(position).astype(np.int64)
    above = np.minimum(below + 1, np.maximum(count - 1, 0))
    answer = np.full(len(count), np.nan)
    some = count > 0
    low, high = ordered[(start + below)[some]], ordered[(start + above)[some]]
    answer[some] = low + (position - below)[some] * (high - low)
    return answer
