"""Files that are either whole or absent: written beside their place, then renamed into it."""

import os
from pathlib import Path


def replace_file(path: Path, content: bytes) -> None:
    """Writes `content` to `path`; a reader, or a kill at any moment, never sees half of it.

    Missing parent folders are made. An existing file is replaced.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        try:
            partial.write_bytes(content)
        except FileNotFoundError:
            path.parent.mkdir(parents=True, exist_ok=True)
            partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
