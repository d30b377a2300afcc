"""3DIoUMatch: thresholds on both the score and the estimated IoU of a label.

Source: Wang et al., "3DIoUMatch: Leveraging IoU Prediction for Semi-Supervised 3D Object
Detection", CVPR 2021. The authors' thresholds for KITTI are a class probability of 0.4, and an IoU
of 0.5 for cars, 0.25 for pedestrians and cyclists. A one-stage detector has one score per category;
it replaces both objectness and class probability.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from curate.errors import ConfigError
from curate.ranges import Share
from curate.weighting.base import Age, Evidence, Policy, Weights
from curate.weighting.threshold import by_category, check_share


@dataclass(frozen=True)
class IoUMatch(Policy):
    """v = 1 if both the score and the IoU estimate reach their thresholds, else 0.

    Attributes:
        score: threshold of the score, in [0, 1].
        iou: threshold of the estimated 3D IoU, in [0, 1].
        score_per_category: score thresholds of categories that differ from `score`.
        iou_per_category: IoU thresholds of categories that differ from `iou`.
    """

    score: Share = 0.4
    iou: Share = 0.25
    score_per_category: Mapping[str, Share] = field(default_factory=dict)
    iou_per_category: Mapping[str, Share] = field(default_factory=lambda: {"Car": 0.5})
    name: ClassVar[str] = "3dioumatch"

    def __post_init__(self) -> None:
        """Raise ConfigError if a threshold is not in [0, 1]."""
        check_share(self.name, "score", {"every category": self.score, **self.score_per_category})
        check_share(self.name, "iou", {"every category": self.iou, **self.iou_per_category})

    def weigh(self, evidence: Evidence, age: Age) -> Weights:  # noqa: ARG002 - has no age
        """Return weight 1 or 0 for every label.

        Raises:
            ConfigError: if a label has no IoU estimate.
        """
        missing = int(np.isnan(evidence.iou).sum())
        if missing:
            raise ConfigError(
                f"policy {self.name}: {missing} of {len(evidence)} labels have no IoU estimate; "
                "use a detector that estimates the IoU, such as pillars, or another policy"
            )
        kept = evidence.score >= by_category(evidence, self.score, self.score_per_category)
        kept &= evidence.iou >= by_category(evidence, self.iou, self.iou_per_category)
        return Weights.without_age(kept.astype(np.float64))
