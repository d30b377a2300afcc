"""Settings and report of a training."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from curate.detectors.precision import FLOAT32, Precision
from curate.errors import ConfigError
from curate.ranges import AboveZero, AtLeastOne, Count, NotNegative, Share
from curate.training.augmentation import Augmentation

Teacher = Literal["student", "ema"]


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training; the defaults suit training from scratch on few labeled frames.

    Attributes:
        preset: one of the detector's presets; None selects the first.
        steps: number of optimiser steps.
        batch_size: frames of X_l per step.
        unlabeled_batch_size: frames of X_u per step, in addition to those of X_l. Eq. 6 adds the
            two sums, so pseudo-labels do not replace ground truth.
        learning_rate: peak of the one-cycle schedule; use about half of it for fine-tuning.
        flip_probability: see `Augmentation`.
        rotation_limit_rad: see `Augmentation`; a training of thousands of steps can afford more.
        scale_range: see `Augmentation`.
        pasted: see `Augmentation`; 0 disables the object bank.
        fewest_points: see `Augmentation`; applies to the objects of the bank too.
        seed: seed of the initial weights, the order of the frames and the augmentation.
        processes: number of processes that split each batch; at most the frames of a batch are
            used. The result is that of one process up to the rounding of sums.
        threads: number of torch threads of each process, on CPU.
        loaders: number of processes that prepare the batches ahead; 0 for none. It does not change
            the result. The processes are started with `multiprocessing`, so a script calls the
            training below `if __name__ == "__main__":`.
        device: "cpu", or a torch device such as "cuda".
        precision: type of numbers in which the network computes on the device: "float32",
            "bfloat16" or "float16" (with a scaled loss); weights and loss stay float32.
        teacher: the network that is saved: the "student", or the moving average of its weights,
            "ema".
        ema_decay: see `MovingAverage`.
        cache_bytes: size of the cache of points in memory.
        snapshot_seconds: time between two snapshots; a killed training resumes from the last one.
        statistics_steps: number of steps between two records of statistics.
    """

    preset: str | None = None
    steps: AtLeastOne = 1200
    batch_size: AtLeastOne = 2
    unlabeled_batch_size: Count = 2
    learning_rate: AboveZero = 5e-3
    flip_probability: Share = 0.5
    rotation_limit_rad: NotNegative = 0.2
    scale_range: tuple[AboveZero, AboveZero] = (0.95, 1.05)
    pasted: Count = 4
    fewest_points: Count = 5
    seed: Count = 0
    processes: AtLeastOne = 1
    threads: AtLeastOne = 1
    loaders: Count = 0
    device: str = "cpu"
    precision: Precision = FLOAT32
    teacher: Teacher = "student"
    ema_decay: float = 0.999
    cache_bytes: Count = 1 << 30
    snapshot_seconds: NotNegative = 20.0
    statistics_steps: AtLeastOne = 20

    def __post_init__(self) -> None:
        """Raise ConfigError if a setting is out of its range."""
        for name, lowest in (
            ("steps", 1), ("batch_size", 1), ("processes", 1), ("threads", 1), ("pasted", 0),
            ("seed", 0), ("fewest_points", 0), ("unlabeled_batch_size", 0), ("statistics_steps", 1),
            ("loaders", 0),
        ):  # fmt: skip
            if getattr(self, name) < lowest:
                raise ConfigError(
                    f"training: {name} is {getattr(self, name)}, must be at least {lowest}"
                )
        if not self.learning_rate > 0:
            raise ConfigError(f"training: learning_rate is {self.learning_rate}, must be above 0")
        if not 0 < self.scale_range[0] <= self.scale_range[1]:
            raise ConfigError(
                f"training: scale_range {self.scale_range} is not an ascending range above 0"
            )
        if not 0 <= self.ema_decay < 1:
            raise ConfigError(
                f"training: ema_decay is {self.ema_decay}, must be at least 0 and below 1"
            )
        if self.precision not in get_args(Precision):
            choices = ", ".join(get_args(Precision))
            raise ConfigError(f"training: unknown precision {self.precision!r}; choose {choices}")
        if self.teacher not in get_args(Teacher):
            choices = " or ".join(get_args(Teacher))
            raise ConfigError(f"training: unknown teacher {self.teacher!r}; choose {choices}")

    def augmentation(self) -> Augmentation:
        """Return the augmentation with these settings."""
        return Augmentation(
            self.flip_probability,
            self.rotation_limit_rad,
            self.scale_range,
            self.pasted,
            self.fewest_points,
        )


@dataclass(frozen=True)
class Statistic:
    """One statistic of one training step.

    Attributes:
        step: number of the step, from 1.
        name: "loss", one of its terms, "learning_rate" or "gradient_norm" (before clipping).
        value: value at this step.
    """

    step: int
    name: str
    value: float


@dataclass(frozen=True)
class TrainingReport:
    """Report of a finished training.

    Attributes:
        checkpoint: the file that was written.
        steps: total number of optimiser steps.
        resumed_at: step at which this run resumed a killed one; 0 if it started from the beginning.
        loss: mean loss of the last steps.
        seconds: duration of this run.
        labeled_frames: number of frames of X_l.
        unlabeled_frames: number of frames of X_u.
        bank: number of objects in the bank by category.
        statistics: statistics of every `statistics_steps`-th step and of the last one, including
            steps of killed runs.
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
