"""Find the process that holds the write lock of an SQLite database (Linux only).

Source: SQLite's documentation of locking ("File Locking And Concurrency", "WAL-mode File Format"):
a writer holds a POSIX lock on the file itself, in WAL mode on byte 120 of its -shm file.
"""

from collections.abc import Iterator
from math import inf
from pathlib import Path

WAL_WRITE_BYTE = 120
_LOCKS = Path("/proc/locks")  # Linux


def find_writers(database: Path) -> tuple[str, ...]:
    """Return the processes that write an SQLite database, as "process 123 (its command line)"."""
    database = database.resolve()  # SQLite creates the -shm file beside the file, not beside a link
    shared = database.with_name(database.name + "-shm")
    # In the database file any locked byte counts, in the -shm file only the writer's.
    spans = {
        path.stat().st_ino: span
        for path, span in ((database, (0, inf)), (shared, (WAL_WRITE_BYTE, WAL_WRITE_BYTE)))
        if path.exists()
    }
    writers = {
        pid: f"process {pid} ({_command(pid)})"
        for pid, inode, first, last in _write_locks()
        if inode in spans and first <= spans[inode][1] and last >= spans[inode][0]
    }
    return tuple(writers.values())


def _write_locks() -> Iterator[tuple[int, int, int, float]]:
    """Yield process, inode, first and last byte of every write lock on this machine."""
    try:
        lines = _LOCKS.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        fields = line.split()
        if fields[1:2] == ["POSIX"] and fields[3] == "WRITE":
            last = inf if fields[7] == "EOF" else float(fields[7])
            yield int(fields[4]), int(fields[5].split(":")[2]), int(fields[6]), last


def _command(pid: int) -> str:
    try:
        text = Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return "of another user"
    return " ".join(text.replace("\0", " ").split())[:120]
