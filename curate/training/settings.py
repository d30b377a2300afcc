"""The settings of a training and what it reports in the end."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from curate.errors import ConfigError
from curate.training.augmentation import Augmentation

Teacher = Literal["student", "ema"]


@dataclass(frozen=True)
class TrainingSettings:
    """How to train; the defaults suit a training from scratch on a few dozen labeled frames.

    Attributes:
        preset: one of the detector's presets; None for its first.
        steps: optimiser steps.
        batch_size: frames of X_l per step.
        unlabeled_batch_size: frames of X_u per step, besides: Eq. 6 adds the two sums, so pseudo-
            labels never take the place of ground truth.
        learning_rate: peak of the one-cycle schedule; about half of it suits fine-tuning.
        flip_probability: see `Augmentation`.
        rotation_limit_rad: see `Augmentation`.
        scale_range: see `Augmentation`.
        pasted: see `Augmentation`; 0 does without the object bank.
        fewest_points: see `Augmentation`; also of the objects of the bank.
        seed: of the first weights, the order of the frames and the augmentation.
        threads: of torch, on CPU.
        device: "cpu", or a torch device such as "cuda".
        teacher: what the training leaves: the "student", or the moving average of its weights,
            "ema".
        ema_decay: see `MovingAverage`.
        cache_bytes: of points kept in memory between the steps.
        snapshot_seconds: between two snapshots from which a killed training goes on.
        statistics_steps: between two steps of which statistics are kept.
    """

    preset: str | None = None
    steps: int = 1200
    batch_size: int = 2
    unlabeled_batch_size: int = 2
    learning_rate: float = 5e-3
    flip_probability: float = 0.5
    rotation_limit_rad: float = math.pi / 4
    scale_range: tuple[float, float] = (0.95, 1.05)
    pasted: int = 4
    fewest_points: int = 5
    seed: int = 0
    threads: int = 1
    device: str = "cpu"
    teacher: Teacher = "student"
    ema_decay: float = 0.999
    cache_bytes: int = 1 << 30
    snapshot_seconds: float = 20.0
    statistics_steps: int = 20

    def __post_init__(self) -> None:
        """Raise ConfigError for a setting that no training can use."""
        for name, least in (
            ("steps", 1), ("batch_size", 1), ("threads", 1), ("pasted", 0), ("seed", 0),
            ("fewest_points", 0), ("unlabeled_batch_size", 0), ("statistics_steps", 1),
        ):  # fmt: skip
            if getattr(self, name) < least:
                raise ConfigError(f"training: {name} is {getattr(self, name)}, least is {least}")
        if not self.learning_rate > 0:
            raise ConfigError(f"training: learning_rate is {self.learning_rate}, must be above 0")
        if not 0 < self.scale_range[0] <= self.scale_range[1]:
            raise ConfigError(f"training: scale_range {self.scale_range} is no range above 0")
        if not 0 <= self.ema_decay < 1:
            raise ConfigError(
                f"training: ema_decay is {self.ema_decay}, must be at least 0 and below 1"
            )
        if self.teacher not in get_args(Teacher):
            known = " or ".join(get_args(Teacher))
            raise ConfigError(f"training: unknown teacher {self.teacher!r}; choose {known}")

    def augmentation(self) -> Augmentation:
        """Return the augmentation that these settings describe."""
        return Augmentation(
            self.flip_probability,
            self.rotation_limit_rad,
            self.scale_range,
            self.pasted,
            self.fewest_points,
        )


@dataclass(frozen=True)
class Statistic:
    """A number that describes a step of a training.

    Attributes:
        step: from 1.
        name: "loss", one of its terms, "learning_rate" or "gradient_norm" (before clipping).
        value: at this step.
    """

    step: int
    name: str
    value: float


@dataclass(frozen=True)
class TrainingReport:
    """What a training did.

    Attributes:
        checkpoint: the file that was written.
        steps: optimiser steps in all.
        resumed_at: step at which it went on from an earlier, killed run; 0 where it began anew.
        loss: mean of the last steps.
        seconds: that this run took.
        labeled_frames: of X_l.
        unlabeled_frames: of X_u.
        bank: objects in the bank by category.
        statistics: of every `statistics_steps`-th step and the last one, also of those before a
            kill.
    """

    checkpoint: Path
    steps: int
    resumed_at: int
    loss: float
    seconds: float
    labeled_frames: int
    unlabeled_frames: int
    bank: dict[str, int]
    statistics: tuple[Statistic, ...]
