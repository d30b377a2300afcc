"""The interface of executors, and the code that processes one job in any of them."""

import logging
import pickle
import time
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from curate.detections import Detections
from curate.errors import CurateError, ModelError, one_line
from curate.files.batches import batched

logger = logging.getLogger(__name__)

# A frame is tried again after its worker crashed, but it may have caused the crash: the second
# crash makes it fail.
MAX_TRIES = 2
# Jobs that a worker holds: the one in progress, and the next one, so that the worker need not wait
# while the runner writes.
JOBS_PER_WORKER = 2
# The run ends after (workers + SPARE_OPENINGS) crashes in a row during the loading of models.
SPARE_OPENINGS = 2

FrameRows = Mapping[str, Mapping[str, Sequence[Any]]]
"""The rows of one frame: for each table its columns, without `round` and `frame_id`."""


@dataclass(frozen=True)
class FrameJob:
    """One frame to process, with the stored data that the stage needs.

    Attributes:
        frame_id: key of the frame.
        frame: name of the frame.
        predictions: its predictions, for stages that read them.
        measured: its stored measurements by column, if they are still valid.
    """

    frame_id: int
    frame: str
    predictions: Detections | None = None
    measured: Mapping[str, np.ndarray] | None = None

    @property
    def frames(self) -> "tuple[FrameJob, ...]":
        """The frames of the job: this one."""
        return (self,)

    @property
    def parts(self) -> "tuple[Part, ...]":
        """The job itself: it succeeds or fails as a whole."""
        return (self,)

    @property
    def title(self) -> str:
        """The name of the job in messages."""
        return f"frame {self.frame}"


@dataclass(frozen=True)
class BatchJob:
    """Several frames to process in one call; each succeeds or fails by itself.

    Attributes:
        frames: the frames.
    """

    frames: tuple[FrameJob, ...]

    @property
    def parts(self) -> "tuple[Part, ...]":
        """The jobs that succeed or fail by themselves: the frames."""
        return self.frames

    @property
    def title(self) -> str:
        """The name of the job in messages."""
        first, last = self.frames[0].frame, self.frames[-1].frame
        return f"frame {first}" if first == last else f"frames {first} to {last}"

    def halves(self) -> "list[BatchJob]":
        """Return the batch in two parts, to find the frame at fault; nothing for one frame."""
        middle = len(self.frames) // 2
        return [BatchJob(self.frames[:middle]), BatchJob(self.frames[middle:])] if middle else []


@dataclass(frozen=True)
class SequenceJob:
    """One sequence to process.

    Attributes:
        name: name of the sequence.
        frames: all its frames in order, each with its predictions.
    """

    name: str
    frames: tuple[FrameJob, ...]

    @property
    def parts(self) -> "tuple[Part, ...]":
        """The job itself: it succeeds or fails as a whole."""
        return (self,)

    @property
    def title(self) -> str:
        """The name of the job in messages."""
        return f"sequence {self.name}"


Part = FrameJob | SequenceJob
Job = FrameJob | BatchJob | SequenceJob


class FrameFunction(Protocol):
    """What a stage does with one frame.

    It is pickled and sent to the workers, so it loads nothing large before `open`.
    """

    def open(self) -> None:
        """Load the models and the data set; an error here ends the run."""
        ...

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the frame's rows; an error here fails only this frame."""
        ...


@runtime_checkable
class BatchFunction(Protocol):
    """What a stage does with several frames in one call.

    It is pickled and sent to the workers, so it loads nothing large before `open`.
    """

    @property
    def batch_size(self) -> int:
        """The most frames of a call. The rows do not depend on it."""
        ...

    @property
    def workers(self) -> int | None:
        """The most workers that may run it at the same time; None for any number."""
        ...

    def open(self) -> None:
        """Load the models and the data set; an error here ends the run."""
        ...

    def batch(self, jobs: Sequence[FrameJob]) -> Sequence[FrameRows | CurateError]:
        """Return the rows of each frame, or the error that fails only this frame.

        If the call raises an error, it is repeated with smaller batches, so that only the frames
        fail that raise it by themselves.
        """
        ...


@runtime_checkable
class TrialFunction(BatchFunction, Protocol):
    """A function with calls that may all fail for the same reason, such as a command of the user.

    The run ends if its first call, with a few frames, or several later ones in a row fail.
    """

    @property
    def trial_size(self) -> int:
        """How many frames the first call gets; 0 for no trial."""
        ...

    def trial(self, jobs: Sequence[FrameJob]) -> Sequence[FrameRows | CurateError]:
        """Return what `batch` returns.

        Raises:
            CurateError: if later calls would fail as well; it ends the run.
        """
        ...


