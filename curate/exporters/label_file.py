"""Reading an exported label file that anyone may have written or changed.

A SQLite file is more than rows: a table may be a view that never ends, or a column an expression
that fills the memory. Only the very tables that `curate.exporters.sqlite` makes are read, so what
is read is bounded by the size of the file. Files of version 1 and 2 are read; what the latter has
of further evidence may only be plain columns.
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
# Behind the core columns of `label`, in a file of version 2.
_FURTHER_COLUMNS = r"(?: [a-z]\w* (?:INTEGER|REAL|TEXT)(?: NOT NULL)?,)*"
_PYTHON_TYPES: Final = {"INTEGER": int, "REAL": float, "TEXT": str}
# No cell of a label file is longer; SQLite's own limit is a gigabyte.
_LONGEST_CELL = 1 << 24


@dataclass(frozen=True)
class LabelFileFrames:
    """Which frames a label file speaks of.

    Attributes:
        splits: the split that the file gives each frame.
        truth: the frames that have rows of ground truth.
        objects: rows of ground truth.
        labels: rows of labels.
    """

    splits: Mapping[str, str]
    truth: frozenset[str]
    objects: int
    labels: int


@contextmanager
def open_label_file(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that can only read the file, whose tables are what an export makes.

    Raises:
        DataError: if the file is missing or damaged, or of another version or kind.
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
    """What the file says about itself.

    Raises:
        DataError: if it is of another version, or says too little.
    """
    meta = dict(rows.execute("SELECT key, value FROM meta"))
    version = meta.get("format_version")
    if version not in _VERSIONS:
        raise DataError(
            f"{path}: label format {version!r}, this version reads {' and '.join(_VERSIONS)}; "
            "export again"
        )
    missing = [key for key in _KEYS if key not in meta]
    if missing:
        raise DataError(
            f"{path}: meta names no {', '.join(missing)}; delete it and export it again"
        )
    return meta


def read_categories(meta: Mapping[str, str], path: Path) -> tuple[str, ...]:
    """Return the categories to learn; DataError where they are no list of names."""
    try:
        names = json.loads(meta["categories"])
    except (ValueError, RecursionError):
        names = None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DataError(
            f"{path}: meta.categories is no list of names; delete it and export it again"
        )
    return tuple(names)


def read_zero_weight(meta: Mapping[str, str], path: Path) -> ZeroWeight:
    """Return what a label of weight 0 is; "ignore" where an older file does not say.

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
            f"{named(frame for (frame,) in leaked)}; only labeled frames may bring ground truth "
            "into a training"
        )


def read_frames(path: Path) -> LabelFileFrames:
    """Which frames a label file speaks of.

    Raises:
        DataError: if the file is missing or damaged, or of another version or kind.
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
    """Open a label file for its labels: the Python type of each column, and the rows.

    Raises:
        DataError: if the file is missing or damaged, or of another version or kind.
    """
    with open_label_file(path) as rows:
        read_meta(rows, path)
        declared = rows.execute("SELECT name, type FROM pragma_table_info('label')").fetchall()
        kinds = {name: _PYTHON_TYPES[kind] for name, kind in declared}
        yield kinds, rows.execute(f"SELECT {', '.join(kinds)} FROM label ORDER BY rowid")  # noqa: S608


def _check_tables(rows: sqlite3.Connection, path: Path) -> None:
    """Raise DataError if a table is not the one that an export makes."""
    found = dict(rows.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
    for name, statement in _statements().items():
        if name not in found:
            raise DataError(
                f"{path}: not a label file: no table {name}; delete it and export it again"
            )
        if not re.fullmatch(statement, _bare(str(found[name])), re.ASCII):
            raise DataError(
                f"{path}: table {name} is not the one that an export makes; delete it and "
                "export it again"
            )


def _statements() -> Mapping[str, str]:
    """Return a pattern of the bare CREATE TABLE statement of each table."""
    parts = [part.strip() for part in _bare(tables()).split(";") if part.strip()]
    patterns = {part.split()[2]: re.escape(part) for part in parts}
    core, generated, rest = patterns["label"].partition(re.escape(" split TEXT GENERATED"))
    return patterns | {"label": core + _FURTHER_COLUMNS + generated + rest}


def _bare(statement: str) -> str:
    """Return an SQL statement without comments, its spaces made one."""
    return " ".join(re.sub(r"--[^\n]*", " ", statement).split())
