"""All cores of one machine: one process per worker, each with its own model.

Every worker has a pipe of its own, so that it is known which frame was in the hands of a worker
that the system has killed; `ProcessPoolExecutor` then gives up all that it holds.
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
from pipelines.engine.executors.base import (
    IN_HAND,
    Job,
    JobFunction,
    JobQueue,
    Outcome,
    RayWorker,
)

# How often a look is taken at workers that say nothing: a process that a dead one has forked may
# hold its pipe open.
PULSE_S = 5.0


class ProcessExecutor:
    """Works on frames in `workers` spawned processes, which live until `close`."""

    def __init__(self, workers: int = 1) -> None:
        self.workers = workers
        self._crew: list[_Worker] = []

    def map(self, function: JobFunction, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """One outcome per job, as they end.

        Raises:
            CurateError: if the models cannot be loaded, or workers die while they load them.
        """
        queue = JobQueue(jobs, self.workers)
        packed = pickle.dumps(function)
        try:
            while True:
                self._dispatch(packed, queue)
                busy = {worker.connection: worker for worker in self._crew if worker.in_flight}
                if not busy:
                    return
                speaking = wait(list(busy), PULSE_S)
                for connection, worker in busy.items():
                    if connection in speaking or not worker.process.is_alive():
                        yield from self._collect(worker, queue)
        finally:
            for worker in [worker for worker in self._crew if worker.in_flight]:
                self._dismiss(worker)

    def close(self) -> None:
        """End the workers."""
        for worker in self._crew:
            worker.shut_down()
        for worker in list(self._crew):
            worker.process.join(PULSE_S)
            self._dismiss(worker)

    def _dispatch(self, packed: bytes, queue: JobQueue) -> None:
        while (job := queue.take()) is not None:
            idle = min(self._crew, key=lambda worker: len(worker.in_flight), default=None)
            if len(self._crew) < self.workers and (idle is None or idle.in_flight):
                self._crew.append(idle := _Worker())
            if idle is None or len(idle.in_flight) == IN_HAND:
                queue.return_jobs([job])
                return
            idle.send(packed, job)

    def _collect(self, worker: "_Worker", queue: JobQueue) -> Iterator[Outcome]:
        """What a worker answers; what it leaves behind if it is dead."""
        try:
            answer = worker.connection.recv() if worker.connection.poll() else EOFError()
        except (EOFError, OSError) as end:
            answer = end
        if isinstance(answer, EOFError | OSError):
            worker.process.join(PULSE_S)
            self._dismiss(worker)
            yield from queue.record_crash(
                list(worker.in_flight), worker.end(), opened=worker.opened
            )
            return
        if isinstance(answer, CurateError):
            raise answer
        if answer is None:
            worker.opened = True
            queue.opened()
        else:
            yield Outcome(worker.in_flight.popleft(), *answer)

    def _dismiss(self, worker: "_Worker") -> None:
        self._crew.remove(worker)
        worker.connection.close()
        worker.process.kill()
        worker.process.join()


class _Worker:
    """A process, and the jobs in its hands in the order in which it works on them."""

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
        """Hand a job over, and before it the function, where that is another one."""
        self.in_flight.append(job)
        with contextlib.suppress(OSError):  # it has died; its end of the pipe will tell
            if packed != self._packed:
                self._packed, self.opened = packed, False
                self.connection.send(packed)
            self.connection.send(job)

    def shut_down(self) -> None:
        """Let it end by itself, which a model may need to put its things in order."""
        with contextlib.suppress(OSError):
            self.connection.send(None)

    def end(self) -> str:
        """How a dead worker died."""
        code = self.process.exitcode or 0
        if code >= 0:
            return f"with exit code {code}"
        killed = ", perhaps for lack of memory" if code == -signal.SIGKILL else ""
        return f"by {signal.Signals(-code).name}{killed}"


def _serve(connection: Connection) -> None:
    """What a worker does all its life."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears it too, and ends us
    inbox: SimpleQueue[Any] = SimpleQueue()  # the packed function, jobs, None for the end
    Thread(target=_receive, args=(connection, inbox), daemon=True).start()
    holder = RayWorker()
    while (message := inbox.get()) is not None:
        if isinstance(message, bytes):
            connection.send(holder.open(message))
        elif holder.function is not None:
            connection.send(holder.work(message))


def _receive(connection: Connection, inbox: "SimpleQueue[Any]") -> None:
    """Empty the pipe, so that the parent never waits while it hands over.

    Where the parent has closed it, or was killed, nobody needs this process any more.
    """
    try:
        while True:
            inbox.put(connection.recv())
    except (EOFError, OSError):
        os._exit(0)
