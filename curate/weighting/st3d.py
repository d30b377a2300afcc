"""ST3D: confidence bands to keep, ignore or drop a label, stabilised by a memory bank.

Source: Yang et al., "ST3D: Self-Training for Unsupervised Domain Adaptation on 3D Object
Detection", CVPR 2021: the quality-aware triplet memory bank with its consistency ensemble.

Difference to the paper: there the more confident of the stored and the current box becomes the
label, and a stored box can stay without a current prediction. Here every label is a prediction of
this round's teacher with its own box; the higher of the two confidences selects its band.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from curate.errors import ConfigError
from curate.geometry.overlap import overlapping_pairs
from curate.ranges import PositiveShare, Share
from curate.weighting.base import Age, Evidence, Memory, Policy, Weights, ZeroWeight

Confidence = Literal["score", "iou"]


@dataclass(frozen=True)
class ST3D(Policy):
    """Keeps (v = 1), ignores (v = 0) or drops a label by its confidence.

    Attributes:
        keep: lowest confidence of kept labels, in [0, 1].
        ignore: lowest confidence of ignored labels; labels below it are dropped.
        confidence: "score" for the label's score, or "iou" for the detector's IoU estimate, as in
            the paper.
        minimum_iou: lowest 3D IoU of a label and a stored one that count as the same object.
    """

    keep: Share = 0.6
    ignore: Share = 0.25
    confidence: Confidence = "score"
    minimum_iou: PositiveShare = 0.1
    name: ClassVar[str] = "st3d"
    remembers: ClassVar[bool] = True
    zero_weight: ClassVar[ZeroWeight] = "ignore"

    def __post_init__(self) -> None:
        """Raise ConfigError if a setting is invalid."""
        if not 0 <= self.ignore <= self.keep <= 1:
            raise ConfigError(
                f"policy st3d: ignore {self.ignore} and keep {self.keep} must be ascending and in "
                "[0, 1]"
            )
        if self.confidence not in get_args(Confidence):
            raise ConfigError(
                f"policy st3d: unknown confidence {self.confidence!r}; choose score or iou"
            )
        if not 0 < self.minimum_iou <= 1:
            raise ConfigError(f"policy st3d: minimum_iou must be in (0, 1], not {self.minimum_iou}")

    def weigh(self, evidence: Evidence, age: Age) -> Weights:  # noqa: ARG002 - has no age
        """Return weight 1 or 0 for every label, and the dropped labels.

        Raises:
            ConfigError: if `confidence` is "iou" and a label has no IoU estimate.
        """
        confidence = self._confidence(evidence)
        if evidence.memory is not None:
            stored_confidence = self._confidence(evidence.memory)
            rows, stored = _matches(evidence, evidence.memory, self.minimum_iou)
            confidence[rows] = np.maximum(confidence[rows], stored_confidence[stored])
        return Weights(
            (confidence >= self.keep).astype(np.float64),
            np.full(len(evidence), np.nan),
            confidence < self.ignore,
        )

    def _confidence(self, labels: Evidence | Memory) -> np.ndarray:
        """Return (n,) a copy of the confidence column."""
        if self.confidence == "score":
            return labels.score.copy()
        if np.isnan(labels.iou).any():
            raise ConfigError(
                "policy st3d: the detector does not estimate the IoU; set confidence to score"
            )
        return labels.iou.copy()


def _matches(
    evidence: Evidence, memory: Memory, minimum_iou: PositiveShare
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of labels and of stored labels that are each other's best match by 3D IoU.

    Only labels of the same category and frame match.
    """
    keys = [
        np.char.add(np.char.add(category, "/"), frame.astype(np.str_))
        for category, frame in (
            (evidence.category, evidence.frame_index),
            (memory.category, memory.frame_index),
        )
    ]
    names, group = np.unique(np.concatenate(keys), return_inverse=True)
    groups = np.split(group, [len(evidence)])
    orders = [np.argsort(each, kind="stable") for each in groups]
    edges = np.arange(len(names) + 1)
    starts = [
        np.searchsorted(each[order], edges) for each, order in zip(groups, orders, strict=True)
    ]
    rows, stored, _, overlap = overlapping_pairs(
        evidence.boxes[orders[0]], starts[0], memory.boxes[orders[1]], starts[1]
    )
    rows, stored = orders[0][rows], orders[1][stored]
    best = (overlap >= minimum_iou) & _is_best(rows, overlap) & _is_best(stored, overlap)
    return rows[best], stored[best]


def _is_best(rows: np.ndarray, overlap: np.ndarray) -> np.ndarray:
    """Return (pairs,) bool: whether a pair has the greatest overlap of all pairs with its row."""
    greatest = np.zeros(int(rows.max(initial=-1)) + 1)
    np.maximum.at(greatest, rows, overlap)
    return np.asarray(overlap == greatest[rows])
