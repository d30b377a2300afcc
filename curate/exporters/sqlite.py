"""Export weighted labels as one SQLite file, for training and for queries in SQL.

The tables prevent data leakage by their constraints: a row of `ground_truth` can only refer to a
labeled frame, a row of `label` only to an unlabeled frame, and there are no other splits.

A label file of version 1 has the core columns. Version 2 has columns of further evidence after
them. The row `zero_weight` of `meta` gives the meaning of weight 0; in older files, which lack this
row, it is "ignore".
"""

import json
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import ClassVar, Final

from curate.errors import DataError
from curate.exporters.base import LabelFileDescription, LabelRows, LabelSet
from curate.exporters.columns import WEIGHTED_LABELS
from curate.exporters.place import check_place
from curate.files.atomic import atomic_path
from curate.priors.base import Column

_FRAME_INSERTION = "INSERT INTO frame VALUES (?, ?, ?, ?, ?)"
_TYPES: Final = {"int32": "INTEGER", "int64": "INTEGER", "float64": "REAL", "name": "TEXT"}
_CHECKS: Final = {
    **dict.fromkeys(("length", "width", "height"), "{} > 0"),
    "provenance": "{} IN ('detector', 'human')",
    "weight": "{} BETWEEN 0 AND 1",
}
_FIXED_TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
CREATE TABLE frame (
    frame TEXT PRIMARY KEY,
    split TEXT NOT NULL CHECK (split IN ('labeled', 'unlabeled')),
    points TEXT NOT NULL,       -- paths below meta.root
    image TEXT,
    calibration TEXT NOT NULL,
    UNIQUE (frame, split)
) STRICT;
CREATE TABLE ground_truth (
    frame TEXT NOT NULL,
    k INTEGER NOT NULL,
    category TEXT NOT NULL,
    x REAL NOT NULL, y REAL NOT NULL, z REAL NOT NULL,  -- box centre, metres, LiDAR frame
    length REAL NOT NULL CHECK (length > 0),
    width REAL NOT NULL CHECK (width > 0),
    height REAL NOT NULL CHECK (height > 0),
    yaw REAL NOT NULL,          -- radians, counter-clockwise from x
    truncated REAL NOT NULL,    -- share outside the image
    occluded INTEGER NOT NULL,  -- KITTI's levels 0 to 3
    split TEXT GENERATED ALWAYS AS ('labeled') VIRTUAL,
    FOREIGN KEY (frame, split) REFERENCES frame (frame, split)
) STRICT;
"""

# Created after the rows are inserted: with the indexes, inserting is several times slower.
_INDEXES = """
CREATE UNIQUE INDEX ground_truth_frame ON ground_truth (frame, k);
CREATE UNIQUE INDEX label_frame ON label (frame, k, round, policy);
ANALYZE;
"""


class SqliteExporter:
    """An `Exporter` that writes one SQLite file."""

    name: ClassVar[str] = "sqlite"
    suffix: ClassVar[str] = ".sqlite"

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`.

        Raises:
            DataError: if a row does not fit its table, or the disk is full.
        """
        check_label_file_place(path)
        with atomic_path(path) as partial:
            try:
                with closing(sqlite3.connect(partial, isolation_level=None)) as connection:
                    return _fill(connection, path, labels)
            except sqlite3.OperationalError as error:
                raise DataError(
                    f"{path}: cannot be written: {error}; check the free space and the permissions "
                    "of its folder"
                ) from None


def check_label_file_place(path: Path) -> None:
    """Check that a label file replaces nothing but another label file.

    Raises:
        ConfigError: if something else is at the path.
    """
    check_place(path, lambda former: _is_export(former, path))


