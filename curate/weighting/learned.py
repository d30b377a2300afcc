"""Weights from the probability that a label is correct, with a precision or a bound to ask for.

The probability p comes from a calibration of the round: a logistic regression over the evidence,
fitted to labels with known truth, see `curate.calibration`.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt, Lt

from curate.calibration.conformal import benjamini_hochberg, least_bound
from curate.calibration.sharpening import sharpen
from curate.errors import ConfigError
from curate.weighting.base import Age, Evidence, Policy, Weights

OpenShare = Annotated[float, Gt(0), Lt(1)]
# A precision that is missed by less counts as reached.
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Learned(Policy):
    """v = p^gamma; with `max_wrong`, v = 1 for the selected labels and 0 for the others.

    Attributes:
        precision: requested weighted precision, in (0, 1). Gamma is at least 1 and such that the
            expected precision of the weights, sum(p v) / sum(v), equals it. Weights below 0.01 are
            0.
        max_wrong: largest expected share of wrong labels among the selected ones, in (0, 1); None
            for weights by `precision`.
    """

    precision: OpenShare = 0.8
    max_wrong: OpenShare | None = None
    name: ClassVar[str] = "learned"

    def __post_init__(self) -> None:
        """Raise ConfigError if a setting is not in (0, 1)."""
        for setting, value in (("precision", self.precision), ("max_wrong", self.max_wrong)):
            if value is not None and not 0 < value < 1:
                raise ConfigError(
                    f"policy {self.name}: {setting} must be above 0 and below 1, not {value}"
                )

    @property
    def reads(self) -> tuple[str, ...]:
        """The columns of `Evidence` that the policy reads."""
        return ("probability",) if self.max_wrong is None else ("probability", "p_value")

    def weigh(self, evidence: Evidence, age: Age) -> Weights:  # noqa: ARG002 - has no age
        """Return the weight of every label, and whether the requested precision is reached.

        Raises:
            ConfigError: if a label has no probability, or no p-value with `max_wrong`.
        """
        for column in self.reads:
            missing = int(np.isnan(getattr(evidence, column)).sum())
            if missing:
                raise ConfigError(
                    f"policy {self.name}: {missing} of {len(evidence)} labels have no {column}; "
                    "run `curate calibrate`"
                )
        if self.max_wrong is None:
            return self._weighted(evidence, self.precision)
        return self._selected(evidence, self.max_wrong)

    def _weighted(self, evidence: Evidence, precision: float) -> Weights:
        sharpening = sharpen(evidence.probability, precision)
        remark = f"gamma {sharpening.gamma:.3g}, expected precision {sharpening.precision:.3g}"
        if sharpening.precision < precision - _TOLERANCE:
            remark += f": {precision:g} is out of reach"
        return Weights.without_age(
            sharpening.weights(evidence.probability), remark if len(evidence) else ""
        )

    def _selected(self, evidence: Evidence, max_wrong: float) -> Weights:
        selected = benjamini_hochberg(evidence.p_value, max_wrong)
        remark = f"at most {max_wrong:g} of those with weight 1 are expected to be wrong"
        if not selected.any():
            remark = (
                f"max_wrong {max_wrong:g} is out of reach; the least bound that selects a label is "
                f"{least_bound(evidence.p_value):.3g}"
            )
        return Weights.without_age(selected.astype(np.float64), remark if len(evidence) else "")