class SequenceFunction(Protocol):
    """What a stage does with one sequence.

    It is pickled and sent to the workers, so it loads nothing large before `open`.
    """

    def open(self) -> None:
        """Load the models and the data set; an error here ends the run."""
        ...

    def __call__(self, job: SequenceJob) -> Sequence[FrameRows]:
        """Return the rows of each frame in order; an error here fails only this sequence."""
        ...


JobFunction = FrameFunction | BatchFunction | SequenceFunction


@runtime_checkable
class LimitedFunction(Protocol):
    """A function that not all workers should run at the same time."""

    @property
    def workers(self) -> int | None:
        """How many workers run it at the same time; None for all of them."""
        ...


@runtime_checkable
class DeviceFunction(Protocol):
    """A function with a model that may run on a device which workers should not share: a GPU."""

    @property
    def exclusive(self) -> bool:
        """Whether it does."""
        ...

    def prefetch(self, jobs: Sequence[FrameJob]) -> None:
        """Begin to read the frames of the next call in threads, while the device computes."""
        ...


def allowed_workers(function: JobFunction, workers: int) -> int:
    """Return how many of the workers may run a function at the same time."""
    limit = function.workers if isinstance(function, LimitedFunction) else None
    return workers if limit is None else min(workers, limit)


def reading_ahead(function: JobFunction, jobs: Iterable[Job]) -> Iterator[Job]:
    """Yield the jobs; the frames of the next one are read in the meantime, see `DeviceFunction`."""
    if not (isinstance(function, DeviceFunction) and function.exclusive):
        yield from jobs
        return
    waiting: Job | None = None
    for job in jobs:
        if waiting is not None:
            function.prefetch(job.frames)
            yield waiting
        waiting = job
    if waiting is not None:
        yield waiting


def batches_for(function: JobFunction, jobs: Iterable[Part]) -> Iterator[Job]:
    """Return the jobs, in batches if the function processes several frames in one call."""
    if not isinstance(function, BatchFunction):
        return iter(jobs)
    frames = (frame for job in jobs for frame in job.frames)
    return (BatchJob(tuple(batch)) for batch in batched(frames, function.batch_size))


@dataclass(frozen=True)
class Outcome:
    """The result of a frame or sequence.

    Attributes:
        job: the frame or sequence.
        rows: rows of each of its frames, in order; empty if it failed.
        error: error message in one line; None if it succeeded.
        seconds: time that it took; for a frame of a batch, its share.
        ends_job: false if other outcomes of the same batch follow at once.
    """

    job: Part
    rows: Sequence[FrameRows]
    error: str | None
    seconds: float
    ends_job: bool = True


