"""A command as a tree of processes: how much memory each needed at most."""

import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from support.paths import ROOT


def environment(**more: str) -> dict[str, str]:
    """What a `curate` in a process of its own needs to find this tree and the toys."""
    import os

    path = f"{ROOT / 'tests'}:{ROOT}"
    return os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"} | more


def start(*arguments: object, **more: str) -> subprocess.Popen:
    """`curate ARGUMENTS`, started; `more` goes into its environment."""
    return subprocess.Popen(
        [sys.executable, "-m", "pipelines", *map(str, arguments)],
        env=environment(**more),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def descendants(pid: int) -> list[int]:
    """The processes below one, those that multiprocessing starts for itself included."""
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except OSError:
        return []
    children = [int(word) for word in text.split()]
    return children + [below for child in children for below in descendants(child)]


def workers(pid: int) -> list[int]:
    """The worker processes of a command."""
    return [child for child in descendants(pid) if "spawn_main" in _command(child)]


def peaks(process: subprocess.Popen) -> tuple[int, int]:
    """The peak memory of a command and of its largest worker in KiB, once it has ended."""
    parent, worker = 0, 0
    while process.poll() is None:
        parent = max(parent, peak(process.pid))
        worker = max(worker, *map(peak, workers(process.pid)), 0)
        time.sleep(0.1)
    return parent, worker


def forget_peak() -> None:
    """Lets the peak of this process begin anew, with what it has now."""
    with suppress(OSError):  # only Linux tells peaks, and lets them be forgotten
        Path("/proc/self/clear_refs").write_text("5")


def peak(pid: int | str = "self") -> int:
    """The peak memory of a process in KiB, 0 for none.

    The greatest size that `getrusage` tells begins with that of the process which started it.
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
