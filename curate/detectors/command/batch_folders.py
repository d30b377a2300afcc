"""Folders of the batches of a command: removed after success, the last failed ones are kept.

Every try has a fresh folder, so nothing that a command of a killed run still writes can reach the
results of another one. A lock on the folder shows that its process lives; folders of processes
that were killed are removed at the next start.
"""

import fcntl
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

KEPT_FAILURES = 3
KEPT_LOGS = 200
_LOCK = "lock"
# A folder without a lock that is younger than this is new: its process has not locked it yet.
_LOCKED_AFTER_S = 60.0


class BatchFolders:
    """The folders of batches in a workspace.

    Args:
        parent: folder of the workspace.
    """

    def __init__(self, parent: Path) -> None:
        self._batches = parent / "batches"
        self._logs = parent / "logs"

    def remove_stale(self) -> None:
        """Remove the folders that killed processes have left."""
        for folder in self._batches.glob("batch-*"):
            if _is_stale(folder):
                shutil.rmtree(folder, ignore_errors=True)

    @contextmanager
    def new(self) -> Iterator[Path]:
        """Yield a fresh folder, which is removed afterwards unless it was kept."""
        self._batches.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix="batch-", dir=self._batches))
        try:
            with (folder / _LOCK).open("wb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def keep(self, folder: Path, name: str) -> Path:
        """Rename the folder of a failed batch, and remove the oldest ones; return the new path."""
        kept = self._batches / f"failed-{name}"
        shutil.rmtree(kept, ignore_errors=True)
        folder.rename(kept)
        for old in _newest_first(self._batches.glob("failed-*"))[KEPT_FAILURES:]:
            shutil.rmtree(old, ignore_errors=True)
        return kept

    def log(self, name: str) -> Path:
        """Return the path of the log of a batch; the oldest logs are removed."""
        self._logs.mkdir(parents=True, exist_ok=True)
        for old in _newest_first(self._logs.glob("round-*.log"))[KEPT_LOGS - 1 :]:
            old.unlink(missing_ok=True)
        return self._logs / f"{name}.log"


def _is_stale(folder: Path) -> bool:
    try:
        with (folder / _LOCK).open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
    except FileNotFoundError:
        with suppress(FileNotFoundError):
            return time.time() - folder.stat().st_mtime > _LOCKED_AFTER_S
    except OSError:  # its process holds the lock
        pass
    return False


def _newest_first(paths: Iterator[Path]) -> list[Path]:
    found = []
    for path in paths:
        with suppress(FileNotFoundError):  # another worker has removed it
            found.append((path.stat().st_mtime, path))
    return [path for _, path in sorted(found, reverse=True)]
