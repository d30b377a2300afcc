"""Mapping a function over frames or sequences: batches, and the trial and failures of a command."""

import copy
from collections.abc import Iterable, Iterator
from itertools import chain, islice

from curate.errors import ModelError
from pipelines.engine.executors.base import (
    BatchJob,
    Executor,
    Job,
    JobFunction,
    Outcome,
    Part,
    TrialFunction,
    attempt_trial,
    batches_for,
    outcomes_of,
)

# The run ends after this many failed batches in a row: the others would fail as well.
FAILED_BATCHES = 3


def map_frames(
    executor: Executor, function: JobFunction, jobs: Iterable[Part], total: int
) -> Iterator[Outcome]:
    """Yield the outcomes of frames or sequences, which the function may get in batches.

    Args:
        executor: the executor.
        function: what to do with them.
        jobs: the frames or sequences.
        total: number of their frames.

    Raises:
        CurateError: if the models cannot be loaded, the trial fails, or too many batches in a row.
    """
    if not (isinstance(function, TrialFunction) and function.trial_size):
        yield from executor.map(function, Counted(batches_for(function, jobs), total))
        return
    frames = (frame for job in jobs for frame in job.frames)
    if first_frames := tuple(islice(frames, function.trial_size)):
        trial = BatchJob(first_frames)
        # A copy is opened: the function itself is sent to the workers.
        yield from outcomes_of(trial, attempt_trial(copy.copy(function), trial))
    for next_frame in frames:
        batches = batches_for(function, chain([next_frame], frames))
        outcomes = executor.map(function, Counted(batches, total - len(first_frames)))
        yield from _until_all_fail(outcomes)


class Counted(Iterator[Job]):
    """Jobs with `operator.length_hint`, the expected number of jobs that are left.

    Args:
        jobs: the jobs.
        frames: number of their frames; a batch or sequence has several.
    """

    def __init__(self, jobs: Iterable[Job], frames: int) -> None:
        self._jobs = iter(jobs)
        self._left = frames
        self._jobs_taken = self._frames_taken = 0

    def __next__(self) -> Job:
        """Return the next job."""
        job = next(self._jobs)
        self._jobs_taken += 1
        self._frames_taken += len(job.frames)
        return job

    def __length_hint__(self) -> int:
        """Return the expected number of jobs that are left."""
        left = max(0, self._left - self._frames_taken)
        return round(left * self._jobs_taken / self._frames_taken) if self._frames_taken else left


def _until_all_fail(outcomes: Iterator[Outcome]) -> Iterator[Outcome]:
    """Yield outcomes.

    Raises:
        ModelError: if all frames of `FAILED_BATCHES` batches in a row have failed; the last batch
            of a run may be a small one.
    """
    failed = batches = 0  # in a row
    whole = True  # whether all frames of the batch so far have failed
    for outcome in outcomes:
        yield outcome
        if outcome.error is None:
            failed = batches = 0
            whole = False
        else:
            failed += 1
        if outcome.ends_job:
            batches += whole
            whole = True
        if batches == FAILED_BATCHES:
            raise ModelError(
                f"{failed} frames in a row failed, so the rest is left out; finished frames are "
                f"kept; the last error: {outcome.error}"
            )
