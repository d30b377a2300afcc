"""Functions that executors send to workers, and an executor that returns results out of order."""

import os
import signal
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curate.errors import CurateError, DataError, ModelError
from pipelines.engine.executors.base import FrameFunction, FrameJob, FrameRows, Outcome
from pipelines.engine.executors.serial import SerialExecutor


@dataclass
class Square:
    """Square the key of a frame; reject some keys, fail to open if configured to."""

    broken: bool = False

    def open(self) -> None:
        """Raise if the model is configured as broken."""
        if self.broken:
            raise ModelError("model.onnx: broken")

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return one row."""
        if job.frame_id % 7 == 3:
            raise ValueError(f"three\nlines {job.frame_id}\nlong")
        return {"squares": {"value": [job.frame_id**2]}}


@dataclass
class Deadly(Square):
    """Kill the worker on some frames, always or once.

    Attributes:
        folder: where it records which workers it has killed.
        always: frames that kill their worker every time.
        once: frames that do so the first time.
        opening: whether loading the model kills the worker.
    """

    folder: Path = Path()
    always: tuple[int, ...] = ()
    once: tuple[int, ...] = ()
    opening: bool = False

    def open(self) -> None:
        """Kill the worker if configured to."""
        if self.opening:
            os.kill(os.getpid(), signal.SIGKILL)

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return one row, or kill the process."""
        died = self.folder / str(job.frame_id)
        if job.frame_id in self.always or (job.frame_id in self.once and not died.exists()):
            died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return {"squares": {"value": [job.frame_id**2]}}


@dataclass
class SquareBatches:
    """Square the keys of a batch. Some keys fail alone, some spoil their batch or kill the worker.

    Attributes:
        folder: where it records the batches: the first key, the number of frames, the process.
        deadly: frames that kill the worker.
        batch_size: the most frames of a batch.
        workers: the most workers that run it at the same time.
    """

    folder: Path
    deadly: tuple[int, ...] = ()
    batch_size: int = 8
    workers: int | None = None

    def open(self) -> None:
        """Do nothing."""

    def batch(self, jobs: Sequence[FrameJob]) -> list[FrameRows | CurateError]:
        """Return one row per frame."""
        keys = [job.frame_id for job in jobs]
        record = self.folder / f"{keys[0]}-{len(keys)}-{uuid.uuid4()}"
        record.write_text(str(os.getpid()))
        if any(key in self.deadly for key in keys):
            os.kill(os.getpid(), signal.SIGKILL)
        if any(key % 7 == 3 for key in keys):
            raise ValueError("a batch\nis spoilt")
        return [
            DataError(f"frame {key}: empty") if key % 7 == 4 else {"squares": {"value": [key**2]}}
            for key in keys
        ]


class Shuffled:
    """A serial executor that returns outcomes in another order."""

    def __init__(self, seed: int = 0) -> None:
        self.generator = np.random.default_rng(seed)

    def map(self, function: FrameFunction, jobs: Iterable[FrameJob]) -> Iterator[Outcome]:
        """Yield one outcome per job, in another order."""
        waiting = list(jobs)
        order = self.generator.permutation(len(waiting))
        return SerialExecutor().map(function, [waiting[i] for i in order])

    def close(self) -> None:
        """Do nothing."""


@dataclass
class Slow:
    """Sleep per frame, and report the node of the cluster.

    Attributes:
        folder: where it records every frame that it starts.
        seconds: per frame.
    """

    folder: Path
    seconds: float

    def open(self) -> None:
        """Do nothing."""

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the node as a row."""
        import ray

        node = ray.get_runtime_context().get_node_id()
        (self.folder / f"{job.frame}-{uuid.uuid4()}").touch()
        time.sleep(self.seconds)
        return {"nodes": {"name": [node]}}


@dataclass
class Napping:
    """Sleep per frame, and return the process that worked on it.

    Attributes:
        seconds: per frame.
    """

    seconds: float

    def open(self) -> None:
        """Do nothing."""

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the process as a row."""
        time.sleep(self.seconds)
        return {"processes": {"pid": [os.getpid()]}}


@dataclass
class OnDevice:
    """A model on a GPU: returns the process that computed a frame, and what it was told before.

    Attributes:
        exclusive: whether workers should not share the device.
        workers: how many of them run it.
    """

    exclusive: bool = True
    workers: int | None = 1

    def open(self) -> None:
        """Begin to record."""
        self.announced: list[int] = []

    def prefetch(self, jobs: Sequence[FrameJob]) -> None:
        """Record the frames that will be needed next."""
        self.announced += [job.frame_id for job in jobs]

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the process, and the frames that were announced so far."""
        return {"done": {"process": [os.getpid()], "announced": [list(self.announced)]}}
