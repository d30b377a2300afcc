"""All cores of one machine: one process per worker, each with its own model."""

import multiprocessing
import pickle
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from itertools import islice

from curate.errors import CurateError
from pipelines.executors.base import FrameFunction, FrameJob, Outcome, attempt

# Jobs handed out ahead per worker: enough to keep it busy, few enough to bound memory.
AHEAD = 4


class ProcessExecutor:
    """Works on frames in `workers` spawned processes, which live until `close`."""

    def __init__(self, workers: int = 1) -> None:
        self.workers = workers
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(workers, mp_context=context)

    def map(self, function: FrameFunction, jobs: Iterable[FrameJob]) -> Iterator[Outcome]:
        """One outcome per job, as they end.

        Raises:
            CurateError: a worker could not load its models, or was killed.
        """
        waiting = iter(jobs)
        packed = pickle.dumps(function)
        running = {
            self._pool.submit(_work, packed, job) for job in islice(waiting, self.workers * AHEAD)
        }
        try:
            while running:
                ended, running = wait(running, return_when=FIRST_COMPLETED)
                more = islice(waiting, len(ended))
                running |= {self._pool.submit(_work, packed, job) for job in more}
                yield from map(Future.result, ended)
        except BrokenProcessPool as error:
            raise CurateError(
                "a worker process was killed, perhaps for memory; "
                "run the command again with fewer workers, finished frames are kept"
            ) from error

    def close(self) -> None:
        """Ends the workers."""
        self._pool.shutdown(cancel_futures=True)


@lru_cache(maxsize=1)
def _opened(packed: bytes) -> FrameFunction:
    """The function of the stage at hand; the one before, with its models, is forgotten."""
    function: FrameFunction = pickle.loads(packed)  # noqa: S301 - from the parent process
    function.open()
    return function


def _work(packed: bytes, job: FrameJob) -> Outcome:
    return attempt(_opened(packed), job)
