"""HSSDA: two thresholds, set by the data, sort labels into sure, ambiguous and poor ones.

Source: Liu et al., "Hierarchical Supervision and Shuffle Data Augmentation for 3D Semi-Supervised
Object Detection", CVPR 2023: of each measure of confidence the two centres of a 2-means clustering,
per category and round, are its high and its low threshold. There the clusters are of predictions
that hit labeled objects. A teacher knows the labeled frames by heart, and its scores there say
little of its scores elsewhere, so here they are of the pseudo-labels that the teacher gave again
for the augmented copy. The measures are the score and the agreement exp(-L) with that copy.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from curate.errors import ConfigError
from curate.shapes import Float
from curate.weighting.base import Age, Evidence, Policy, Weights, ZeroWeight

Ambiguous = Literal["soft", "ignore"]
# With fewer labels there is nothing to cluster.
_FEWEST_LABELS = 3


@dataclass(frozen=True)
class HSSDA(Policy):
    """v = 1 above both high thresholds; dropped below a low one; between them in doubt.

    A label that did not match its augmented copy has no agreement at all and is dropped. In a
    category with fewer than three matched labels all matched ones are in doubt.

    Attributes:
        ambiguous: what a label in doubt weighs: "soft" its score, "ignore" nothing.
    """

    ambiguous: Ambiguous = "soft"
    name: ClassVar[str] = "hssda"
    zero_weight: ClassVar[ZeroWeight] = "ignore"

    def __post_init__(self) -> None:
        """Raise ConfigError for a setting without meaning."""
        if self.ambiguous not in get_args(Ambiguous):
            raise ConfigError(
                f"policy hssda: unknown ambiguous {self.ambiguous!r}; choose soft or ignore"
            )

    def weigh(self, evidence: Evidence, age: Age) -> Weights:  # noqa: ARG002 - has no age
        """1, the score or 0 for every label, and which are dropped."""
        sure, poor = evidence.matched, ~evidence.matched
        for measure in (evidence.score, np.exp(-evidence.loss)):
            for category in np.unique(evidence.category):
                own = evidence.category == category
                low, high = two_centres(measure[own & evidence.matched])
                poor[own] |= measure[own] < low
                sure[own] &= measure[own] >= high
        doubt = evidence.score if self.ambiguous == "soft" else np.zeros(len(evidence))
        v = np.where(sure, 1.0, np.where(poor, 0.0, doubt))
        return Weights(v, np.full(len(evidence), np.nan), poor)


def two_centres(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the means of the two clusters of (n,) values that have the least variance within.

    In one dimension the best clusters are separated by a threshold, so all n - 1 of them are tried,
    and the answer does not depend on a start. Fewer than three values answer (-inf, inf).
    """
    if len(values) < _FEWEST_LABELS:
        return -np.inf, np.inf
    ordered = np.sort(values)
    count = np.arange(1, len(ordered))
    total = np.cumsum(ordered)
    left = total[:-1] / count
    right = (total[-1] - total[:-1]) / (len(ordered) - count)
    # Variance within is least where that between the clusters is greatest.
    best = int(np.argmax(count * (len(ordered) - count) * (right - left) ** 2))
    # Rounding must not put the mean of equal values above or below them.
    low, high = (
        float(np.clip(cluster.mean(), cluster[0], cluster[-1]))
        for cluster in np.split(ordered, [best + 1])
    )
    return low, high
