"""The executor for all cores of one machine: one process per worker, each with its own model.

Every worker has its own pipe. If the system kills a worker, the frame that it was processing is
known, and all other frames continue. `ProcessPoolExecutor` would fail all of them.
"""

import contextlib
import multiprocessing
import os
import pickle
import signal
from collections import deque
from collections.abc import Iterable, Iterator
from multiprocessing.connection import Connection, wait
from queue import SimpleQueue
from threading import Thread
from typing import Any

from curate.errors import CurateError
from curate.ranges import AtLeastOne
from pipelines.engine.executors.base import (
    FunctionHolder,
    Job,
    JobFunction,
    JobQueue,
    Outcome,
    allowed_workers,
    outcomes_of,
)
from pipelines.engine.executors.machine import usable_cores

# How often to check whether silent workers are alive: a crashed worker's pipe may be kept open by a
# process that it has forked.
POLL_S = 5.0


class ProcessExecutor:
    """Processes frames in spawned processes, which live until `close`.

    Args:
        workers: number of processes; None for one per usable core.
    """

    def __init__(self, workers: AtLeastOne | None = None) -> None:
        self.workers = usable_cores() if workers is None else workers
        self._workers: list[_Worker] = []

    def map(self, function: JobFunction, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """Yield one outcome per frame or sequence, in the order in which they end.

        Raises:
            CurateError: if the models cannot be loaded, or workers crash while they load them.
        """
        workers = allowed_workers(function, self.workers)
        queue = JobQueue(jobs, workers)
        packed = pickle.dumps(function)
        try:
            while True:
                self._dispatch(packed, queue, workers)
                busy = {worker.connection: worker for worker in self._workers if worker.in_flight}
                if not busy:
                    return
                readable = wait(list(busy), POLL_S)
                for connection, worker in busy.items():
                    if connection in readable or not worker.process.is_alive():
                        yield from self._collect(worker, queue)
        finally:
            for worker in [worker for worker in self._workers if worker.in_flight]:
                self._dismiss(worker)

    def close(self) -> None:
        """End the workers."""
        for worker in self._workers:
            worker.shut_down()
        for worker in list(self._workers):
            worker.process.join(POLL_S)
            self._dismiss(worker)

    def _dispatch(self, packed: bytes, queue: JobQueue, workers: int) -> None:
        while (job := queue.take()) is not None:
            crew = self._workers[:workers]
            free = [worker for worker in crew if queue.allows_another(worker.in_flight)]
            if len(crew) < workers and all(worker.in_flight for worker in free):
                self._workers.append(worker := _Worker())
                free.append(worker)
            if not free:
                queue.return_jobs([job])
                return
            min(free, key=lambda worker: len(worker.in_flight)).send(packed, job)

    def _collect(self, worker: "_Worker", queue: JobQueue) -> Iterator[Outcome]:
        """Yield the next outcome of a worker; if it has crashed, those of its failed jobs."""
        try:
            result = worker.connection.recv() if worker.connection.poll() else EOFError()
        except (EOFError, OSError) as end:
            result = end
        if isinstance(result, EOFError | OSError):
            worker.process.join(POLL_S)
            self._dismiss(worker)
            yield from queue.record_crash(
                list(worker.in_flight), worker.end(), opened=worker.opened
            )
            return
        if isinstance(result, CurateError):
            raise result
        if result is None:
            worker.opened = True
            queue.record_opened()
        else:
            yield from outcomes_of(worker.in_flight.popleft(), result)

    def _dismiss(self, worker: "_Worker") -> None:
        self._workers.remove(worker)
        worker.connection.close()
        worker.process.kill()
        worker.process.join()


class _Worker:
    """A worker process, and the jobs sent to it in the order in which it processes them."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,))
        self.process.start()
        theirs.close()
        self.in_flight: deque[Job] = deque()
        self.opened = False
        self._packed = b""

    def send(self, packed: bytes, job: Job) -> None:
        """Send a job, and before it the function if the worker does not have it yet."""
        self.in_flight.append(job)
        with contextlib.suppress(OSError):  # it has crashed; `_collect` will find that out
            if packed != self._packed:
                self._packed, self.opened = packed, False
                self.connection.send(packed)
            self.connection.send(job)

    def shut_down(self) -> None:
        """Ask the process to exit by itself, so that its models can release their resources."""
        with contextlib.suppress(OSError):
            self.connection.send(None)

    def end(self) -> str:
        """Return how the process ended, for a message."""
        code = self.process.exitcode or 0
        if code >= 0:
            return f"with exit code {code}"
        killed = ", perhaps for lack of memory" if code == -signal.SIGKILL else ""
        return f"by {signal.Signals(-code).name}{killed}"


def _serve(connection: Connection) -> None:
    """Run a worker process: load functions and process jobs until the connection ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it too, and ends the workers
    inbox: SimpleQueue[Any] = SimpleQueue()  # the packed function, jobs, None for the end
    Thread(target=_receive, args=(connection, inbox), daemon=True).start()
    holder = FunctionHolder()
    while (message := inbox.get()) is not None:
        if isinstance(message, bytes):
            connection.send(holder.open(message))
        elif holder.function is not None:
            connection.send(holder.work(message))


def _receive(connection: Connection, inbox: "SimpleQueue[Any]") -> None:
    """Move messages from the pipe to the inbox, so that the parent never blocks when it sends.

    The process exits when the parent has closed the pipe or was killed.
    """
    try:
        while True:
            inbox.put(connection.recv())
    except (EOFError, OSError):
        os._exit(0)