def tables(columns: Sequence[Column] = WEIGHTED_LABELS) -> str:
    """Return the SQL that creates the tables; `label_file` rejects files with other tables."""
    lines = "\n".join(f"    {_column(each)},  -- {_note(each)}" for each in columns)
    return f"""{_FIXED_TABLES}CREATE TABLE label (
{lines}
    split TEXT GENERATED ALWAYS AS ('unlabeled') VIRTUAL,
    FOREIGN KEY (frame, split) REFERENCES frame (frame, split)
) STRICT;
"""


def format_version(columns: Sequence[Column]) -> str:
    """Return the version of a label file with these columns."""
    return "1" if len(columns) == len(WEIGHTED_LABELS) else "2"


def raise_if_locked(path: Path, error: Exception) -> None:
    """Raise DataError if a label file could not be read because another program locks it."""
    if "locked" in str(error):
        raise DataError(
            f"{path}: another program is writing to this file; stop it and rerun the command"
        ) from None


def _column(column: Column) -> str:
    check = _CHECKS.get(column.name, "").format(column.name)
    return (
        f"{column.name} {_TYPES[column.kind]}"
        f"{'' if column.optional else ' NOT NULL'}{f' CHECK ({check})' if check else ''}"
    )


def _note(column: Column) -> str:
    """Return the meaning and the unit of a column on one line, for a comment."""
    unit = f" [{column.unit}]" if column.unit not in ("", "1") else ""
    return " ".join(column.meaning.split()) + unit


def _is_export(former: Path, path: Path) -> bool:
    query = "SELECT value FROM meta WHERE key = 'format_version'"
    try:
        with closing(sqlite3.connect(f"{former.absolute().as_uri()}?mode=ro", uri=True)) as opened:
            return opened.execute(query).fetchone() is not None
    except sqlite3.Error as error:
        raise_if_locked(path, error)
        return False


def _fill(connection: sqlite3.Connection, path: Path, labels: LabelSet) -> int:
    """Write all tables and return the number of labels."""
    names = labels.column_names
    view = f"CREATE VIEW weighted_labels AS SELECT {', '.join(names)} FROM label;"  # noqa: S608
    count = 0
    # No journal: an incomplete file is deleted, never rolled back.
    connection.executescript(
        "PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF;" + tables(labels.columns)
    )
    connection.execute("BEGIN")
    try:
        meta = _meta(labels.description, format_version(labels.columns))
        connection.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
        connection.executemany(
            _FRAME_INSERTION,
            ((f.frame, f.split, f.points, f.image, f.calibration) for f in labels.frames),
        )
        _insert(connection, path, "ground_truth", labels.truth())
        for block in labels.blocks():
            _insert(connection, path, "label", block)
            count += len(block.rows)
        connection.executescript(view + _INDEXES)
    except sqlite3.IntegrityError as error:
        raise DataError(f"{path}: a row violates a constraint: {error}") from None
    return count


def _insert(connection: sqlite3.Connection, path: Path, table: str, block: LabelRows) -> None:
    """Insert rows.

    Raises:
        DataError: if one does not fit the table; the message shows it.
    """
    marks = ", ".join("?" * len(block.names))
    statement = f"INSERT INTO {table} ({', '.join(block.names)}) VALUES ({marks})"  # noqa: S608
    before = connection.total_changes
    try:
        connection.executemany(statement, block.rows)
    except (sqlite3.IntegrityError, sqlite3.ProgrammingError, sqlite3.InterfaceError) as error:
        problem = "violates a constraint"
        if not isinstance(error, sqlite3.IntegrityError):
            problem = "does not fit its table"
        row = block.rows[connection.total_changes - before]
        raise DataError(f"{path}: a row {problem}: {error}; the row is {row}") from None


def _meta(about: LabelFileDescription, version: str) -> Mapping[str, str]:
    """Return the rows of `meta`."""
    return {
        "format_version": version,
        "dataset": about.dataset,
        "root": str(about.root),
        "categories": json.dumps(list(about.categories)),
        "round": str(about.round),
        "policy": about.policy,
        "zero_weight": about.zero_weight,
        "code_version": about.code_version,
    }
