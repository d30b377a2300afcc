"""A job in a process of its own: one thread, its log in a file, and no life after its parent."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from pipelines.bench.grid import Job

# Takes a kind of work and how many units of it are done.
ProgressCallback = Callable[[str, int], None]
LOGS = "logs"
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


class JobProcesses:
    """Runs jobs of a bench as processes, from several threads at once."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._running: set[subprocess.Popen[str]] = set()
        self._ended = False
        self._lock = threading.Lock()

    def __call__(self, job: Job, told: ProgressCallback) -> str | None:
        """Run a job to its end; gives None, or in one line why it failed."""
        log = self._root / LOGS / f"{job.name}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("w", encoding="utf-8") as stream:
            try:
                process = self._start(job, stream.fileno())
            except OSError as error:
                return f"cannot be started: {error}"
            if process is None:
                return "interrupted"
            with process:  # which closes its pipes
                for line in process.stdout or ():
                    with contextlib.suppress(ValueError, KeyError):  # not ours, or cut by a kill
                        message = json.loads(line)
                        told(message["kind"], int(message["units"]))
        with self._lock:
            self._running.discard(process)
        return None if process.returncode == 0 else _reason(process.returncode, log)

    def end(self) -> None:
        """Kill what runs and starts nothing more; the next run goes on from there."""
        with self._lock:
            self._ended = True
            for process in self._running:
                process.kill()

    def _start(self, job: Job, log: int) -> subprocess.Popen[str] | None:
        method = [] if job.method is None else ["--method", job.method]
        command = [
            *(sys.executable, "-m", "curate_command", "bench-cell", str(self._root)),
            *("--ratio", repr(job.ratio), "--seed", str(job.seed), *method),
        ]
        with self._lock:
            if self._ended:
                return None
            process = subprocess.Popen(  # noqa: S603
                command,
                stdin=subprocess.PIPE,  # it ends where this does, see `end_with_parent`
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env=os.environ | dict.fromkeys(_THREADS, "1"),
            )
            self._running.add(process)
        return process


def end_with_parent() -> None:
    """End this process, whatever it does, once the pipe from its parent closes."""
    threading.Thread(target=_wait_for_end, daemon=True).start()


def _wait_for_end() -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    os._exit(1)


def _reason(code: int, log: Path) -> str:
    """Why a process failed, from the last line that it wrote."""
    if code < 0:
        return f"killed by signal {signal.Signals(-code).name}; {log}"
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    last = next((line for line in reversed(lines) if line.strip()), f"exit code {code}")
    return f"{last.removeprefix('error: ')}; {log}"
