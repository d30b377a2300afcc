"""Run a job in its own process: with one thread and a log file, and killed with its parent."""

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

# Called with a kind of work and the number of finished units.
ProgressCallback = Callable[[str, int], None]
LOGS = "logs"
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


class JobProcesses:
    """Run jobs of a bench as processes; several threads may call it at once."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._running: set[subprocess.Popen[str]] = set()
        self._ended = False
        self._lock = threading.Lock()

    def __call__(self, job: Job, on_progress: ProgressCallback) -> str | None:
        """Run a job and return None, or the reason of its failure in one line."""
        log = self._root / LOGS / f"{job.name}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("w", encoding="utf-8") as stream:
            try:
                process = self._start(job, stream.fileno())
            except OSError as error:
                return f"cannot be started: {error}"
            if process is None:
                return "interrupted"
            with process:  # closes its pipes
                for line in process.stdout or ():
                    # Other output, or a line that a kill cut off.
                    with contextlib.suppress(ValueError, KeyError):
                        message = json.loads(line)
                        on_progress(message["kind"], int(message["units"]))
        with self._lock:
            self._running.discard(process)
        return None if process.returncode == 0 else _reason(process.returncode, log)

    def end(self) -> None:
        """Kill the running jobs and start no others; the next run resumes them."""
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
                stdin=subprocess.PIPE,  # it closes when this process ends, see `end_with_parent`
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env=os.environ | dict.fromkeys(_THREADS, "1"),
            )
            self._running.add(process)
        return process


def end_with_parent() -> None:
    """End this process immediately when the pipe from its parent closes."""
    threading.Thread(target=_wait_for_end, daemon=True).start()


def _wait_for_end() -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    os._exit(1)


def _reason(code: int, log: Path) -> str:
    """Return why a process failed: its signal, or the last line of its log."""
    if code < 0:
        return f"killed by signal {signal.Signals(-code).name}; {log}"
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    last = next((line for line in reversed(lines) if line.strip()), f"exit code {code}")
    return f"{last.removeprefix('error: ')}; {log}"
