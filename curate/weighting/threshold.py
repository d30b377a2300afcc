"""The plain score threshold: a label counts fully or not at all."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from curate.errors import ConfigError
from curate.shapes import Float
from curate.weighting.base import Age, Evidence, Policy, Weights


@dataclass(frozen=True)
class Threshold(Policy):
    """v = 1 where the score is at least the threshold, else 0.

    Attributes:
        threshold: in [0, 1].
        per_category: thresholds of the categories that have their own.
    """

    threshold: float = 0.3
    per_category: Mapping[str, float] = field(default_factory=dict)
    name: ClassVar[str] = "threshold"
    reads: ClassVar[tuple[str, ...]] = ("category", "score")

    def __post_init__(self) -> None:
        """Raise ConfigError for a threshold that is no score."""
        check_share(self.name, "threshold", {"every category": self.threshold, **self.per_category})

    def weigh(self, evidence: Evidence, age: Age) -> Weights:  # noqa: ARG002 - has no age
        """1 or 0 for every label."""
        threshold = by_category(evidence, self.threshold, self.per_category)
        return Weights.without_age((evidence.score >= threshold).astype(np.float64))


def by_category(
    evidence: Evidence, every: float, own: Mapping[str, float]
) -> Float[np.ndarray, " n"]:
    """Return (n,) the threshold that holds for each label."""
    threshold = np.full(len(evidence), every)
    for category, value in own.items():
        threshold[evidence.category == category] = value
    return threshold


def check_share(policy: str, setting: str, values: Mapping[str, float]) -> None:
    """Raise ConfigError for a value outside [0, 1]."""
    for category, value in values.items():
        if not 0 <= value <= 1:
            raise ConfigError(
                f"policy {policy}: {setting} for {category} must be in [0, 1], not {value}"
            )
