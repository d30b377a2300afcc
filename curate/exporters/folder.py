"""Write exports that are a folder: atomically, and replacing nothing but a previous export.

DIRECTORY/export.json marks the folder as an export and contains the name of its format.
"""

import glob
import io
import json
import os
import pickle
import shutil
import socket
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from curate.exporters.place import check_place

_MARKER = "export.json"
# Every Python 3 can read this version. Pickles can be joined because each of them numbers its
# objects from 0; in later versions a reader counts on.
_PICKLE_PROTOCOL = 3


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


@dataclass(frozen=True)
class Streamed:
    """Items that `write_pickle` writes one by one, without having all of them in memory.

    Attributes:
        items: the items of a list, or the keys and values of a dict.
        kind: what a reader gets.
    """

    items: Iterable[Any]
    kind: type[list[Any]] | type[dict[Any, Any]] = list


def write_pickle(path: Path, value: Any) -> None:
    """Write plain containers of numpy arrays in a form that any numpy version reads.

    Pickles of numpy 2 refer to a module that numpy before 1.26 does not have. The frameworks that
    read these files often use such an old numpy.

    Args:
        path: the file.
        value: the content. It, or values of a dict that it is, may be `Streamed`.
    """
    with path.open("wb") as stream:
        stream.write(pickle.PROTO + bytes([_PICKLE_PROTOCOL]))
        _write_value(stream, value)
        stream.write(pickle.STOP)


def _write_value(stream: BinaryIO, value: Any) -> None:
    """Write the opcodes that put a value onto the stack of a reader.

    Python's own pickler keeps every object that it has written, and all of its output, until the
    last one. Here each item of a stream is a pickle of its own, between the opcodes that append it.
    """
    if isinstance(value, Streamed) and value.kind is list:
        stream.write(pickle.EMPTY_LIST)
        stream.writelines(_opcodes(item) + pickle.APPEND for item in value.items)
        return
    pairs = value.items if isinstance(value, Streamed) else None
    if type(value) is dict and any(isinstance(each, Streamed) for each in value.values()):
        pairs = value.items()
    if pairs is None:
        stream.write(_opcodes(value))
        return
    stream.write(pickle.EMPTY_DICT)
    for key, item in pairs:
        stream.write(_opcodes(key))
        _write_value(stream, item)
        stream.write(pickle.SETITEM)


def _opcodes(value: Any) -> bytes:
    """Return the pickle of a value without its first and last opcode, the version and the end."""
    buffer = io.BytesIO()
    _ArrayPickler(buffer, protocol=_PICKLE_PROTOCOL).dump(value)
    return buffer.getvalue()[2:-1]


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
