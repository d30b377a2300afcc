"""Baseline without pseudo-labels: the student trains again on X_l only, for comparison."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from curate.weighting.base import Age, Evidence, Policy, Weights


@dataclass(frozen=True)
class Baseline(Policy):
    """v = 0, and training uses no unlabeled frames."""

    name: ClassVar[str] = "baseline"
    uses_unlabeled: ClassVar[bool] = False
    reads: ClassVar[tuple[str, ...]] = ()

    def weigh(self, evidence: Evidence, age: Age) -> Weights:  # noqa: ARG002 - has no age
        """Return weight 0 for every label."""
        return Weights.without_age(np.zeros(len(evidence)))
