"""The default executor: small work in this process, large work on all cores.

Worker processes cost their start: each imports the libraries and loads the model. Work that takes
less time than that is faster in this process. So the executor begins here, measures how long a
frame takes, and starts workers as soon as they would save time.

Example: 17 frames of 0.05 s each take 0.85 s here; two workers would take 5 s to start. 1,000 such
frames take 50 s here, and 5 + 25 s with two workers: after three frames the rest goes to workers.
"""

import operator
import pickle
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from statistics import median

from curate.ranges import AtLeastOne
from pipelines.engine.executors.base import (
    FunctionHolder,
    Job,
    JobFunction,
    Outcome,
    allowed_workers,
    outcomes_of,
)
from pipelines.engine.executors.machine import affordable_workers, usable_cores
from pipelines.engine.executors.process import ProcessExecutor
from pipelines.engine.executors.serial import SerialExecutor

# Seconds in which a worker process imports the libraries; several start at the same time.
START_S = 4.0
# Jobs that are measured in this process before the first decision, and between two decisions. The
# first job of a function often compiles something, so it is left out of the measurement.
MEASURED_JOBS = 3


class AutoExecutor:
    """Processes frames in this process, or in worker processes when that saves time.

    Args:
        workers: the most worker processes; None for one per usable core. The free memory may
            allow fewer: each worker needs about as much as this process with the model loaded.
    """

    def __init__(self, workers: AtLeastOne | None = None) -> None:
        self._limit = usable_cores() if workers is None else workers
        self._pool: ProcessExecutor | None = None

    def map(self, function: JobFunction, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """Yield one outcome per frame or sequence, in their order unless workers are started.

        Args:
            function: what to do with a job.
            jobs: the jobs; `operator.length_hint` gives their number. Without a hint there are
                taken to be many.

        Raises:
            CurateError: if the models cannot be loaded, or workers crash while they load them.
        """
        limit = allowed_workers(function, self._limit)
        if limit == 1:
            yield from SerialExecutor().map(function, jobs)
            return
        packed = pickle.dumps(function)  # before the models are loaded into it
        jobs = iter(jobs)
        here = FunctionHolder()
        start = time.perf_counter()
        if error := here.open(packed):
            raise error
        opening_s = time.perf_counter() - start
        seconds: list[float] = []
        while batch := list(islice(jobs, MEASURED_JOBS)):
            for job in batch:
                results = here.work(job)
                seconds.append(sum(result.seconds for result in results))
                yield from outcomes_of(job, results)
            left = operator.length_hint(jobs, -1)
            if self._saves_time(left, median(seconds[1:] or seconds), opening_s, limit):
                workers = min(affordable_workers(self._limit), max(left, 0) or self._limit)
                if workers > 1:
                    del here  # frees the memory of its models
                    yield from self._workers(workers).map(function, jobs)
                    return

    def close(self) -> None:
        """End the workers, if any were started."""
        if self._pool:
            self._pool.close()

    def _saves_time(self, left: int, job_s: float, opening_s: float, workers: int) -> bool:
        """Return whether the remaining jobs would end earlier with workers."""
        if left < 0:
            return True
        start_s = opening_s + (0.0 if self._pool else START_S)
        return left * job_s > start_s + left * job_s / workers

    def _workers(self, workers: int) -> ProcessExecutor:
        """Return the pool; it lives until `close`, so that later stages find its workers."""
        if self._pool is None:
            self._pool = ProcessExecutor(workers)
        return self._pool
