"""Reading an SQLite file in a folder without write permission.

SQLite reads a database with write-ahead log through a file that it creates beside it, so it cannot
open one in such a folder, unless it is opened as a file that does not change ("immutable"). That is
true as long as nobody can write there and the log is empty.
"""

import os
from pathlib import Path


def is_read_only(path: Path) -> bool:
    """Return whether a file exists that cannot be written, or is in a folder that cannot."""
    return path.is_file() and not (os.access(path, os.W_OK) and os.access(path.parent, os.W_OK))


def read_only_uri(path: Path) -> str:
    """Return the URI with which SQLite opens a file for reading.

    Args:
        path: of the file; characters with a meaning in URIs are quoted.
    """
    log = path.with_name(f"{path.name}-wal")
    complete = not log.exists() or log.stat().st_size == 0
    immutable = "&immutable=1" if is_read_only(path) and complete else ""
    return f"{path.resolve().as_uri()}?mode=ro{immutable}"
