"""What every curation policy offers: a weight for each label of a round, from its evidence."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Literal, Protocol

import numpy as np

from curate.detections import empty_boxes
from curate.errors import ConfigError, DataError
from curate.shapes import Bool, Float, Int, Shaped

ZeroWeight = Literal["background", "ignore"]
"""What a label of weight 0 is to a student.

"background": no object, and its region teaches so; nearly all labels that get weight 0 are wrong.
"ignore": neither object nor background, for policies with an explicit band of doubt.
"""


@dataclass(frozen=True)
class Age:
    """How far the self-paced schedule has come: round e of E.

    Attributes:
        round: e, from 1.
        rounds: E.
    """

    round: int
    rounds: int

    def __post_init__(self) -> None:
        """Raise ConfigError unless 1 <= e <= E."""
        if not 1 <= self.round <= self.rounds:
            raise ConfigError(
                f"round {self.round} of {self.rounds} does not exist; "
                "a round counts from 1 to the number of rounds",
            )

    @property
    def share(self) -> float:
        """The share e / E, in (0, 1]."""
        return self.round / self.rounds


@dataclass(frozen=True)
class Memory:
    """The n labels of the previous round that the same policy did not drop, as aligned columns.

    Attributes:
        frame_index: (n,) integer, in the numbering of the evidence.
        category: (n,) str.
        score: (n,) in [0, 1].
        iou: (n,) as in `Evidence`.
        boxes: (n, 7) in the LiDAR frame.
        v: (n,) the weight that the policy gave.
    """

    frame_index: Int[np.ndarray, " n"]
    category: Shaped[np.ndarray, " n"]
    score: Float[np.ndarray, " n"]
    iou: Float[np.ndarray, " n"]
    boxes: Float[np.ndarray, "n 7"]
    v: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Evidence:
    """What is known of the n labels of a round, over all its frames, as aligned columns.

    Attributes:
        frame_index: (n,) integer, which frame a label belongs to; any numbering.
        category: (n,) str.
        score: (n,) in [0, 1].
        loss: (n,) consistency loss L, not negative; NaN where no reprediction matched.
        rho: (n,) trust of each prior by column name ("rho_diff", "rho_anno"), in [0, 1];
            NaN where a prior has not scored a label.
        iou: (n,) the detector's own estimate of the label's 3D IoU with its object, in [0, 1]; NaN
            where it makes none, and everywhere if left out.
        boxes: (n, 7) in the LiDAR frame; needed beside a memory only.
        memory: what the policy thought of the previous round, for policies that remember; None in
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

    def __post_init__(self) -> None:
        """Raise DataError where a column is not aligned or out of its range."""
        if len(self.iou) == 0:
            object.__setattr__(self, "iou", np.full(len(self.loss), np.nan))
        if self.memory is not None and len(self.boxes) != len(self.loss):
            raise DataError("evidence: a memory needs the boxes of the labels beside it")
        columns = {"frame_index": self.frame_index, "category": self.category, **self._numbers()}
        for name, column in columns.items():
            if column.shape != (len(self.loss),):
                raise DataError(
                    f"evidence: column {name} has shape {column.shape}, loss has "
                    f"{len(self.loss)} labels; give one value per label",
                )
        for name, column in self._numbers().items():
            limit = np.finfo(np.float64).max if name == "loss" else 1.0
            wrong = np.flatnonzero((column < 0) | (column > limit))
            if len(wrong):
                raise DataError(
                    f"evidence: {name} of label {wrong[0]} is {column[wrong[0]]}; "
                    f"it must be between 0 and {limit:g}",
                )

    def __len__(self) -> int:
        return len(self.loss)

    @property
    def matched(self) -> Bool[np.ndarray, " n"]:
        """(n,) bool, whether a reprediction matched."""
        return np.asarray(~np.isnan(self.loss))

    @cached_property
    def rho_det(self) -> Float[np.ndarray, " n"]:
        """(n,) product of the priors that scored a label; 1 where none did."""
        product = np.ones(len(self))
        for rho in self.rho.values():
            product *= np.where(np.isnan(rho), 1.0, rho)
        return product

    def _numbers(self) -> dict[str, np.ndarray]:
        """Return the columns that have a range."""
        return {"score": self.score, "loss": self.loss, "iou": self.iou, **self.rho}


@dataclass(frozen=True)
class Weights:
    """A policy's answer for the n labels of a round.

    Attributes:
        v: (n,) float64 weight in [0, 1]; what 0 means, the policy says: `Policy.zero_weight`.
        lambda_u: (n,) the age parameter that the label was held against; NaN where the policy has
            none, or where no label of the label's group matched.
        dropped: (n,) bool, labels that are not stored at all: their region is background, whatever
            a weight of 0 means. None, if left out; v is 0 where a label is dropped.
    """

    v: Float[np.ndarray, " n"]
    lambda_u: Float[np.ndarray, " n"]
    dropped: Bool[np.ndarray, " n_or_0"] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        """Fill in what was left out."""
        if len(self.dropped) == 0:
            object.__setattr__(self, "dropped", np.zeros(len(self.v), dtype=bool))

    @classmethod
    def without_age(cls, v: Float[np.ndarray, " n"]) -> "Weights":
        """Weights of a policy that has no age parameter."""
        return cls(v, np.full(len(v), np.nan))


class Policy(Protocol):
    """Weighs the labels of a round.

    A policy inherits from this class and overrides what differs from the values here.
    """

    name: ClassVar[str]
    """As it is stored beside the weights."""
    uses_unlabeled: ClassVar[bool] = True
    """False where a student of this policy trains on X_l alone."""
    zero_weight: ClassVar[ZeroWeight] = "background"
    """What a label of weight 0 is to the student."""
    remembers: ClassVar[bool] = False
    """Whether the policy needs `Evidence.memory`."""

    @property
    def reads(self) -> tuple[str, ...]:
        """Return which of these columns the policy reads; the others hold NaN or ""."""
        return ("category", "score", "iou", "loss")

    def weigh(self, evidence: Evidence, age: Age) -> Weights:
        """Return the weight of every label, in the order of the evidence."""
        ...
