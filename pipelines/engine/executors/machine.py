"""What this machine offers to worker processes: cores and memory."""

import logging
import os
from pathlib import Path

_log = logging.getLogger(__name__)

# Share of the free memory that workers may take; the rest is for the system's file cache.
_MEMORY_SHARE = 0.8
_CGROUP = Path("/sys/fs/cgroup")
_MEMINFO = Path("/proc/meminfo")
_STATUS = Path("/proc/self/status")


def usable_cores() -> int:
    """Return the number of cores that this process may use: affinity and the container's quota."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    quota = _words(_CGROUP / "cpu.max")
    if len(quota) == 2 and quota[0].isdigit():
        cores = min(cores or 1, max(1, int(quota[0]) // int(quota[1])))
    return cores or 1


def affordable_workers(workers: int, needed: int | None = None) -> int:
    """Return how many workers the free memory allows, at least 1 and at most `workers`.

    Where the system does not report its memory, all workers are allowed.

    Args:
        workers: number of workers.
        needed: bytes that a worker needs; by default as many as this process, which has a model
            loaded.
    """
    free, needed = _free_memory(), needed or _entry(_STATUS, "VmRSS:")
    if not free or not needed:
        return workers
    allowed = max(1, min(workers, int(free * _MEMORY_SHARE / needed)))
    if allowed < workers:
        _log.warning(
            "%d of %d processes: each needs about %d MiB, and %d MiB are free",
            *(allowed, workers, needed >> 20, free >> 20),
        )
    return allowed


def _free_memory() -> int:
    """Return the bytes that are free here and in the container; 0 if it is unknown."""
    free = _entry(_MEMINFO, "MemAvailable:")
    limit, used = _words(_CGROUP / "memory.max"), _words(_CGROUP / "memory.current")
    if limit and used and limit[0].isdigit():
        statistics = _words(_CGROUP / "memory.stat")
        cached = int(statistics[statistics.index("file") + 1]) if "file" in statistics else 0
        free = min(free, max(int(limit[0]) - int(used[0]) + cached, 1))
    return free


def _entry(path: Path, key: str) -> int:
    """Return the bytes of an entry such as "MemAvailable:  1024 kB"; 0 if there is none."""
    words = _words(path)
    return int(words[words.index(key) + 1]) << 10 if key in words else 0


def _words(path: Path) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return []
