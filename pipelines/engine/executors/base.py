"""What every executor offers, and what happens to one frame wherever it is worked on."""

import logging
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from curate.detections import Detections
from curate.errors import CurateError, ModelError, one_line

logger = logging.getLogger(__name__)

# A frame whose worker died is tried so often in all; the next death may well be its own doing.
TRIES = 2
# Jobs in the hands of a worker: one that it works on, and one so that it need not wait while the
# runner writes.
IN_HAND = 2
# So many more workers than there are may die in a row while they load their models.
SPARE_OPENINGS = 2

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
    """Maps a function over frames; yields outcomes in any order, holding a bounded number.

    A worker that dies costs the frame in its hands one more try and no other frame anything.
    """

    def map(self, function: FrameFunction, jobs: Iterable[FrameJob]) -> Iterator[Outcome]:
        """One outcome per job.

        Raises:
            CurateError: the models cannot be loaded.
        """
        ...

    def close(self) -> None:
        """Ends its workers."""
        ...


class JobQueue:
    """Jobs to hand out: first those that a dead worker has left, then the next of all."""

    def __init__(self, jobs: Iterable[FrameJob], workers: int) -> None:
        self._openings = workers + SPARE_OPENINGS
        self._next = iter(jobs)
        self._again: deque[FrameJob] = deque()
        self._deaths: Counter[int] = Counter()
        self._dead_openings = 0

    def take(self) -> FrameJob | None:
        """The next job; None where there is none."""
        return self._again.popleft() if self._again else next(self._next, None)

    def give_back(self, jobs: Iterable[FrameJob]) -> None:
        """Takes jobs back that nobody has begun."""
        self._again.extend(jobs)

    def opened(self) -> None:
        """A worker has loaded its models."""
        self._dead_openings = 0

    def bury(self, in_hand: Sequence[FrameJob], reason: str, *, opened: bool) -> Iterator[Outcome]:
        """Takes back what a dead worker had in hand; a frame that was tried too often has failed.

        Args:
            in_hand: its jobs in their order; it had begun the first, if any.
            reason: how it died.
            opened: whether it had loaded its models.

        Raises:
            CurateError: workers die before they have loaded their models.
        """
        if not opened:
            self._dead_openings += 1
            if self._dead_openings == self._openings:
                raise CurateError(
                    f"{self._openings} workers in a row died while they loaded their models, the "
                    f"last {reason}; run again with fewer workers, finished frames are kept"
                )
            self.give_back(in_hand)
            return
        begun, rest = in_hand[:1], in_hand[1:]
        self.give_back(rest)
        for job in begun:
            self._deaths[job.frame_id] += 1
            if self._deaths[job.frame_id] < TRIES:
                self._again.appendleft(job)
            else:
                yield Outcome(
                    job, {}, f"frame {job.frame}: its worker died {TRIES} times, {reason}", 0.0
                )


def open_function(function: FrameFunction) -> None:
    """Loads what a function needs, and turns whatever goes wrong into one line.

    Raises:
        CurateError: it cannot be loaded.
    """
    try:
        function.open()
    except CurateError:
        raise
    except Exception as fault:  # a user's model may raise anything
        logger.debug("cannot load", exc_info=True)
        raise ModelError(
            f"the models cannot be loaded: {type(fault).__name__}: {one_line(fault, 500)}"
        ) from fault


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
        rows, error = {}, f"frame {job.frame}: {type(fault).__name__}: {one_line(fault, 500)}"
    return Outcome(job, rows, error, time.perf_counter() - start)
