"""Score threshold: weight 1 or 0."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from curate.errors import ConfigError
from curate.ranges import Share
from curate.shapes import Float
from curate.weighting.base import Age, Evidence, Policy, Weights


@dataclass(frozen=True)
class Threshold(Policy):
    """v = 1 if the score is at least the threshold, else 0.

    Attributes:
        threshold: score threshold, in [0, 1].
        per_category: thresholds of categories that differ from `threshold`.
    """

    threshold: Share = 0.3
    per_category: Mapping[str, Share] = field(default_factory=dict)
    name: ClassVar[str] = "threshold"
    reads: ClassVar[tuple[str, ...]] = ("category", "score")

    def __post_init__(self) -> None:
        """Raise ConfigError if a threshold is not in [0, 1]."""
        check_share(self.name, "threshold", {"every category": self.threshold, **self.per_category})

    def weigh(self, evidence: Evidence, age: Age) -> Weights:  # noqa: ARG002 - has no age
        """Return weight 1 or 0 for every label."""
        threshold = by_category(evidence, self.threshold, self.per_category)
        return Weights.without_age((evidence.score >= threshold).astype(np.float64))


def by_category(
    evidence: Evidence, default: float, per_category: Mapping[str, float]
) -> Float[np.ndarray, " n"]:
    """Return (n,) threshold of each label: that of its category, otherwise the default."""
    threshold = np.full(len(evidence), default)
    for category, value in per_category.items():
        threshold[evidence.category == category] = value
    return threshold


def check_share(policy: str, setting: str, values: Mapping[str, float]) -> None:
    """Check that values are in [0, 1].

    Args:
        policy: name of the policy, for the message.
        setting: name of the setting, for the message.
        values: values by category.

    Raises:
        ConfigError: if a value is not in [0, 1].
    """
    for category, value in values.items():
        if not 0 <= value <= 1:
            raise ConfigError(
                f"policy {policy}: {setting} for {category} must be in [0, 1], not {value}"
            )
