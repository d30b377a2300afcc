"""Database rows per second, against the bare driver with the same tables and pragmas."""

import shutil
import sqlite3

import numpy as np
import pytest
from benchmarks.measuring import OURS, measure
from benchmarks.rows import frame_rows, prediction_rows
from sqlalchemy import insert, select
from support.silent import Silent
from support.stored_tuples import COLUMNS, store

from db import bulk
from db.session import BUSY_TIMEOUT_MS, Database
from pipelines.engine.stage import RoundContext, RoundJob, Teacher
from pipelines.stages import solve
from pipelines.workspace.config import make_config
from pipelines.workspace.workspace import Workspace

FRAMES, EACH = 2000, 50
ROWS = FRAMES * EACH
WRITE = f"Writing {ROWS:,} rows of prediction (SQLite)"
READ = f"Reading {ROWS:,} rows of prediction (SQLite)"
COLUMN = f"Reading a column of {ROWS:,} labels into NumPy (SQLite)"
SOLVE = f"The stage solve on {ROWS:,} labels in SQLite, without writing"
WEIGHTS = f"Replacing {ROWS:,} rows of weight, as solve does (SQLite)"
BARE = "sqlite3, bare driver"


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """Return a workspace with frames and a round, but without predictions."""
    root = tmp_path_factory.mktemp("database")
    config = make_config({"dataset": {"root": root}}, "benchmark")
    workspace = Workspace.create(root / "work", config)
    with workspace.database.writing() as connection:
        store(connection, "frame", frame_rows(FRAMES))
        store(connection, "round", [(1, 3, None, "{}", "0", 0)])
    workspace.database.close()
    return workspace


@pytest.fixture(scope="module")
def predictions():
    """Return the rows of `prediction`."""
    return prediction_rows(FRAMES, EACH)


@pytest.fixture
def copies(template, tmp_path):
    """Return a function that copies the template and returns the path."""

    def fresh():
        path = tmp_path / f"{len(list(tmp_path.glob('*.db')))}.db"
        shutil.copyfile(template.root / "curate.db", path)
        return path

    return fresh


def bare_connection(path):
    """Return a connection of the bare driver with the pragmas of `db.session`."""
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")
    connection.execute("PRAGMA foreign_keys = ON")
    return connection


def write_bare(path, rows):
    """Write with sqlite3's executemany in one transaction."""
    connection = bare_connection(path)
    marks = ", ".join("?" * len(rows[0]))
    names = ", ".join(f'"{name}"' for name in COLUMNS["prediction"])
    connection.execute("BEGIN IMMEDIATE")
    connection.executemany(f"INSERT INTO prediction ({names}) VALUES ({marks})", rows)
    connection.execute("COMMIT")
    connection.close()


def write_ours(database, rows):
    """Write with `db.bulk.insert` in one transaction."""
    with database.writing() as connection:
        store(connection, "prediction", rows)
    database.close()


def write_core(database, rows):
    """Write with SQLAlchemy Core and a dictionary per row."""
    names = COLUMNS["prediction"]
    with database.writing() as connection:
        connection.execute(
            insert(bulk.table("prediction")),
            [dict(zip(names, row, strict=True)) for row in rows],
        )
    database.close()


WRITERS = {OURS: write_ours, BARE: write_bare, "SQLAlchemy Core, dictionaries": write_core}


@pytest.mark.parametrize("name", WRITERS)
def bench_write(benchmark, name, copies, predictions):
    """Insert into an empty table with its primary key, foreign keys and index."""
    last = []

    def setup() -> tuple[tuple, dict]:
        last[:] = [copies()]
        target = last[0] if name == BARE else Database(f"sqlite:///{last[0]}")
        return (target, predictions), {}

    measure(
        benchmark,
        WRITERS[name],
        group=WRITE,
        name=name,
        amount=ROWS,
        unit="rows",
        setup=setup,
        rounds=3,
    )
    connection = bare_connection(last[0])
    assert connection.execute("SELECT count(*) FROM prediction").fetchone() == (ROWS,)
    connection.close()


