"""What executors are tested with: functions that travel to workers, and an executor of ill will."""

import os
import signal
import time
import uuid
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curate.errors import ModelError
from pipelines.engine.executors.base import FrameFunction, FrameJob, FrameRows, Outcome
from pipelines.engine.executors.serial import SerialExecutor


@dataclass
class Square:
    """Squares the key of a frame; rejects some, cannot even start if told so."""

    broken: bool = False

    def open(self) -> None:
        """Fails where the model is broken."""
        if self.broken:
            raise ModelError("model.onnx: broken")

    def __call__(self, job: FrameJob) -> FrameRows:
        """One row."""
        if job.frame_id % 7 == 3:
            raise ValueError(f"three\nlines {job.frame_id}\nlong")
        return {"squares": {"value": [job.frame_id**2]}}


@dataclass
class Deadly(Square):
    """Frames that the system kills their worker for: some always, some once.

    Attributes:
        folder: where it remembers whom it has killed.
        always: these frames take their worker with them.
        once: these do so the first time.
        opening: whether loading the model is too much already.
    """

    folder: Path = Path()
    always: tuple[int, ...] = ()
    once: tuple[int, ...] = ()
    opening: bool = False

    def open(self) -> None:
        """Dies where told so."""
        if self.opening:
            os.kill(os.getpid(), signal.SIGKILL)

    def __call__(self, job: FrameJob) -> FrameRows:
        """One row, or the end of the process."""
        died = self.folder / str(job.frame_id)
        if job.frame_id in self.always or (job.frame_id in self.once and not died.exists()):
            died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return {"squares": {"value": [job.frame_id**2]}}


class Shuffled:
    """Serial, but frames come as they please."""

    def __init__(self, seed: int = 0) -> None:
        self.generator = np.random.default_rng(seed)

    def map(self, function: FrameFunction, jobs: Iterable[FrameJob]) -> Iterator[Outcome]:
        """One outcome per job, in another order."""
        waiting = list(jobs)
        order = self.generator.permutation(len(waiting))
        return SerialExecutor().map(function, [waiting[i] for i in order])

    def close(self) -> None:
        """Nothing to end."""


@dataclass
class Slow:
    """Takes its time, and says on which node of a cluster it worked.

    Attributes:
        folder: where it notes every frame that it begins.
        seconds: per frame.
    """

    folder: Path
    seconds: float

    def open(self) -> None:
        """Needs nothing."""

    def __call__(self, job: FrameJob) -> FrameRows:
        """The node, as a row."""
        import ray

        node = ray.get_runtime_context().get_node_id()
        (self.folder / f"{job.frame}-{uuid.uuid4()}").touch()
        time.sleep(self.seconds)
        return {"nodes": {"name": [node]}}
