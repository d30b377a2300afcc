"""UDA+CL: curriculum over unfiltered pseudo-labels, the easiest share first.

Source: An et al., Remote Sensing 15(3):627, 2023, where it is a baseline. UDA: Xie et al.,
"Unsupervised Data Augmentation for Consistency Training", NeurIPS 2020.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from curate.weighting.base import Age, Evidence, Policy, Weights


@dataclass(frozen=True)
class UDACurriculum(Policy):
    """v = 1 for the share e/E of the labels with the lowest consistency loss, else 0.

    A label that did not match its augmented copy is harder than all that did, so it gets weight 1
    only in the last round, as all labels do. Labels of equal loss get weight 1 together, once the
    share includes all of them.
    """

    name: ClassVar[str] = "uda-cl"
    reads: ClassVar[tuple[str, ...]] = ("loss",)

    def weigh(self, evidence: Evidence, age: Age) -> Weights:
        """Return weight 1 or 0 for every label."""
        loss = np.where(evidence.matched, evidence.loss, np.inf)
        rank = np.searchsorted(np.sort(loss), loss, side="right")
        # Integers avoid rounding: 1/3 of 3 labels is exactly 1 label.
        selected = rank * age.rounds <= len(loss) * age.round
        return Weights.without_age(selected.astype(np.float64))
