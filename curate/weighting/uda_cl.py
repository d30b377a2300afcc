"""UDA+CL: a curriculum over unfiltered pseudo-labels, the easiest share first.

Source: An et al., Remote Sensing 15(3):627, 2023, which compares against it; UDA is Xie et al.,
"Unsupervised Data Augmentation for Consistency Training", NeurIPS 2020.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from curate.weighting.base import Age, Evidence, Policy, Weights


@dataclass(frozen=True)
class UDACurriculum(Policy):
    """v = 1 for the e/E of the labels with the least consistency loss, else 0.

    A label that did not match its augmented copy is harder than any that did, so it counts in the
    last round alone, where all do. Labels of equal loss come in together, as soon as the share has
    room for all of them.
    """

    name: ClassVar[str] = "uda-cl"
    reads: ClassVar[tuple[str, ...]] = ("loss",)

    def weigh(self, evidence: Evidence, age: Age) -> Weights:
        """1 or 0 for every label."""
        loss = np.where(evidence.matched, evidence.loss, np.inf)
        as_easy = np.searchsorted(np.sort(loss), loss, side="right")
        # In integers: e/E of a third times three must be one.
        taken = as_easy * age.rounds <= len(loss) * age.round
        return Weights.without_age(taken.astype(np.float64))
