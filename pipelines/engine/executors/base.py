"""What every executor offers, and what happens to one frame wherever it is worked on."""

import logging
import pickle
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

FrameRows = Mapping[str, Mapping[str, Sequence[Any]]]
"""The rows of one frame: by table its columns of one length, without `round` and `frame_id`."""


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

    @property
    def frames(self) -> "tuple[FrameJob, ...]":
        """Itself."""
        return (self,)

    @property
    def title(self) -> str:
        """Its name in messages."""
        return f"frame {self.frame}"


@dataclass(frozen=True)
class SequenceJob:
    """A sequence to work on: its frames in their order.

    Attributes:
        name: of the sequence.
        frames: all its frames, each with its predictions.
    """

    name: str
    frames: tuple[FrameJob, ...]

    @property
    def title(self) -> str:
        """Its name in messages."""
        return f"sequence {self.name}"


Job = FrameJob | SequenceJob


class FrameFunction(Protocol):
    """What a stage does with one frame; travels to workers, so it is small until `open`."""

    def open(self) -> None:
        """Load the models and the data set; a failure here ends the run."""
        ...

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the frame's rows; a failure here is the frame's alone."""
        ...


class SequenceFunction(Protocol):
    """What a stage does with one sequence; travels to workers, so it is small until `open`."""

    def open(self) -> None:
        """Load the models and the data set; a failure here ends the run."""
        ...

    def __call__(self, job: SequenceJob) -> Sequence[FrameRows]:
        """The rows of each of its frames in order; a failure here is the sequence's alone."""
        ...


JobFunction = FrameFunction | SequenceFunction


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    Attributes:
        job: what was worked on.
        rows: of each of its frames, in their order; nothing where it failed.
        error: in one line, where it failed.
        seconds: that it took.
    """

    job: Job
    rows: Sequence[FrameRows]
    error: str | None
    seconds: float


class Executor(Protocol):
    """Maps a function over frames or sequences; yields outcomes in any order.

    It holds a bounded number of jobs.
    A worker that dies costs the job in its hands one more try and no other job anything.
    """

    def map(self, function: JobFunction, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """One outcome per job.

        Raises:
            CurateError: if the models cannot be loaded.
        """
        ...

    def close(self) -> None:
        """End its workers."""
        ...


class JobQueue:
    """Jobs to hand out: first those that a dead worker has left, then the next of all."""

    def __init__(self, jobs: Iterable[Job], workers: int) -> None:
        self._openings = workers + SPARE_OPENINGS
        self._next = iter(jobs)
        self._again: deque[Job] = deque()
        self._deaths: Counter[str] = Counter()
        self._dead_openings = 0

    def take(self) -> Job | None:
        """Return the next job; None where there is none."""
        return self._again.popleft() if self._again else next(self._next, None)

    def return_jobs(self, jobs: Iterable[Job]) -> None:
        """Take jobs back that nobody has begun."""
        self._again.extend(jobs)

    def opened(self) -> None:
        """A worker has loaded its models."""
        self._dead_openings = 0

    def record_crash(
        self, in_flight: Sequence[Job], reason: str, *, opened: bool
    ) -> Iterator[Outcome]:
        """Take back what a dead worker had in hand; a frame that was tried too often has failed.

        Args:
            in_flight: its jobs in their order; it had begun the first, if any.
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
            self.return_jobs(in_flight)
            return
        begun, rest = in_flight[:1], in_flight[1:]
        self.return_jobs(rest)
        for job in begun:
            self._deaths[job.title] += 1
            if self._deaths[job.title] < TRIES:
                self._again.appendleft(job)
            else:
                error = f"{job.title}: its worker died {TRIES} times, {reason}"
                yield Outcome(job, (), error, 0.0)


def open_function(function: JobFunction) -> None:
    """Load what a function needs, and turns whatever goes wrong into one line.

    Raises:
        CurateError: if it cannot be loaded.
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


class RayWorker:
    """What a worker on the other side of a pipe holds: the function at hand, with its models."""

    def __init__(self) -> None:
        self.function: JobFunction | None = None

    def open(self, packed: bytes) -> CurateError | None:
        """Load the models; the error where they cannot be loaded."""
        self.function = None  # the one before, with its models, makes room first
        function = pickle.loads(packed)  # noqa: S301 - from the runner
        try:
            open_function(function)
        except CurateError as fault:
            return fault
        self.function = function
        return None

    def work(self, job: Job) -> tuple[Sequence[FrameRows], str | None, float]:
        """Rows, error and seconds of a job.

        Raises:
            CurateError: if it has no models.
        """
        if self.function is None:
            raise CurateError("asked to work before the models were loaded")
        outcome = attempt(self.function, job)
        return outcome.rows, outcome.error, outcome.seconds


def attempt(function: Any, job: Job) -> Outcome:
    """Work on one job and turns whatever goes wrong into its recorded failure."""
    start = time.perf_counter()
    rows: Sequence[FrameRows] = ()
    error = None
    try:
        found = function(job)
        rows = (found,) if isinstance(job, FrameJob) else tuple(found)
        if len(rows) != len(job.frames):
            error, rows = f"{job.title}: {len(rows)} results for {len(job.frames)} frames", ()
    except CurateError as fault:
        error = str(fault)
    except Exception as fault:
        # A user's model may raise anything; it costs this job, never the run.
        logger.debug("%s failed", job.title, exc_info=True)
        error = f"{job.title}: {type(fault).__name__}: {one_line(fault, 500)}"
    return Outcome(job, rows, error, time.perf_counter() - start)
