"""A command as a tree of processes, and the peak memory of each."""

import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from support.paths import ROOT


def environment(**more: str) -> dict[str, str]:
    """Return the environment in which a `curate` process finds this tree and the toys."""
    import os

    path = f"{ROOT / 'tests'}:{ROOT}"
    return os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"} | more


def start(*arguments: object, **more: str) -> subprocess.Popen:
    """Start `curate ARGUMENTS`; `more` is added to its environment."""
    return subprocess.Popen(
        [sys.executable, "-m", "pipelines", *map(str, arguments)],
        env=environment(**more),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def descendants(pid: int) -> list[int]:
    """Return the processes below one, including the helper processes of multiprocessing."""
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except OSError:
        return []
    children = [int(word) for word in text.split()]
    return children + [below for child in children for below in descendants(child)]


def workers(pid: int) -> list[int]:
    """Return the worker processes of a command."""
    return [child for child in descendants(pid) if "spawn_main" in _command(child)]


def peaks(process: subprocess.Popen) -> tuple[int, int]:
    """Return the peak memory of a command and of its largest worker in KiB, once it has ended."""
    parent, worker = 0, 0
    while process.poll() is None:
        parent = max(parent, peak(process.pid))
        worker = max(worker, *map(peak, workers(process.pid)), 0)
        time.sleep(0.1)
    return parent, worker


def forget_peak() -> None:
    """Reset the peak memory of this process to its current size."""
    with suppress(OSError):  # only Linux can report peaks and reset them
        Path("/proc/self/clear_refs").write_text("5")


def peak(pid: int | str = "self") -> int:
    """Return the peak memory of a process in KiB, 0 if it has ended.

    The peak that `getrusage` reports starts with that of the parent process, so it cannot be used.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
    except OSError:
        return ""
