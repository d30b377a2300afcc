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

_PIECE_BYTES = 8 << 20
_RECORD = re.compile(rb"\{[^{}]*\}")
# How far the length of a quaternion may be from one; they are written with many digits.
_UNIT_SLACK = 0.01


def read_table(path: Path) -> dict[str, Record]:
    """The records of a small table by their token.

    Raises:
        DataError: the file is missing or no table.
    """
    try:
        records = json.loads(path.read_bytes())
        return {record["token"]: record for record in records}
    except OSError as error:
        raise _unreadable(path, error) from None
    except (ValueError, TypeError, KeyError) as error:
        raise DataError(f"{path}: no table of records with a token: {one_line(error)}") from None


def scan_table(path: Path) -> Iterator[tuple[int, bytes]]:
    """Where each record of a large table begins, and its text.

    Raises:
        DataError: the file is missing, or ends within a record.
    """
    rest, place = b"", 0
    try:
        with path.open("rb") as file:
            while piece := file.read(_PIECE_BYTES):
                text, end = rest + piece, 0
                for match in _RECORD.finditer(text):
                    yield place + match.start(), match.group()
                    end = match.end()
                rest, place = text[end:], place + end
    except OSError as error:
        raise _unreadable(path, error) from None
    if rest.strip() not in {b"]", b"[]"}:
        raise DataError(f"{path}: no table, or one that ends within a record; fetch it again")


def parse_record(path: Path, text: bytes) -> Record:
    """A record of a large table from its text; DataError where it is none."""
    try:
        record: Record = json.loads(text)
    except ValueError as error:
        raise DataError(f"{path}: a damaged record: {error}") from None
    return record


def field(path: Path, record: Record, name: str) -> Any:
    """A value of a record; DataError where there is none."""
    if name not in record:
        raise DataError(f"{path}: record {record.get('token', '?')} has no {name}")
    return record[name]


def numbers(path: Path, record: Record, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers of a record; DataError where they are not finite or of another shape."""
    try:
        found = np.array(field(path, record, name), dtype=np.float64)
    except (TypeError, ValueError):
        found = np.full(shape, np.nan)
    if found.shape != shape or not np.isfinite(found).all():
        wanted = " x ".join(map(str, shape))
        raise DataError(f"{path}: record {record['token']}: {name} is not {wanted} finite numbers")
    return found


def quaternion(path: Path, record: Record) -> np.ndarray:
    """(4,) the rotation of a record, w, x, y, z of unit length; DataError where it is none."""
    rotation = numbers(path, record, "rotation", (4,))
    length = float(np.linalg.norm(rotation))
    if abs(length - 1) > _UNIT_SLACK:
        raise DataError(
            f"{path}: record {record['token']}: rotation {rotation.tolist()} is no unit quaternion "
            f"(w, x, y, z), its length is {length:.3f}"
        )
    return rotation / length


def pose(path: Path, record: Record) -> np.ndarray:
    """(4, 4) pose of a record of ego_pose or calibrated_sensor."""
    return pose_matrix(numbers(path, record, "translation", (3,)), quaternion(path, record))


def _unreadable(path: Path, error: OSError) -> DataError:
    if isinstance(error, FileNotFoundError):
        return DataError(f"{path}: no such table; is ROOT the folder with samples/ and v1.0-*/?")
    return DataError(f"{path}: cannot be read: {error.strerror}")
