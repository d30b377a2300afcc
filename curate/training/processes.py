"""A training on several processes of this machine, which split every batch.

The calling process starts the others and waits. It is the only one that writes files: the first
process sends it the progress, the snapshots and the final weights. The processes find each other
through a file, and exchange data over the loopback interface; the system chooses the ports.

    caller ── job ──> process 0 ── progress, snapshots, weights ──> caller
           ── job ──> process 1 ── errors ────────────────────────> caller
"""

import multiprocessing
import os
import pickle
import signal
import socket
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext
from pathlib import Path
from typing import TYPE_CHECKING

from torch import cuda, distributed

from curate.errors import ConfigError, CurateError, ModelError, ProcessDied, one_line
from curate.training.loop import Message, Place, Report, Trained, TrainingJob, run_steps
from curate.training.shared_sums import SharedSums

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

# A process that waits this long for another one takes it for lost.
TIMEOUT = timedelta(minutes=10)
# An error of one process may follow from the death of another, which is then seen within this time.
_GRACE_S = 2.0


Launch = Callable[[TrainingJob, int, Report], None]
"""Trains in a number of processes, and passes on what the first one reports.

Raises `ProcessDied` if a process was killed, and the error of a process that failed otherwise.
"""


def run_in_processes(job: TrainingJob, processes: int, report: Report) -> None:
    """Train in processes of this machine; they end with this one, even if it is killed.

    Args:
        job: what to train.
        processes: number of processes; on GPUs, each has its own.
        report: called with the messages of the first process.

    Raises:
        ConfigError: if there are fewer GPUs than processes.
        ProcessDied: if a process was killed.
        CurateError: if a process failed.
    """
    if job.settings.device.startswith("cuda") and processes > cuda.device_count():
        raise ConfigError(
            f"{processes} training processes need a GPU each, and this machine has "
            f"{cuda.device_count()}; set train.processes to that, or detector.device to cpu"
        )
    packed = packed_job(job)
    context = multiprocessing.get_context("spawn")
    sums = SharedSums(context, processes, TIMEOUT.total_seconds())
    with tempfile.TemporaryDirectory(prefix="curate-training-") as folder:
        group = _Group(processes, Path(folder) / "rendezvous", sums)
        crew: list[_Process] = []
        try:
            for rank in range(processes):
                crew.append(_Process(context, rank, group))  # noqa: PERF401 - the next may fail
            for process in crew:
                process.send(packed)
            _wait(crew, report)
        finally:
            for process in crew:
                process.kill()


def packed_job(job: TrainingJob) -> bytes:
    """Return a job as bytes for other processes.

    Raises:
        ModelError: if the student or the function that reads frames cannot be pickled.
    """
    try:
        return pickle.dumps(job)
    except Exception as error:  # a user's class may raise anything
        raise ModelError(
            f"cannot be sent to training processes: {one_line(error, 300)}; students and "
            "functions that read frames must be picklable, or set train.processes = 1"
        ) from error


def _wait(crew: "list[_Process]", report: Report) -> None:
    """Pass on messages until the training has ended."""
    sources: dict[object, _Process] = {}
    for process in crew:
        sources |= {process.connection: process, process.process.sentinel: process}
    while True:
        for ready in wait(list(sources)):  # type: ignore[arg-type]
            process = sources[ready]
            message = process.receive()
            if isinstance(message, CurateError):
                raise message
            if isinstance(message, str):
                _require_alive(crew, _GRACE_S)
                raise CurateError(f"training process {process.rank + 1} of {len(crew)}: {message}")
            if message is None:
                _require_alive(crew, 0.0)
                raise CurateError(f"training process {process.rank + 1} of {len(crew)} ended early")
            report(message)
            if isinstance(message, Trained):
                return


def _require_alive(crew: "list[_Process]", seconds: float) -> None:
    """Raise ProcessDied if a process has been killed, or is within the given time."""
    wait([process.process.sentinel for process in crew], seconds)
    for process in crew:
        code = process.process.exitcode or 0
        if code < 0:
            reason = ", perhaps for lack of memory" if code == -signal.SIGKILL else ""
            raise ProcessDied(
                f"training process {process.rank + 1} of {len(crew)} was ended by "
                f"{signal.Signals(-code).name}{reason}"
            )


@dataclass(frozen=True)
class _Group:
    """What the processes share.

    Attributes:
        processes: their number.
        rendezvous: file through which they find each other.
        sums: memory for small sums.
    """

    processes: int
    rendezvous: Path
    sums: SharedSums


class _Process:
    """A process of the training."""

    def __init__(self, context: SpawnContext, rank: int, group: "_Group") -> None:
        self.rank = rank
        self.connection, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_serve, args=(theirs, rank, group))
        self.process.start()
        theirs.close()

    def send(self, packed: bytes) -> None:
        """Send the job; if the process has ended already, `receive` will find that out."""
        try:
            self.connection.send_bytes(packed)
        except OSError:
            self.process.join(_GRACE_S)

    def receive(self) -> Message | CurateError | str | None:
        """Return the next message; None if the process has ended."""
        try:
            if self.connection.poll():
                content = self.connection.recv_bytes()
                message: Message | CurateError | str = pickle.loads(content)  # noqa: S301
                return message
        except (EOFError, OSError):
            pass
        self.process.join(_GRACE_S)
        return None

    def kill(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def _serve(connection: Connection, rank: int, group: _Group) -> None:
    """Run one of the processes, until the caller ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller gets it too, and ends this process

    def send(message: object) -> None:
        connection.send_bytes(pickle.dumps(message))

    job: TrainingJob = pickle.loads(connection.recv_bytes())  # noqa: S301 - of the caller
    threading.Thread(target=_end_with_caller, args=(connection,), daemon=True).start()
    try:
        place = _join_group(job.settings.device, rank, group)
        run_steps(job, place, send if rank == 0 else _ignore)
    except CurateError as error:
        send(error)
    except Exception as error:  # noqa: BLE001 - a user's detector may raise anything
        send(f"{type(error).__name__}: {one_line(error, 500)}")
    threading.Event().wait()  # the caller ends all processes together


def _join_group(device: str, rank: int, group: _Group) -> Place:
    """Join the other processes, and return the place of this one."""
    for name in _loopback_interfaces()[:1]:
        os.environ.setdefault("GLOO_SOCKET_IFNAME", name)
        os.environ.setdefault("NCCL_SOCKET_IFNAME", name)
    on_gpu = device.startswith("cuda")
    if on_gpu:
        cuda.set_device(rank)
    distributed.init_process_group(
        "nccl" if on_gpu else "gloo",
        init_method=group.rendezvous.as_uri(),
        rank=rank,
        world_size=group.processes,
        timeout=TIMEOUT,
    )
    if on_gpu:
        return Place(f"cuda:{rank}", rank, group.processes)
    return Place(device, rank, group.processes, partial(group.sums.sum, rank))


def _loopback_interfaces() -> list[str]:
    """Return the names of the interfaces that reach only this machine."""
    return [name for _, name in socket.if_nameindex() if name.startswith("lo")]


def _end_with_caller(connection: Connection) -> None:
    """End this process when the caller has closed the pipe or was killed."""
    with suppress(EOFError, OSError):
        connection.recv_bytes()
    os._exit(1)


def _ignore(message: object) -> None:
    """Drop the messages of the other processes; they are those of the first."""
