"""Exports that are a folder: whole or not there, and nothing replaced but a former export.

DIRECTORY/export.json marks the folder as an export and says in which format.
"""

import glob
import json
import os
import pickle
import shutil
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from curate.exporters.place import check_place

_MARKER = "export.json"
# Read by every Python 3 that a training framework still runs on.
_PICKLE_PROTOCOL = 4


def write_folder(
    directory: Path, format_name: str, fill: Callable[[Path], Mapping[str, Any]]
) -> Mapping[str, Any]:
    """Write an export folder, whole or not at all; a former export in its place is replaced.

    Args:
        directory: absent, empty, or a former export of the same format.
        format_name: what the marker says.
        fill: writes the content into an existing folder; what it returns goes into the marker.

    Returns:
        What `fill` returned.

    Raises:
        ConfigError: if the directory holds something else.
    """
    check_place(directory, lambda former: _is_former(former, format_name))
    partial = _own_partial(directory)
    try:
        partial.mkdir(parents=True)
        facts = fill(partial)
        marker = json.dumps({"format": format_name, **facts}, indent=2)
        (partial / _MARKER).write_text(marker + "\n", encoding="utf-8")
        _take_place(partial, directory)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return facts


def write_pickle(path: Path, value: Any) -> None:
    """Write plain containers of numpy arrays so that any numpy reads them.

    numpy 2 names a module in its own pickles that releases before 1.26 do not have, and these are
    what the frameworks that read such files run on.
    """
    with path.open("wb") as stream:
        _ArrayPickler(stream, protocol=_PICKLE_PROTOCOL).dump(value)


class _ArrayPickler(pickle.Pickler):
    """Arrays as calls of `numpy.ndarray` with shape, type and content."""

    def reducer_override(self, value: Any) -> Any:
        if type(value) is not np.ndarray:
            return NotImplemented
        # Over a bytearray, which unlike bytes leaves the array writable.
        return np.ndarray, (value.shape, value.dtype.str, bytearray(value.tobytes()))


def _is_former(directory: Path, format_name: str) -> bool:
    """Return whether a folder is empty, or an export of that format."""
    if directory.is_dir() and not any(directory.iterdir()):
        return True
    marker = json.loads((directory / _MARKER).read_text(encoding="utf-8"))
    return bool(marker["format"] == format_name)


def _own_partial(directory: Path) -> Path:
    """A place beside an export that no other process writes to; those of killed ones are removed.

    Two processes that shared one would mix their files, or end with half an export.
    """
    own = f".{directory.name}.{socket.gethostname()}-"
    for left in directory.parent.glob(f"{glob.escape(own)}*.partial"):
        process = left.stem.removeprefix(own)
        if process.isdecimal() and not _runs(int(process)):
            shutil.rmtree(left, ignore_errors=True)
    return directory.with_name(f"{own}{os.getpid()}.partial")


def _runs(process: int) -> bool:
    """Return whether a process of this machine has that number, and is not this one."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        return True
    return process != os.getpid()


def _take_place(partial: Path, directory: Path) -> None:
    """Move a finished folder to its place, and what was there out of the way first."""
    former = partial.with_suffix(".former")
    shutil.rmtree(former, ignore_errors=True)
    if directory.exists():
        directory.rename(former)
    partial.rename(directory)
    shutil.rmtree(former, ignore_errors=True)
