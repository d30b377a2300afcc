"""ST3D: bands of confidence to keep, ignore or drop a label, steadied by what is remembered.

Source: Yang et al., "ST3D: Self-Training for Unsupervised Domain Adaptation on 3D Object
Detection", CVPR 2021: the quality-aware triplet memory bank with its consistency ensemble. There
the better of the remembered and the present box becomes the label, and a remembered box can outlive
the detector's answer. Here every label is an answer of this round's teacher: its box stays, and the
better of the two confidences decides its band.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from curate.errors import ConfigError
from curate.geometry.overlap import overlapping_pairs
from curate.weighting.base import Age, Evidence, Memory, Policy, Weights, ZeroWeight

Confidence = Literal["score", "iou"]


@dataclass(frozen=True)
class ST3D(Policy):
    """Keeps (v = 1), ignores (v = 0) or drops a label by its confidence.

    Attributes:
        keep: least confidence to be kept, in [0, 1].
        ignore: least confidence to be ignored; below it a label is dropped.
        confidence: the label's "score", or the detector's estimate of its "iou", as in the paper.
        minimum_iou: 3D IoU from which a remembered label is taken for the same object.
    """

    keep: float = 0.6
    ignore: float = 0.25
    confidence: Confidence = "score"
    minimum_iou: float = 0.1
    name: ClassVar[str] = "st3d"
    remembers: ClassVar[bool] = True
    zero_weight: ClassVar[ZeroWeight] = "ignore"

    def __post_init__(self) -> None:
        """Raise ConfigError for a setting without meaning."""
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
        """1 or 0 for every label, and which are dropped.

        Raises:
            ConfigError: if the confidence is to be the IoU, and the detector estimates none.
        """
        confidence = self._confidence(evidence)
        if evidence.memory is not None:
            past = self._confidence(evidence.memory)
            rows, remembered = _matches(evidence, evidence.memory, self.minimum_iou)
            confidence[rows] = np.maximum(confidence[rows], past[remembered])
        return Weights(
            (confidence >= self.keep).astype(np.float64),
            np.full(len(evidence), np.nan),
            confidence < self.ignore,
        )

    def _confidence(self, labels: Evidence | Memory) -> np.ndarray:
        """Return (n,) a copy of the column that decides."""
        if self.confidence == "score":
            return labels.score.copy()
        if np.isnan(labels.iou).any():
            raise ConfigError(
                "policy st3d: the detector estimates no IoU; set its confidence to score"
            )
        return labels.iou.copy()


def _matches(
    evidence: Evidence, memory: Memory, minimum_iou: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of labels and of the remembered ones that are each other's best match by 3D IoU."""
    keys = [
        np.char.add(np.char.add(of_category, "/"), of_frame.astype(np.str_))
        for of_category, of_frame in (
            (evidence.category, evidence.frame_index),
            (memory.category, memory.frame_index),
        )
    ]
    groups, member = np.unique(np.concatenate(keys), return_inverse=True)
    member_of = np.split(member, [len(evidence)])
    orders = [np.argsort(own, kind="stable") for own in member_of]
    edges = np.arange(len(groups) + 1)
    starts = [
        np.searchsorted(own[order], edges) for own, order in zip(member_of, orders, strict=True)
    ]
    rows, remembered, _, overlap = overlapping_pairs(
        evidence.boxes[orders[0]], starts[0], memory.boxes[orders[1]], starts[1]
    )
    rows, remembered = orders[0][rows], orders[1][remembered]
    best = (overlap >= minimum_iou) & _is_best(rows, overlap) & _is_best(remembered, overlap)
    return rows[best], remembered[best]


def _is_best(of: np.ndarray, overlap: np.ndarray) -> np.ndarray:
    """Which pairs have the greatest overlap among those of the same row."""
    greatest = np.zeros(int(of.max(initial=-1)) + 1)
    np.maximum.at(greatest, of, overlap)
    return np.asarray(overlap == greatest[of])
