"""nuScenes' tables: JSON files with an array of records each, read without its development kit.

Source: nuScenes' schema (nuscenes.org, docs/schema_nuscenes.md of its development kit). The kit
itself requires numpy < 2, so it cannot be installed beside this project.

`sample_data`, `ego_pose` and `sample_annotation` of the whole data set are hundreds of megabytes
each, and of their records one in thirty is needed: they are walked through in pieces, and only
records that are wanted are decoded. Their values hold no braces.
"""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import DataError, one_line
from curate.geometry.poses import pose_matrix

Record = Mapping[str, Any]

PIECE_BYTES = 8 << 20  # of a table that are text at a time
_RECORD = re.compile(rb"\{[^{}]*\}")
# How far the length of a quaternion may be from one; they are written with many digits.
_UNIT_SLACK = 0.01
# Metres and pixels; letters of tokens and of file names.
_LARGEST, _LONGEST = 1e7, 200


def read_table(path: Path) -> dict[str, Record]:
    """Return the records of a small table by their token.

    Raises:
        DataError: if the file is missing or no table.
    """
    try:
        records = json.loads(path.read_bytes())
    except OSError as error:
        raise _unreadable(path, error) from None
    except (RecursionError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as JSON: {one_line(error, 200)}") from None
    if not isinstance(records, list) or not all(isinstance(one, dict) for one in records):
        raise DataError(f"{path}: no table of records with a token")
    return {text(path, record, "token"): record for record in records}


def scan_table(path: Path) -> Iterator[tuple[int, bytes]]:
    """Where each record of a large table begins, and its text.

    Raises:
        DataError: if the file is missing, or ends within a record.
    """
    rest, place = b"", 0
    try:
        with path.open("rb") as file:
            while piece := file.read(PIECE_BYTES):
                text, end = rest + piece, 0
                for match in _RECORD.finditer(text):
                    yield place + match.start(), match.group()
                    end = match.end()
                rest, place = text[end:], place + end
    except OSError as error:
        raise _unreadable(path, error) from None
    if rest.strip() not in {b"]", b"[]"}:
        raise DataError(f"{path}: no table, or one that ends within a record; fetch it again")


def parse_record(path: Path, content: bytes) -> Record:
    """Return a record of a large table from its text; DataError where it is none."""
    try:
        record: Record = json.loads(content)
    except (RecursionError, ValueError) as error:
        raise DataError(f"{path}: a damaged record: {one_line(error, 200)}") from None
    return record


def field(path: Path, record: Record, name: str) -> Any:
    """Return a value of a record; DataError where there is none."""
    if name not in record:
        raise DataError(f"{path}: record {_named(record)} has no {name}")
    return record[name]


def text(path: Path, record: Record, name: str) -> str:
    """A token or a name of a record; DataError where it is none that a message can repeat."""
    found = field(path, record, name)
    if not isinstance(found, str) or not found.isprintable() or len(found) > _LONGEST:
        raise DataError(
            f"{path}: record {_named(record)}: {name} is no text of up to {_LONGEST} letters"
        )
    return found


def count(path: Path, record: Record, name: str) -> int:
    """Return a whole number of a record, from 0 on; DataError where it is none."""
    found = field(path, record, name)
    if not isinstance(found, int) or not 0 <= found <= _LARGEST:
        raise DataError(f"{path}: record {_named(record)}: {name} is no whole number from 0 on")
    return found


def numbers(path: Path, record: Record, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers of a record; DataError where they are absurd or of another shape."""
    try:
        found = np.array(field(path, record, name), dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        found = np.full(shape, np.nan)
    if found.shape != shape or not (np.abs(found) <= _LARGEST).all():
        wanted = " x ".join(map(str, shape))
        raise DataError(
            f"{path}: record {_named(record)}: {name} is not {wanted} finite numbers up to "
            f"{_LARGEST:g}"
        )
    return found


def quaternion(path: Path, record: Record) -> np.ndarray:
    """(4,) the rotation of a record, w, x, y, z of unit length; DataError where it is none."""
    rotation = numbers(path, record, "rotation", (4,))
    length = float(np.linalg.norm(rotation))
    if abs(length - 1) > _UNIT_SLACK:
        raise DataError(
            f"{path}: record {_named(record)}: rotation {rotation.tolist()} is no unit quaternion "
            f"(w, x, y, z), its length is {length:.3f}"
        )
    return rotation / length


def pose(path: Path, record: Record) -> np.ndarray:
    """Return (4, 4) pose of a record of ego_pose or calibrated_sensor."""
    return pose_matrix(numbers(path, record, "translation", (3,)), quaternion(path, record))


def _named(record: Record) -> str:
    """Return the token of a record as a message may repeat it."""
    token = record.get("token")
    return token[:80] if isinstance(token, str) and token.isprintable() else "without a token"


def _unreadable(path: Path, error: OSError) -> DataError:
    if isinstance(error, FileNotFoundError):
        return DataError(f"{path}: no such table; is ROOT the folder with samples/ and v1.0-*/?")
    return DataError(f"{path}: cannot be read: {error.strerror}")