class Executor(Protocol):
    """Maps a function over frames or sequences, and yields their outcomes in any order.

    It takes a bounded number of jobs ahead. If a worker crashes, only the job in progress loses one
    of its tries; the other jobs of the worker are requeued. A batch in progress is halved.
    """

    def map(self, function: JobFunction, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """Yield one outcome per frame or sequence of the jobs.

        Raises:
            CurateError: if the models cannot be loaded.
        """
        ...

    def close(self) -> None:
        """End the workers."""
        ...


class JobQueue:
    """The jobs that are still to be sent to workers: first requeued ones, then new ones."""

    def __init__(self, jobs: Iterable[Job], workers: int) -> None:
        self._openings = workers + SPARE_OPENINGS
        self._next = iter(jobs)
        self._again: deque[Job] = deque()
        self._crashes: Counter[str] = Counter()
        self._failed_openings = 0

    def take(self) -> Job | None:
        """Return the next job; None if there is none."""
        return self._again.popleft() if self._again else next(self._next, None)

    def return_jobs(self, jobs: Iterable[Job]) -> None:
        """Requeue jobs that no worker has started."""
        self._again.extend(jobs)

    def allows_another(self, in_flight: Collection[Job]) -> bool:
        """Return whether a worker with these jobs may get another one.

        A job that seemed to crash its worker gets none behind it: if the worker crashes again, no
        result of a former job can be lost with it, and that job alone is to blame.
        """
        return len(in_flight) < JOBS_PER_WORKER and not any(
            self._crashes[job.title] for job in in_flight
        )

    def record_opened(self) -> None:
        """Record that a worker has loaded its models."""
        self._failed_openings = 0

    def record_crash(
        self, in_flight: Sequence[Job], reason: str, *, opened: bool
    ) -> Iterator[Outcome]:
        """Requeue the jobs of a crashed worker; yield the job in progress if it has failed.

        Args:
            in_flight: jobs of the worker, in order; it had started the first one.
            reason: how the worker ended, for the message.
            opened: whether the worker had loaded its models.

        Raises:
            CurateError: if too many workers in a row crash before they have loaded their models.
        """
        if not opened:
            self._failed_openings += 1
            if self._failed_openings == self._openings:
                raise CurateError(
                    f"{self._openings} workers in a row died while they loaded their models, the "
                    f"last {reason}; rerun with fewer workers, finished frames are kept"
                )
            self.return_jobs(in_flight)
            return
        started, rest = in_flight[:1], in_flight[1:]
        self.return_jobs(rest)
        for job in started:
            if isinstance(job, BatchJob) and (halves := job.halves()):
                self._again.extendleft(reversed(halves))
                continue
            self._crashes[job.title] += 1
            if self._crashes[job.title] < MAX_TRIES:
                self._again.appendleft(job)
            else:
                error = f"{job.title}: its worker died {MAX_TRIES} times, {reason}"
                yield from outcomes_of(job, [Result((), error, 0.0)])


def open_function(function: JobFunction) -> None:
    """Load the models and the data set of a function.

    Raises:
        CurateError: if they cannot be loaded; every error becomes one line.
    """
    try:
        function.open()
    except CurateError:
        raise
    except Exception as error:  # a user's model may raise anything
        logger.debug("cannot load", exc_info=True)
        raise ModelError(
            f"the models cannot be loaded: {type(error).__name__}: {one_line(error, 500)}"
        ) from error


class FunctionHolder:
    """The current function of a worker process or actor, with its loaded models."""

    def __init__(self) -> None:
        self.function: JobFunction | None = None

    def open(self, packed: bytes) -> CurateError | None:
        """Load a pickled function and its models; return the error if they cannot be loaded."""
        self.function = None  # first free the memory of the former function's models
        function = pickle.loads(packed)  # noqa: S301 - from the runner
        try:
            open_function(function)
        except CurateError as error:
            return error
        self.function = function
        return None

    def work(self, job: Job) -> "list[Result]":
        """Return the results of the parts of a job.

        Raises:
            CurateError: if no function is loaded.
        """
        if self.function is None:
            raise CurateError("a worker got a job before it had loaded the models")
        return attempt(self.function, job)


class Result(NamedTuple):
    """What a worker returns for a frame or sequence: an `Outcome` without the job."""

    rows: Sequence[FrameRows]
    error: str | None
    seconds: float


def outcomes_of(job: Job, results: Sequence[Result]) -> Iterator[Outcome]:
    """Yield the outcomes of the parts of a job."""
    last = job.parts[-1]
    for part, result in zip(job.parts, results, strict=True):
        yield Outcome(part, *result, ends_job=part is last)


def attempt(function: Any, job: Job) -> list[Result]:
    """Run a job and return the results of its parts; an exception makes a failed one.

    A batch that raises an exception is halved, until only the frames that raise it are left.
    """
    start = time.perf_counter()
    found: Sequence[Sequence[FrameRows] | Exception]
    try:
        found = _run(function, job)
    except Exception as error:
        # A user's model may raise anything; only this job fails, not the run.
        logger.debug("%s failed", job.title, exc_info=True)
        if isinstance(job, BatchJob) and (halves := job.halves()):
            return [result for half in halves for result in attempt(function, half)]
        found = [error]
    return _results(job, found, time.perf_counter() - start)


def attempt_trial(function: TrialFunction, job: BatchJob) -> list[Result]:
    """Run the first job of a function and return the results of its frames.

    Raises:
        CurateError: if later jobs would fail as well.
    """
    start = time.perf_counter()
    open_function(function)
    found = [
        rows if isinstance(rows, CurateError) else (rows,) for rows in function.trial(job.frames)
    ]
    return _results(job, found, time.perf_counter() - start)


def _results(
    job: Job, found: Sequence[Sequence[FrameRows] | Exception], seconds: float
) -> list[Result]:
    share = seconds / len(job.parts)
    return [
        Result((), _message(part, each), share)
        if isinstance(each, Exception)
        else Result(each, None, share)
        for part, each in zip(job.parts, found, strict=True)
    ]


def _run(function: Any, job: Job) -> Sequence[Sequence[FrameRows] | CurateError]:
    """Return for each part of a job the rows of its frames, or its error.

    Raises:
        CurateError: if the function returns too few or too many results.
    """
    if isinstance(job, FrameJob):
        return [(function(job),)]
    found = tuple(function.batch(job.frames) if isinstance(job, BatchJob) else function(job))
    if len(found) != len(job.frames):
        raise CurateError(f"{job.title}: {len(found)} results for {len(job.frames)} frames")
    if isinstance(job, BatchJob):
        return [rows if isinstance(rows, CurateError) else (rows,) for rows in found]
    return [found]


def _message(job: Job, error: Exception) -> str:
    if isinstance(error, CurateError):
        return str(error)
    return f"{job.title}: {type(error).__name__}: {one_line(error, 500)}"
