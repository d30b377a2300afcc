"""Read an exported label file safely: it may come from an untrusted source.

A SQLite file can contain more than rows, for example a view that returns rows without end, or a
column with an expression that fills the memory. Therefore only tables with exactly the definition
in `curate.exporters.sqlite` are read, and the amount of data is bounded by the size of the file.
Versions 1 and 2 are supported; the further evidence of version 2 must be plain columns.
"""

import json
import re
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from curate.errors import DataError, LeakageError, one_line
from curate.exporters.base import named
from curate.exporters.sqlite import raise_if_locked, tables
from curate.weighting.base import ZeroWeight

_VERSIONS = ("1", "2")
_KEYS = ("categories", "round", "policy", "root")
# The columns after the core columns of `label`, in a file of version 2.
_FURTHER_COLUMNS = r"(?: [a-z]\w* (?:INTEGER|REAL|TEXT)(?: NOT NULL)?,)*"
_PYTHON_TYPES: Final = {"INTEGER": int, "REAL": float, "TEXT": str}
# No cell of a label file is longer. SQLite's own limit is a gigabyte.
_LONGEST_CELL = 1 << 24


@dataclass(frozen=True)
class LabelFileFrames:
    """The frames of a label file, and the numbers of its rows.

    Attributes:
        splits: the split of each frame in the file.
        truth: the frames with ground truth.
        objects: number of ground truth rows.
        labels: number of label rows.
    """

    splits: Mapping[str, str]
    truth: frozenset[str]
    objects: int
    labels: int


@contextmanager
def open_label_file(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a label file read-only and check that its tables have the definition of an export.

    Raises:
        DataError: if the file is missing or damaged, or its tables are different.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such label file; export the labels first")
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as rows:
            rows.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_CELL)
            rows.execute("PRAGMA trusted_schema = OFF")
            rows.execute("PRAGMA cell_size_check = ON")
            _check_tables(rows, path)
            yield rows
    except (sqlite3.Error, OverflowError, UnicodeDecodeError) as error:
        raise_if_locked(path, error)
        raise DataError(
            f"{path}: not a label file: {one_line(error)}; delete it and export it again"
        ) from None


def read_meta(rows: sqlite3.Connection, path: Path) -> Mapping[str, str]:
    """Return the rows of the table `meta`.

    Raises:
        DataError: if the file has another version, or a key is missing.
    """
    meta = dict(rows.execute("SELECT key, value FROM meta"))
    version = meta.get("format_version")
    if version not in _VERSIONS:
        raise DataError(
            f"{path}: label format {version!r}, expected {' or '.join(_VERSIONS)}; "
            "export it again with this version"
        )
    missing = [key for key in _KEYS if key not in meta]
    if missing:
        raise DataError(
            f"{path}: meta lacks {', '.join(missing)}; delete the file and export it again"
        )
    return meta


def read_categories(meta: Mapping[str, str], path: Path) -> tuple[str, ...]:
    """Return the categories to learn.

    Raises:
        DataError: if they are not a list of names.
    """
    try:
        names = json.loads(meta["categories"])
    except (ValueError, RecursionError):
        names = None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DataError(
            f"{path}: meta.categories is not a list of names; delete the file and export it again"
        )
    return tuple(names)


def read_zero_weight(meta: Mapping[str, str], path: Path) -> ZeroWeight:
    """Return the meaning of weight 0; "ignore" for an older file without this row.

    Raises:
        DataError: if it is neither "background" nor "ignore".
    """
    match meta.get("zero_weight", "ignore"):
        case "background":
            return "background"
        case "ignore":
            return "ignore"
        case other:
            raise DataError(
                f"{path}: meta.zero_weight is {other!r}, expected background or ignore; delete the "
                "file and export it again"
            )


def check_leakage(rows: sqlite3.Connection, path: Path) -> None:
    """Raise LeakageError if a label file holds ground truth of frames that are not labeled."""
    leaked = rows.execute(
        "SELECT DISTINCT frame FROM ground_truth WHERE frame NOT IN "
        "(SELECT frame FROM frame WHERE split = 'labeled') ORDER BY frame"
    ).fetchall()
    if leaked:
        raise LeakageError(
            f"{path}: ground truth of frames outside the labeled split: "
            f"{named(frame for (frame,) in leaked)}; training may use ground truth of "
            "labeled frames only: export the labels again"
        )


def read_frames(path: Path) -> LabelFileFrames:
    """Return the frames of a label file.

    Raises:
        DataError: if the file is missing or damaged, has another version, or is not a label file.
    """
    with open_label_file(path) as rows:
        read_meta(rows, path)
        splits = dict(rows.execute("SELECT frame, split FROM frame"))
        truth = dict(rows.execute("SELECT frame, count(*) FROM ground_truth GROUP BY frame"))
        [labels] = rows.execute("SELECT count(*) FROM label").fetchone()
    return LabelFileFrames(splits, frozenset(truth), sum(truth.values()), labels)


@contextmanager
def read_label_rows(
    path: Path,
) -> Iterator[tuple[Mapping[str, type[int] | type[float] | type[str]], Iterator[Sequence[Any]]]]:
    """Open a label file and yield the Python type of each label column, and the rows.

    Raises:
        DataError: if the file is missing or damaged, has another version, or is not a label file.
    """
    with open_label_file(path) as rows:
        read_meta(rows, path)
        declared = rows.execute("SELECT name, type FROM pragma_table_info('label')").fetchall()
        kinds = {name: _PYTHON_TYPES[kind] for name, kind in declared}
        yield kinds, rows.execute(f"SELECT {', '.join(kinds)} FROM label ORDER BY rowid")  # noqa: S608


def _check_tables(rows: sqlite3.Connection, path: Path) -> None:
    """Raise DataError if a table is missing or differs from that of an export."""
    found = dict(rows.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
    for name, statement in _statements().items():
        if name not in found:
            raise DataError(
                f"{path}: not a label file: no table {name}; delete it and export it again"
            )
        if not re.fullmatch(statement, _normalized(str(found[name])), re.ASCII):
            raise DataError(
                f"{path}: table {name} differs from that of an export; delete the file and "
                "export it again"
            )


def _statements() -> Mapping[str, str]:
    """Return a pattern for the normalized CREATE TABLE statement of each table."""
    parts = [part.strip() for part in _normalized(tables()).split(";") if part.strip()]
    patterns = {part.split()[2]: re.escape(part) for part in parts}
    core, generated, rest = patterns["label"].partition(re.escape(" split TEXT GENERATED"))
    return patterns | {"label": core + _FURTHER_COLUMNS + generated + rest}


def _normalized(statement: str) -> str:
    """Return an SQL statement without comments and with single spaces."""
    return " ".join(re.sub(r"--[^\n]*", " ", statement).split())
