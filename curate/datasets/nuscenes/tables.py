"""Reader of nuScenes' tables: JSON files that each contain an array of records.

Source: nuScenes' schema (nuscenes.org, docs/schema_nuscenes.md of its development kit). The kit
itself requires numpy < 2, so it cannot be installed together with curate.

`sample_data`, `ego_pose` and `sample_annotation` of the whole data set have hundreds of megabytes
each, and only about one in thirty of their records is needed. They are therefore scanned in chunks,
and only the needed records are parsed. A regular expression finds the records, since their values
contain no braces:

    [{"token": "a1", ...}, {"token": "b2", ...}]   ->   (1, b'{"token": "a1", ...}'), ...
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import DataError
from curate.files.json_text import parse_json, read_json
from curate.geometry.poses import pose_matrix

Record = Mapping[str, Any]

CHUNK_BYTES = 8 << 20
_RECORD = re.compile(rb"\{[^{}]*\}")
# Allowed difference between the length of a quaternion and one.
_UNIT_TOLERANCE = 0.01
# Largest accepted number (metres or pixels), and longest accepted text (tokens and file names).
_MAX_NUMBER, _MAX_LENGTH = 1e7, 200


def read_table(path: Path) -> dict[str, Record]:
    """Return the records of a small table by token.

    Raises:
        DataError: if the file is missing or not a table.
    """
    if not path.exists():
        raise _unreadable(path, FileNotFoundError())
    records = read_json(path, "table")
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise DataError(f"{path}: not a table: expected a list of records with a token")
    return {text(path, record, "token"): record for record in records}


def scan_table(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the byte offset and the text of each record in a large table.

    Raises:
        DataError: if the file is missing, or ends within a record.
    """
    rest, offset = b"", 0
    try:
        with path.open("rb") as file:
            while chunk := file.read(CHUNK_BYTES):
                text, end = rest + chunk, 0
                for match in _RECORD.finditer(text):
                    yield offset + match.start(), match.group()
                    end = match.end()
                rest, offset = text[end:], offset + end
    except OSError as error:
        raise _unreadable(path, error) from None
    if rest.strip() not in {b"]", b"[]"}:
        raise DataError(f"{path}: not a table, or truncated within a record; fetch it again")


def parse_record(path: Path, content: bytes) -> Record:
    """Return a record of a large table, parsed from its text.

    Raises:
        DataError: if the text is not valid JSON.
    """
    record: Record = parse_json(content, f"{path}: a damaged record")
    return record


def field(path: Path, record: Record, name: str) -> Any:
    """Return a value of a record.

    Raises:
        DataError: if the record has no such field.
    """
    if name not in record:
        raise DataError(f"{path}: record {_shown_token(record)} has no {name}")
    return record[name]


def text(path: Path, record: Record, name: str) -> str:
    """Return a token or a name of a record.

    Raises:
        DataError: if it is missing or not a short printable string.
    """
    value = field(path, record, name)
    if not isinstance(value, str) or not value.isprintable() or len(value) > _MAX_LENGTH:
        raise DataError(
            f"{path}: record {_shown_token(record)}: {name} is not a printable text of up to "
            f"{_MAX_LENGTH} characters"
        )
    return value


def count(path: Path, record: Record, name: str) -> int:
    """Return a count of a record.

    Raises:
        DataError: if it is missing or not an integer from 0.
    """
    value = field(path, record, name)
    if not isinstance(value, int) or not 0 <= value <= _MAX_NUMBER:
        raise DataError(
            f"{path}: record {_shown_token(record)}: {name} is not an integer from 0 to "
            f"{_MAX_NUMBER:g}"
        )
    return value


def microseconds(path: Path, record: Record) -> int:
    """Return the timestamp of a record.

    Raises:
        DataError: if it is missing or not an integer from 0.
    """
    value = field(path, record, "timestamp")
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**63:
        raise DataError(
            f"{path}: record {_shown_token(record)}: timestamp is not a number of microseconds"
        )
    return value


def numbers(path: Path, record: Record, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of numbers of a record.

    Raises:
        DataError: if it is missing, of another shape, or not of finite numbers of sane size.
    """
    try:
        values = np.array(field(path, record, name), dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        values = np.full(shape, np.nan)
    if values.shape != shape or not (np.abs(values) <= _MAX_NUMBER).all():
        expected = " x ".join(map(str, shape))
        raise DataError(
            f"{path}: record {_shown_token(record)}: {name} is not {expected} finite numbers up to "
            f"{_MAX_NUMBER:g}"
        )
    return values


def quaternion(path: Path, record: Record) -> np.ndarray:
    """Return the (4,) rotation of a record as a unit quaternion w, x, y, z.

    Raises:
        DataError: if it is missing, malformed, or its length is not about one.
    """
    rotation = numbers(path, record, "rotation", (4,))
    length = float(np.linalg.norm(rotation))
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise DataError(
            f"{path}: record {_shown_token(record)}: rotation {rotation.tolist()} is not a unit "
            f"quaternion (w, x, y, z), its length is {length:.3f}"
        )
    return rotation / length


def pose(path: Path, record: Record) -> np.ndarray:
    """Return the (4, 4) pose in a record of ego_pose or calibrated_sensor."""
    return pose_matrix(numbers(path, record, "translation", (3,)), quaternion(path, record))


def _shown_token(record: Record) -> str:
    """Return the token of a record in a form that is safe to print in a message."""
    token = record.get("token")
    return token[:80] if isinstance(token, str) and token.isprintable() else "without a token"


def _unreadable(path: Path, error: OSError) -> DataError:
    if isinstance(error, FileNotFoundError):
        return DataError(
            f"{path}: no such table; set the root to the folder with samples/ and v1.0-*/"
        )
    return DataError(f"{path}: cannot be read: {error.strerror}")
