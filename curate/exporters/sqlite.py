"""Weighted labels as one SQLite file: what a training needs, and what anyone can query with SQL.

The file keeps the two kinds of truth apart by construction: a row of `ground_truth` can only refer
to a frame of the labeled split, a row of `label` only to one of the unlabeled split, and other
splits cannot be written at all.
"""

import json
import os
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import ClassVar

from curate.errors import ConfigError, DataError, LeakageError
from curate.exporters.base import (
    FRAME_COLUMNS,
    GROUND_TRUTH_COLUMNS,
    WEIGHTED_LABEL_COLUMNS,
    LabelFileDescription,
    LabelSet,
    bad_weight,
    named,
    refuse_link,
)

FORMAT_VERSION = 1

# `label_file` reads no file whose tables are others.
TABLES = """
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
CREATE TABLE label (
    round INTEGER NOT NULL,
    frame TEXT NOT NULL,
    k INTEGER NOT NULL,
    category TEXT NOT NULL,
    x REAL NOT NULL, y REAL NOT NULL, z REAL NOT NULL,  -- box centre, metres, LiDAR frame
    length REAL NOT NULL CHECK (length > 0),
    width REAL NOT NULL CHECK (width > 0),
    height REAL NOT NULL CHECK (height > 0),
    yaw REAL NOT NULL,          -- radians, counter-clockwise from x
    score REAL NOT NULL,
    loss REAL,                  -- consistency loss L; NULL without a matched reprediction
    points INTEGER,             -- LiDAR points in the box
    points_threshold REAL,      -- m_th of the category
    rho_diff REAL,              -- Eq. 8
    mask_pixels INTEGER,        -- S, pixels of the category in the rectangle
    box_pixels INTEGER,         -- A, pixels of the rectangle
    rho_anno REAL,              -- Eq. 9
    rho_det REAL,               -- rho_diff * rho_anno
    lambda_u REAL,              -- age parameter, Eq. 4
    provenance TEXT NOT NULL CHECK (provenance IN ('detector', 'human')),
    policy TEXT NOT NULL,
    weight REAL NOT NULL CHECK (weight BETWEEN 0 AND 1),  -- v; 0: no object to learn
    split TEXT GENERATED ALWAYS AS ('unlabeled') VIRTUAL,
    FOREIGN KEY (frame, split) REFERENCES frame (frame, split)
) STRICT;
"""

_VIEW = (
    "CREATE VIEW weighted_labels AS "  # noqa: S608
    f"SELECT {', '.join(WEIGHTED_LABEL_COLUMNS)} FROM label;"
)

# An index that exists during the load makes it several times slower.
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
        """See `curate.exporters.base.Exporter`."""
        refuse_foreign(path)
        write_labels(
            path,
            description=labels.description,
            frames=labels.frames,
            ground_truth=labels.ground_truth,
            labels=labels.labels,
        )
        return len(labels.labels)


def write_labels(
    path: Path,
    *,
    description: LabelFileDescription,
    frames: Iterable[tuple],
    ground_truth: Iterable[tuple],
    labels: Iterable[tuple],
) -> None:
    """Writes the label file at `path`, whole or not at all; rows are streamed.

    Args:
        path: an existing file is replaced.
        description: see `LabelFileDescription`.
        frames: rows of `FRAME_COLUMNS`; paths relative to the description's root.
        ground_truth: rows of `GROUND_TRUTH_COLUMNS`, of labeled frames only.
        labels: rows of `WEIGHTED_LABEL_COLUMNS`, of unlabeled frames only. Python numbers, not
            numpy's.

    Raises:
        LeakageError: ground truth of a frame that is not labeled, or a frame of another split.
        DataError: a row does not fit its table, a label belongs to no unlabeled frame, or the disk
            is full.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(partial, isolation_level=None)) as connection:
            _fill(connection, path, description, (frames, ground_truth, labels))
        with partial.open("rb") as written:
            os.fsync(written.fileno())
        partial.replace(path)
    except sqlite3.OperationalError as error:
        raise DataError(
            f"{path}: cannot be written: {error}; see to the space and the rights of its folder"
        ) from None
    finally:
        partial.unlink(missing_ok=True)


def refuse_locked(path: Path, error: Exception) -> None:
    """DataError where a label file could not be read for another program's lock."""
    if "locked" in str(error):
        raise DataError(
            f"{path}: another program writes into it; end that one and run the command again"
        ) from None


