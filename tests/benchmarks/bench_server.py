"""PostgreSQL rows per second, against its driver and SQLAlchemy with the same tables."""

import numpy as np
import pytest
from benchmarks.measuring import OURS, measure
from benchmarks.rows import frame_rows, prediction_rows
from sqlalchemy import insert, select
from support.stored_tuples import COLUMNS, store

from db import bulk
from db.session import Database

FRAMES, EACH = 300, 50
ROWS = FRAMES * EACH
WRITE = f"Writing {ROWS:,} rows of prediction (PostgreSQL)"
READ = f"Reading a column of {ROWS:,} rows (PostgreSQL)"
ROUNDS = 3


@pytest.fixture(scope="module")
def database(postgres):
    """Return a server database with frames and a round, but without predictions."""
    database = Database(postgres.new_database())
    with database.writing() as connection:
        store(connection, "frame", frame_rows(FRAMES))
        store(connection, "round", [(1, 3, None, "{}", "0", 0)])
    yield database
    database.close()


@pytest.fixture(scope="module")
def predictions():
    """Return the rows of `prediction`."""
    return prediction_rows(FRAMES, EACH)


def write_ours(connection, rows):
    """Write with COPY of named columns."""
    store(connection, "prediction", rows)


def write_copy(connection, rows):
    """Write with COPY, its text form created row by row."""
    names = ", ".join(f'"{name}"' for name in COLUMNS["prediction"])
    with connection.connection.cursor().copy(f"COPY prediction ({names}) FROM STDIN") as copy:
        for row in rows:
            copy.write_row(row)


def write_many(connection, rows):
    """Write with the driver's executemany, which pipelines the rows."""
    names = COLUMNS["prediction"]
    quoted, marks = ", ".join(f'"{name}"' for name in names), ", ".join(["%s"] * len(names))
    statement = f"INSERT INTO prediction ({quoted}) VALUES ({marks})"
    connection.connection.cursor().executemany(statement, rows)


def write_core(connection, rows):
    """Write with SQLAlchemy Core and a dictionary per row, a thousand rows per statement."""
    names = COLUMNS["prediction"]
    values = [dict(zip(names, row, strict=True)) for row in rows]
    connection.execute(insert(bulk.table("prediction")), values)


WRITERS = {
    OURS: write_ours,
    "psycopg, COPY row by row": write_copy,
    "psycopg, executemany": write_many,
    "SQLAlchemy Core, dictionaries": write_core,
}


@pytest.mark.parametrize("name", WRITERS)
def bench_server_write(benchmark, name, database, predictions):
    """Insert into an empty table with keys and index, in one transaction."""
    table = bulk.table("prediction")

    def emptied() -> tuple[tuple, dict]:
        with database.writing() as connection:
            connection.exec_driver_sql("TRUNCATE prediction CASCADE")
        return (predictions,), {}

    def write(rows):
        with database.writing() as connection:
            WRITERS[name](connection, rows)

    measure(
        benchmark,
        write,
        group=WRITE,
        name=name,
        amount=ROWS,
        unit="rows",
        setup=emptied,
        rounds=ROUNDS,
    )
    with database.reading() as connection:
        found = bulk.select(connection, select(table).order_by(table.c.frame_id, table.c.k))
    assert found == predictions


@pytest.mark.parametrize("name", [OURS, "SQLAlchemy Core, rows"])
def bench_server_read(benchmark, name, database, predictions):
    """Read the scores in the order of the key, as an array."""
    emptied = "TRUNCATE prediction CASCADE"
    with database.writing() as connection:
        connection.exec_driver_sql(emptied)
        store(connection, "prediction", predictions)
        bulk.refresh_statistics(connection)
    table = bulk.table("prediction").c
    query = select(table.score).order_by(table.round, table.frame_id, table.k)

    def ours():
        with database.reading() as connection:
            return bulk.select_columns(connection, query)["score"]

    def rows():
        with database.reading() as connection:
            return np.array([score for (score,) in connection.execute(query)])

    read = ours if name == OURS else rows
    found = measure(benchmark, read, group=READ, name=name, amount=ROWS, unit="rows")
    assert found.tolist() == [row[COLUMNS["prediction"].index("score")] for row in predictions]
