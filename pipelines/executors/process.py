"""All cores of one machine: one process per worker, each with its own model."""

import multiprocessing
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice

from curate.errors import CurateError
from pipelines.executors.base import FrameFunction, FrameJob, Outcome, attempt

# Jobs handed out ahead per worker: enough to keep it busy, few enough to bound memory.
AHEAD = 4


class ProcessExecutor:
    """Works on frames in `workers` spawned processes."""

    def __init__(self, workers: int = 1) -> None:
        self.workers = workers

    def map(self, function: FrameFunction, jobs: Iterable[FrameJob]) -> Iterator[Outcome]:
        """One outcome per job, as they end.

        Raises:
            CurateError: a worker could not load its models, or was killed.
        """
        waiting = iter(jobs)
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(
            self.workers, mp_context=context, initializer=_receive, initargs=(function,)
        ) as pool:
            running = {pool.submit(_work, job) for job in islice(waiting, self.workers * AHEAD)}
            try:
                while running:
                    ended, running = wait(running, return_when=FIRST_COMPLETED)
                    running |= {pool.submit(_work, job) for job in islice(waiting, len(ended))}
                    yield from map(Future.result, ended)
            except BrokenProcessPool as error:
                raise CurateError(
                    "a worker process was killed, perhaps for memory; "
                    "run the command again with fewer workers, finished frames are kept"
                ) from error
            finally:
                pool.shutdown(cancel_futures=True)


_function: FrameFunction | None = None
_opened = False


def _receive(function: FrameFunction) -> None:
    global _function  # noqa: PLW0603 - a worker process holds one function for its life
    _function = function


def _work(job: FrameJob) -> Outcome:
    global _opened  # noqa: PLW0603
    if _function is None:
        raise CurateError("a worker started without its function")
    if not _opened:
        # Here and not in the initializer, so that the error reaches the caller in its own words.
        _function.open()
        _opened = True
    return attempt(_function, job)
