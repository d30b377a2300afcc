"""Write exports that are a folder: atomically, and replacing nothing but a previous export.

DIRECTORY/export.json marks the folder as an export and contains the name of its format.
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
# Every Python 3 that training frameworks still use can read this version.
_PICKLE_PROTOCOL = 4


def write_folder(
    directory: Path, format_name: str, fill: Callable[[Path], Mapping[str, Any]]
) -> Mapping[str, Any]:
    """Write an export folder atomically; a previous export at the same path is replaced.

    Args:
        directory: absent, empty, or a previous export of the same format.
        format_name: name of the format, written to the marker file.
        fill: writes the content into an existing folder; its result goes into the marker file.

    Returns:
        The result of `fill`.

    Raises:
        ConfigError: if the directory contains something else.
    """
    check_place(directory, lambda former: _is_export(former, format_name))
    partial = _partial_folder(directory)
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
    """Write plain containers of numpy arrays in a form that any numpy version reads.

    Pickles of numpy 2 refer to a module that numpy before 1.26 does not have. The frameworks that
    read these files often use such an old numpy.
    """
    with path.open("wb") as stream:
        _ArrayPickler(stream, protocol=_PICKLE_PROTOCOL).dump(value)


class _ArrayPickler(pickle.Pickler):
    """Pickle arrays as calls of `numpy.ndarray` with shape, type and content."""

    def reducer_override(self, value: Any) -> Any:
        if type(value) is not np.ndarray:
            return NotImplemented
        # An array over bytes would be read-only; over a bytearray it is writable.
        return np.ndarray, (value.shape, value.dtype.str, bytearray(value.tobytes()))


def _is_export(directory: Path, format_name: str) -> bool:
    """Return whether a folder is empty or an export of this format."""
    if directory.is_dir() and not any(directory.iterdir()):
        return True
    marker = json.loads((directory / _MARKER).read_text(encoding="utf-8"))
    return bool(marker["format"] == format_name)


def _partial_folder(directory: Path) -> Path:
    """Return a folder next to an export for this process only; remove those of dead processes.

    Two processes that write to the same folder would mix their files.
    """
    prefix = f".{directory.name}.{socket.gethostname()}-"
    for leftover in directory.parent.glob(f"{glob.escape(prefix)}*.partial"):
        process = leftover.stem.removeprefix(prefix)
        if process.isdecimal() and not _runs(int(process)):
            shutil.rmtree(leftover, ignore_errors=True)
    return directory.with_name(f"{prefix}{os.getpid()}.partial")


def _runs(process: int) -> bool:
    """Return whether another process of this machine has this id."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        return True
    return process != os.getpid()


def _take_place(partial: Path, directory: Path) -> None:
    """Move a finished folder to its final path; a previous export is moved away and removed."""
    former = partial.with_suffix(".former")
    shutil.rmtree(former, ignore_errors=True)
    if directory.exists():
        directory.rename(former)
    partial.rename(directory)
    shutil.rmtree(former, ignore_errors=True)
