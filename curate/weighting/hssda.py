"""HSSDA: two data-driven thresholds divide labels into confident, ambiguous and poor ones.

Source: Liu et al., "Hierarchical Supervision and Shuffle Data Augmentation for 3D Semi-Supervised
Object Detection", CVPR 2023. For each confidence measure, the two centres of a 2-means clustering
per category and round are the low and the high threshold. The measures here are the score and the
agreement exp(-L) with the augmented copy.

Difference to the paper: it clusters predictions that match labeled objects. The teacher was trained
on these frames, so its scores there say little about its scores on other frames. Here the clusters
are those of the pseudo-labels that matched their augmented copy.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from curate.errors import ConfigError
from curate.shapes import Float
from curate.weighting.base import Age, Evidence, Policy, Weights, ZeroWeight

Ambiguous = Literal["soft", "ignore"]
# Fewer labels are not clustered.
_FEWEST_LABELS = 3


@dataclass(frozen=True)
class HSSDA(Policy):
    """v = 1 at or above both high thresholds; dropped below a low one; ambiguous in between.

    A label that did not match its augmented copy has no agreement and is dropped. In a category
    with fewer than three matched labels, all matched ones are ambiguous.

    Attributes:
        ambiguous: weight of an ambiguous label: its score for "soft", 0 for "ignore".
    """

    ambiguous: Ambiguous = "soft"
    name: ClassVar[str] = "hssda"
    zero_weight: ClassVar[ZeroWeight] = "ignore"

    def __post_init__(self) -> None:
        """Raise ConfigError if a setting is invalid."""
        if self.ambiguous not in get_args(Ambiguous):
            raise ConfigError(
                f"policy hssda: unknown ambiguous {self.ambiguous!r}; choose soft or ignore"
            )

    def weigh(self, evidence: Evidence, age: Age) -> Weights:  # noqa: ARG002 - has no age
        """Return weight 1, the score or 0 for every label, and the dropped labels."""
        confident, poor = evidence.matched, ~evidence.matched
        for measure in (evidence.score, np.exp(-evidence.loss)):
            for category in np.unique(evidence.category):
                rows = evidence.category == category
                low, high = two_centres(measure[rows & evidence.matched])
                poor[rows] |= measure[rows] < low
                confident[rows] &= measure[rows] >= high
        ambiguous = evidence.score if self.ambiguous == "soft" else np.zeros(len(evidence))
        v = np.where(confident, 1.0, np.where(poor, 0.0, ambiguous))
        return Weights(v, np.full(len(evidence), np.nan), poor)


def two_centres(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the means of the two clusters of (n,) values with the least variance within clusters.

    In one dimension a threshold separates the best clusters. All n - 1 thresholds are tried, so the
    result does not depend on an initialisation. For fewer than three values it is (-inf, inf).
    """
    if len(values) < _FEWEST_LABELS:
        return -np.inf, np.inf
    ordered = np.sort(values)
    count = np.arange(1, len(ordered))
    total = np.cumsum(ordered)
    left = total[:-1] / count
    right = (total[-1] - total[:-1]) / (len(ordered) - count)
    # The variance within clusters is least if the variance between them is greatest.
    best = int(np.argmax(count * (len(ordered) - count) * (right - left) ** 2))
    # Clip: rounding must not move the mean of equal values above or below them.
    low, high = (
        float(np.clip(cluster.mean(), cluster[0], cluster[-1]))
        for cluster in np.split(ordered, [best + 1])
    )
    return low, high