@pytest.mark.parametrize("name", [OURS, BARE])
def bench_read(benchmark, name, copies, predictions):
    """Read all rows with all columns, as tuples."""
    path = copies()
    write_bare(path, predictions)
    names = COLUMNS["prediction"]
    database, bare = Database(f"sqlite:///{path}"), bare_connection(path)

    def ours():
        with database.reading() as connection:
            return bulk.select(connection, select(bulk.table("prediction")))

    def driver():
        return bare.execute(f"SELECT {', '.join(names)} FROM prediction").fetchall()

    read = ours if name == OURS else driver
    rows = measure(benchmark, read, group=READ, name=name, amount=ROWS, unit="rows")
    assert len(rows) == ROWS
    database.close()
    bare.close()


@pytest.mark.parametrize("name", [OURS, BARE])
def bench_read_column(benchmark, name, copies, predictions):
    """Read the scores of all labels sorted by frame and k as an array, as solve does."""
    path = copies()
    write_bare(path, predictions)
    database, bare = Database(f"sqlite:///{path}"), bare_connection(path)
    prediction = bulk.table("prediction").c
    query = select(prediction.score).where(prediction.round == 1)
    query = query.order_by(prediction.frame_id, prediction.k)

    def ours():
        with database.reading() as connection:
            return bulk.select_columns(connection, query)["score"]

    def driver():
        sql = "SELECT score FROM prediction WHERE round = 1 ORDER BY frame_id, k"
        return np.array(bare.execute(sql).fetchall(), dtype=np.float64)[:, 0]

    read = ours if name == OURS else driver
    found = measure(benchmark, read, group=COLUMN, name=name, amount=ROWS, unit="values")
    assert np.array_equal(found, driver())
    database.close()
    bare.close()


@pytest.fixture(scope="module")
def solvable(template, predictions, tmp_path_factory):
    """Return a workspace with the evidence of every label."""
    workspace = Workspace.create(tmp_path_factory.mktemp("solve"), template.config)
    workspace.database.close()
    shutil.copyfile(template.root / "curate.db", workspace.root / "curate.db")
    generator = np.random.default_rng(1)
    keys = [row[:3] for row in predictions]
    losses, rhos = generator.exponential(1, ROWS).tolist(), generator.random((2, ROWS)).tolist()
    evidence = {
        "consistency": [(*key, loss, 1, 1) for key, loss in zip(keys, losses, strict=True)],
        "point_prior": [(*key, 5, 10.0, rho) for key, rho in zip(keys, rhos[0], strict=True)],
        "semantic_prior": [(*key, 5, 10, rho) for key, rho in zip(keys, rhos[1], strict=True)],
    }
    with workspace.database.writing() as connection:
        store(connection, "prediction", predictions)
        for table, rows in evidence.items():
            store(connection, table, rows)
    return workspace


def solve_product(workspace):
    """Return the result of solve; its `write` stores the weights."""
    context = RoundContext(1, 3, 0, Teacher(workspace.root, ""))
    frames = list(workspace.frames("unlabeled").values())
    return solve.run(workspace, RoundJob(context, "pspsl", frames), Silent())


def bench_solve_reads(benchmark, solvable):
    """Read evidence joined from four tables, and compute the weight of every label."""
    measure(
        benchmark,
        lambda: solve_product(solvable),
        group=SOLVE,
        name="read the evidence, weigh",
        amount=ROWS,
        unit="labels",
        figure="rate",
    )


@pytest.mark.parametrize("name", [OURS, BARE])
def bench_solve_writes(benchmark, name, solvable):
    """Replace the rows of `weight`."""
    product = solve_product(solvable)

    def ours():
        with solvable.database.writing(keys_known=product.keys_known) as connection:
            product.write(connection)

    ours()
    with solvable.database.reading() as connection:
        rows = bulk.select(connection, select(bulk.table("weight")))
    solvable.database.close()

    def driver():
        connection = bare_connection(solvable.root / "curate.db")
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("DELETE FROM weight WHERE round = 1 AND policy = 'pspsl'")
        connection.executemany("INSERT INTO weight VALUES (?, ?, ?, ?, ?, ?, ?)", rows)
        connection.execute("COMMIT")
        connection.close()

    measure(
        benchmark,
        ours if name == OURS else driver,
        group=WEIGHTS,
        name=name,
        amount=ROWS,
        unit="rows",
    )
    with solvable.database.reading() as connection:
        assert bulk.select(connection, select(bulk.table("weight"))) == rows
    solvable.database.close()
