"""Weight 1 for every label: unfiltered pseudo-labels, as in UDA, and in SESS with a mean teacher.

Sources: Xie et al., "Unsupervised Data Augmentation for Consistency Training", NeurIPS 2020; Zhao
et al., "SESS: Self-Ensembling Semi-Supervised 3D Object Detection", CVPR 2020.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from curate.weighting.base import Age, Evidence, Policy, Weights


@dataclass(frozen=True)
class Uniform(Policy):
    """v = 1 for every label."""

    name: ClassVar[str] = "uniform"
    reads: ClassVar[tuple[str, ...]] = ()

    def weigh(self, evidence: Evidence, age: Age) -> Weights:  # noqa: ARG002 - has no age
        """Return weight 1 for every label."""
        return Weights.without_age(np.ones(len(evidence)))