def refuse_foreign(path: Path) -> None:
    """ConfigError where something would be lost that is no former export."""
    refuse_link(path)
    if not path.exists():
        return
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as former:
            former.execute("SELECT value FROM meta WHERE key = 'format_version'").fetchone()[0]
    except (sqlite3.Error, TypeError) as error:
        refuse_locked(path, error)
        raise ConfigError(f"{path}: is there and is no former export; name another file") from None


def refuse_leakage(connection: sqlite3.Connection, path: Path) -> None:
    """LeakageError where a label file holds ground truth of frames that are not labeled."""
    leaked = _strangers(connection, "ground_truth", "labeled")
    if leaked:
        raise LeakageError(
            f"{path}: ground truth of frames outside the labeled split: {leaked}; "
            "only labeled frames may bring ground truth into a training"
        )


def _fill(
    connection: sqlite3.Connection,
    path: Path,
    description: LabelFileDescription,
    rows: tuple[Iterable[tuple], Iterable[tuple], Iterable[tuple]],
) -> None:
    # The file is thrown away unless it gets finished: no journal is needed to undo a half.
    connection.executescript("PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF;" + TABLES)
    connection.execute("BEGIN")
    columns = (FRAME_COLUMNS, GROUND_TRUTH_COLUMNS, WEIGHTED_LABEL_COLUMNS)
    last: list[tuple] = [()]
    try:
        connection.executemany("INSERT INTO meta VALUES (?, ?)", _meta(description).items())
        for table, names, table_rows in zip(
            ("frame", "ground_truth", "label"), columns, rows, strict=True
        ):
            marks = ", ".join("?" * len(names))
            insert = f"INSERT INTO {table} ({', '.join(names)}) VALUES ({marks})"  # noqa: S608
            connection.executemany(insert, _remembered(table_rows, last))
        refuse_leakage(connection, path)
        _refuse_stray_labels(connection, path)
        connection.executescript(_VIEW + _INDEXES)
    except sqlite3.IntegrityError as error:
        if "split IN" in str(error):
            raise LeakageError(
                f"{path}: frame {last[0][0]} is of split {last[0][1]!r}; "
                "only labeled and unlabeled frames are trained on"
            ) from None
        if "weight BETWEEN" in str(error):
            raise bad_weight(last[0][1], last[0][2], last[0][-1]) from None
        raise DataError(f"{path}: a row was refused: {error}; the last was {last[0]}") from None
    except (sqlite3.ProgrammingError, sqlite3.InterfaceError) as error:
        reason = f"{error}; it was {last[0]}"
        raise DataError(f"{path}: a row does not fit its table: {reason}") from None


def _meta(description: LabelFileDescription) -> dict[str, str]:
    """The rows of `meta`."""
    return {
        "format_version": str(FORMAT_VERSION),
        "dataset": description.dataset,
        "root": str(description.root),
        "categories": json.dumps(list(description.categories)),
        "round": str(description.round),
        "policy": description.policy,
        "code_version": description.code_version,
    }


def _remembered(rows: Iterable[tuple], last: list[tuple]) -> Iterator[tuple]:
    """The rows; `last[0]` is the one that was taken last, for the message where it is refused."""
    for row in rows:
        last[0] = row
        yield row


def _refuse_stray_labels(connection: sqlite3.Connection, path: Path) -> None:
    strays = _strangers(connection, "label", "unlabeled")
    if strays:
        raise DataError(
            f"{path}: labels of frames outside the unlabeled split: {strays}; "
            "export labels of unlabeled frames only"
        )


def _strangers(connection: sqlite3.Connection, table: str, split: str) -> str:
    """The frames that a table may not refer to, as text; empty where there are none."""
    query = (
        f"SELECT DISTINCT frame FROM {table} WHERE frame NOT IN "  # noqa: S608
        "(SELECT frame FROM frame WHERE split = ?) ORDER BY frame"
    )
    return named(row[0] for row in connection.execute(query, (split,)))
