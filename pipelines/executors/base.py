"""What every executor offers, and what happens to one frame wherever it is worked on."""

import logging
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from curate.detections import Detections
from curate.errors import CurateError

logger = logging.getLogger(__name__)

# Rows by table, each without its first two columns, round and frame_id.
FrameRows = Mapping[str, list[tuple[Any, ...]]]


@dataclass(frozen=True)
class FrameJob:
    """One frame to work on, with what is known of it.

    Attributes:
        frame_id: its key.
        frame: its name.
        predictions: what predict found, for stages that read it.
        measured: what the stage itself once measured, where that still holds.
    """

    frame_id: int
    frame: str
    predictions: Detections | None = None
    measured: Mapping[str, np.ndarray] | None = None


class FrameFunction(Protocol):
    """What a stage does with one frame; travels to workers, so it is small until `open`."""

    def open(self) -> None:
        """Loads the models and the data set; a failure here ends the run."""
        ...

    def __call__(self, job: FrameJob) -> FrameRows:
        """The frame's rows; a failure here is the frame's alone."""
        ...


@dataclass(frozen=True)
class Outcome:
    """What became of a frame: rows, or an error in one line."""

    job: FrameJob
    rows: FrameRows
    error: str | None
    seconds: float


class Executor(Protocol):
    """Maps a function over frames; yields outcomes in any order, holding a bounded number."""

    def map(self, function: FrameFunction, jobs: Iterable[FrameJob]) -> Iterator[Outcome]:
        """One outcome per job."""
        ...

    def close(self) -> None:
        """Ends its workers."""
        ...


def attempt(function: FrameFunction, job: FrameJob) -> Outcome:
    """Works on one frame and turns whatever goes wrong into its recorded failure."""
    start = time.perf_counter()
    try:
        rows, error = function(job), None
    except CurateError as fault:
        rows, error = {}, str(fault)
    except Exception as fault:
        # A user's model may raise anything; it costs this frame, never the run.
        logger.debug("frame %s failed", job.frame, exc_info=True)
        rows, error = {}, f"frame {job.frame}: {type(fault).__name__}: {_one_line(fault)}"
    return Outcome(job, rows, error, time.perf_counter() - start)


def _one_line(fault: Exception) -> str:
    return " ".join(str(fault).split())[:500]
