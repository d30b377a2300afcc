"""Labels per second of each export, from the database to the file, against the bare modules."""

import csv
import sqlite3
from contextlib import closing
from importlib.util import find_spec

import pytest
from benchmarks.measuring import OURS, cpu_seconds, measure
from support.large_workspace import large_workspace

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from curate.exporters.sqlite import tables
from pipelines.labels.stored_rows import StoredRows
from pipelines.registry import EXPORTERS
from pipelines.stages.export import label_set

pytestmark = pytest.mark.benchmark(timer=cpu_seconds)

LABELS = 100_000
FORMATS = ("sqlite", "csv", "parquet", "kitti", "openpcdet", "mmdet3d", "st3d")
GROUP = f"Exporting {LABELS:,} labels of 2,000 frames, from the database to the file"
TABLE = f"Writing {LABELS:,} labels as SQLite; curate reads and joins them first"
TEXT = f"Writing {LABELS:,} labels as CSV; curate reads and joins them first"
ROUNDS = 3


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """Return a workspace with weighted labels."""
    return large_workspace(tmp_path_factory.mktemp("exports"), (LABELS,))


@pytest.fixture(scope="module")
def rows(workspace):
    """Return the labels as tuples in memory."""
    with workspace.database.reading() as connection:
        blocks = StoredRows(connection, 1, "pspsl").blocks(WEIGHTED_LABEL_COLUMNS)
        return [row for block in blocks for row in block]


def export(workspace, name, path):
    """Write an export as the command does."""
    exporter = EXPORTERS.build(name, offered={}, options={})
    return exporter.write(path / f"{name}{exporter.suffix}", label_set(workspace, 1, "pspsl"))


@pytest.mark.parametrize("name", FORMATS)
def bench_export(benchmark, name, workspace, tmp_path):
    """Write an export; a former one is replaced."""
    if name == "parquet" and find_spec("pyarrow") is None:
        pytest.skip("pyarrow is an extra")
    count = measure(
        benchmark,
        lambda: export(workspace, name, tmp_path),
        group=GROUP,
        name=name,
        amount=LABELS,
        unit="labels",
        rounds=ROUNDS,
        figure="rate",
    )
    assert 0 < count <= LABELS


def bare_sqlite(rows, path):
    """Write rows with executemany into the same table, with the same index."""
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.executescript(f"PRAGMA synchronous = OFF; {tables()}")
        connection.execute("BEGIN")
        names, marks = ", ".join(WEIGHTED_LABEL_COLUMNS), ", ".join("?" * len(rows[0]))
        connection.executemany(f"INSERT INTO label ({names}) VALUES ({marks})", rows)
        connection.execute("CREATE UNIQUE INDEX label_frame ON label (frame, k, round, policy)")
        connection.execute("COMMIT")


def bare_csv(rows, path):
    """Write rows with the module csv."""
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


BARE = {
    "sqlite": (TABLE, "sqlite3 executemany, rows in memory", bare_sqlite),
    "csv": (TEXT, "csv.writer, rows in memory", bare_csv),
}


@pytest.mark.parametrize("name", BARE)
@pytest.mark.parametrize("ours", [True, False])
def bench_against_bare(benchmark, name, ours, workspace, rows, tmp_path):
    """Compare with a writer of rows that somebody else has read."""
    group, label, write = BARE[name]
    measure(
        benchmark,
        (lambda: export(workspace, name, tmp_path))
        if ours
        else (lambda: write(rows, tmp_path / "bare")),
        group=group,
        name=OURS if ours else label,
        amount=LABELS,
        unit="labels",
        rounds=ROUNDS,
    )
