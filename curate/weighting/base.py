"""Interface of curation policies: evidence of a round's labels in, weights out."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Literal, Protocol

import numpy as np

from curate.detections import empty_boxes
from curate.errors import ConfigError, DataError
from curate.shapes import Bool, Float, Int, Shaped

ZeroWeight = Literal["background", "ignore"]
"""Meaning of a label of weight 0 for the student.

"background": the label is left out, so its region is trained as background. Nearly all labels of
weight 0 are wrong. "ignore": the region is neither object nor background; used by policies with an
explicit band of doubt.
"""


@dataclass(frozen=True)
class Age:
    """Position in the self-paced schedule: round e of E.

    Attributes:
        round: number e of the round, from 1.
        rounds: number of rounds E.
    """

    round: int
    rounds: int

    def __post_init__(self) -> None:
        """Raise ConfigError unless 1 <= e <= E."""
        if not 1 <= self.round <= self.rounds:
            raise ConfigError(
                f"round {self.round} of {self.rounds} does not exist; "
                "rounds are numbered from 1 to the number of rounds",
            )

    @property
    def share(self) -> float:
        """Completed share of the schedule, e / E in (0, 1]."""
        return self.round / self.rounds


@dataclass(frozen=True)
class Memory:
    """The n labels of the previous round that the same policy did not drop, as aligned columns.

    Attributes:
        frame_index: (n,) integer, with the same numbering as in the evidence.
        category: (n,) str.
        score: (n,) in [0, 1].
        iou: (n,) as in `Evidence`.
        boxes: (n, 7) in the LiDAR frame.
        v: (n,) weight that the policy gave.
    """

    frame_index: Int[np.ndarray, " n"]
    category: Shaped[np.ndarray, " n"]
    score: Float[np.ndarray, " n"]
    iou: Float[np.ndarray, " n"]
    boxes: Float[np.ndarray, "n 7"]
    v: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Evidence:
    """Evidence for the n labels of a round, over all its frames, as aligned columns.

    Attributes:
        frame_index: (n,) integer number of the label's frame; any numbering.
        category: (n,) str.
        score: (n,) in [0, 1].
        loss: (n,) consistency loss L, not negative; NaN if no reprediction matched.
        rho: (n,) trust of each prior by column name ("rho_diff", "rho_anno"), in [0, 1]; NaN if the
            prior has not scored the label.
        iou: (n,) the detector's estimate of the label's 3D IoU with its object, in [0, 1]; NaN if
            there is no estimate. All NaN by default.
        probability: (n,) probability that the label is correct, by a calibration of this round, in
            [0, 1]. All NaN by default.
        p_value: (n,) conformal p-value of the hypothesis that the label is wrong, in [0, 1]. All
            NaN by default.
        boxes: (n, 7) in the LiDAR frame; needed only with a memory.
        unseen: (n,) bool, labels without image evidence, which must not outweigh the others. By
            default there are none.
        memory: the policy's labels of the previous round, for policies with `remembers`; None in
            the first round.
    """

    frame_index: np.ndarray
    category: np.ndarray
    score: np.ndarray
    loss: np.ndarray
    rho: Mapping[str, np.ndarray] = field(default_factory=dict)
    iou: np.ndarray = field(default_factory=lambda: np.zeros(0))
    boxes: np.ndarray = field(default_factory=empty_boxes)
    memory: Memory | None = None
    unseen: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    probability: np.ndarray = field(default_factory=lambda: np.zeros(0))
    p_value: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Raise DataError if a column is not aligned or out of its range."""
        for name in ("iou", "probability", "p_value"):
            if len(getattr(self, name)) == 0:
                object.__setattr__(self, name, np.full(len(self.loss), np.nan))
        if len(self.unseen) == 0:
            object.__setattr__(self, "unseen", np.zeros(len(self.loss), dtype=bool))
        if self.memory is not None and len(self.boxes) != len(self.loss):
            raise DataError("evidence: a memory was given without the boxes of the labels")
        columns = {
            "frame_index": self.frame_index,
            "category": self.category,
            "unseen": self.unseen,
            **self._numbers(),
        }
        for name, column in columns.items():
            if column.shape != (len(self.loss),):
                raise DataError(
                    f"evidence: column {name} has shape {column.shape}, loss has "
                    f"{len(self.loss)} labels; give one value per label",
                )
        for name, column in self._numbers().items():
            limit = np.finfo(np.float64).max if name == "loss" else 1.0
            invalid = np.flatnonzero((column < 0) | (column > limit))
            if len(invalid):
                raise DataError(
                    f"evidence: {name} of label {invalid[0]} is {column[invalid[0]]}; "
                    f"it must be between 0 and {limit:g}",
                )

    def __len__(self) -> int:
        return len(self.loss)

    @property
    def matched(self) -> Bool[np.ndarray, " n"]:
        """(n,) bool, true if a reprediction matched the label."""
        return np.asarray(~np.isnan(self.loss))

    @cached_property
    def rho_det(self) -> Float[np.ndarray, " n"]:
        """(n,) product of the priors that scored the label; 1 if none did."""
        product = np.ones(len(self))
        for rho in self.rho.values():
            product *= np.where(np.isnan(rho), 1.0, rho)
        return product

    def _numbers(self) -> dict[str, np.ndarray]:
        """Return the numeric columns that have a range."""
        return {
            "score": self.score,
            "loss": self.loss,
            "iou": self.iou,
            "probability": self.probability,
            "p_value": self.p_value,
            **self.rho,
        }


@dataclass(frozen=True)
class Weights:
    """Weights of the n labels of a round.

    Attributes:
        v: (n,) float64 weight in [0, 1]; `Policy.zero_weight` defines the meaning of 0.
        lambda_u: (n,) age parameter lambda of the label's group; NaN if the policy has none, or no
            label of the group matched.
        dropped: (n,) bool, labels that are not stored at all: their region is background, whatever
            a weight of 0 means. v must be 0 for a dropped label. By default no label is dropped.
        remark: what the user should know of these weights, such as a setting that is out of reach;
            "" for nothing.
    """

    v: Float[np.ndarray, " n"]
    lambda_u: Float[np.ndarray, " n"]
    dropped: Bool[np.ndarray, " n_or_0"] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    remark: str = ""

    def __post_init__(self) -> None:
        """Set the default of `dropped`."""
        if len(self.dropped) == 0:
            object.__setattr__(self, "dropped", np.zeros(len(self.v), dtype=bool))

    @classmethod
    def without_age(cls, v: Float[np.ndarray, " n"], remark: str = "") -> "Weights":
        """Return weights without an age parameter: lambda_u is NaN."""
        return cls(v, np.full(len(v), np.nan), remark=remark)


class Policy(Protocol):
    """Computes the weights of the labels of a round.

    A policy inherits from this class and overrides the defaults that differ.
    """

    name: ClassVar[str]
    """Name of the policy; stored with the weights."""
    uses_unlabeled: ClassVar[bool] = True
    """False if a student of this policy trains on X_l only."""
    zero_weight: ClassVar[ZeroWeight] = "background"
    """Meaning of a label of weight 0 for the student."""
    remembers: ClassVar[bool] = False
    """Whether the policy needs `Evidence.memory`."""

    @property
    def reads(self) -> tuple[str, ...]:
        """Return the columns of `Evidence` that the policy reads; others may be NaN or "".

        A policy that reads "probability" or "p_value" needs a calibration of the round.
        """
        return ("category", "score", "iou", "loss")

    def weigh(self, evidence: Evidence, age: Age) -> Weights:
        """Return the weight of every label, in the order of the evidence."""
        ...
