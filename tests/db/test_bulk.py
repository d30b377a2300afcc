"""Bulk writing and reading: every row is stored and read back, for any block size."""

import math
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import BigInteger, Connection, Float, Integer, Select, cast, literal, select, text
from support.one_frame import add_one_frame
from support.stored_tuples import COLUMNS, store

from curate.errors import DatabaseError
from db import bulk
from db.session import Database

ENGINES = ("sqlite", "postgresql")
COUNT = 23


@pytest.fixture
def database(database: Database) -> Database:
    """Return a database with a few predictions."""
    with database.writing() as connection:
        add_one_frame(connection)
        rows = [
            (1, 1, k, f"é{k}\t\\N\n", k / 7, *[k / 3] * 7, k / 9 if k % 2 else None)
            for k in range(COUNT)
        ]
        store(connection, "prediction", rows)
    return database


@pytest.mark.parametrize("count", [0, 1, 4, 49, 50, 51, 100, 149])
def test_rows_and_columns_are_stored_equally(database: Database, count: int) -> None:
    """To the last bit, for any number of rows per statement; null stays null."""
    keys = range(1000, 1000 + count)
    rows = [(1, 1, k, "Car", k / 7777, *[k / 3] * 7, None) for k in keys]
    weights = [
        (1, 1, k, "spsl", k / 3 if k % 2 else None, k / 7777, k / 9999, k / 8888) for k in keys
    ]
    with database.writing() as connection:
        store(connection, "prediction", rows)
        columns = [[row[i] for row in weights] for i in range(8)]
        values = dict(zip((*COLUMNS["weight"], "probability"), columns, strict=True))
        bulk.insert(connection, "weight", values | {"round": 1, "policy": "spsl"})
        table = bulk.table("prediction")
        found = bulk.select(connection, select(table).where(table.c.k >= 1000).order_by(table.c.k))
        assert found == rows
        table = bulk.table("weight")
        assert bulk.select(connection, select(table).order_by(table.c.k)) == weights


@pytest.mark.parametrize("block", [1, 5, COUNT, 50_000])
def test_columns_are_read_completely_and_in_order(
    database: Database, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    """To the last bit, including the first and the last row; null is NaN."""
    monkeypatch.setattr(bulk, "FETCHED_ROWS", block)
    monkeypatch.setattr(bulk, "BLOCK_ROWS", block)
    table = bulk.table("prediction").c

    def ordered(column):
        return select(column).order_by(table.k)

    with database.reading() as connection:
        keys = _column(connection, ordered(table.k))
        scores = _column(connection, ordered(table.score))
        ious = _column(connection, ordered(table.iou))
        names = [
            row[0] for part in bulk.blocks(connection, ordered(table.category)) for row in part
        ]
    assert keys.tolist() == list(range(COUNT))
    assert scores.tolist() == [k / 7 for k in range(COUNT)]
    assert np.array_equal(ious, [k / 9 if k % 2 else np.nan for k in range(COUNT)], equal_nan=True)
    assert names == [f"é{k}\t\\N\n" for k in range(COUNT)]


def _column(connection: Connection, statement: Select) -> np.ndarray:
    (found,) = bulk.select_columns(connection, statement).values()
    return found


INFINITE = [math.inf, -math.inf, 5e-324, -1.7976931348623157e308, -0.0, 0.1]
# PostgreSQL accepts no zero byte in a text, and neither engine a lone surrogate.
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9)


def _weights(count: int) -> dict:
    return {
        "round": 1, "frame_id": 1, "k": list(range(count)), "policy": "spsl",
        "lambda_u": None, "rho_det": None, "v": 0.5,
    }  # fmt: skip


def _stored(database: Database, *names: str) -> list[tuple]:
    table = bulk.table("weight").c
    with database.reading() as connection:
        return bulk.select(connection, select(*(table[n] for n in names)).order_by(table.k))


def test_numbers_of_every_kind_are_stored(database: Database) -> None:
    """Infinite, tiny, negative and missing ones, given as lists."""
    count = len(INFINITE)
    columns = _weights(count + 1) | {"lambda_u": [*INFINITE, None], "v": [*INFINITE, 1]}
    with database.writing() as connection:
        bulk.insert(connection, "weight", columns)
    assert _stored(database, "k", "lambda_u") == [*enumerate(INFINITE), (count, None)]
    table = bulk.table("weight").c
    with database.reading() as connection:
        query = select(table.lambda_u).order_by(table.k.desc())
        found = _column(connection, query)
        wide = (cast(table.k, BigInteger) * -2_000_000_000_000).label("wide")
        keys = _column(connection, select(wide).order_by(table.k))
    assert np.array_equal(found, [np.nan, *INFINITE[::-1]], equal_nan=True)
    assert keys.tolist() == [-2_000_000_000_000 * k for k in range(count + 1)]


def test_arrays_can_be_columns(database: Database) -> None:
    """NaN in a float array is null, integers of any width are integers."""
    columns = _weights(3) | {
        "k": np.arange(3, dtype=np.int16),
        "lambda_u": np.array([0.1, np.nan, 3]),
        "rho_det": np.full(3, np.nan),
        "v": np.float32([0.5, 0.25, 1]),
    }
    with database.writing() as connection:
        bulk.insert(connection, "weight", columns)
    assert _stored(database, "k", "lambda_u", "rho_det", "v") == [
        (0, 0.1, None, 0.5), (1, None, None, 0.25), (2, 3.0, None, 1.0)
    ]  # fmt: skip


def test_empty_columns(database: Database) -> None:
    """No rows are written, none are read."""
    table = bulk.table("weight").c
    with database.writing() as connection:
        bulk.insert(connection, "weight", _weights(0))
        assert _column(connection, select(table.v)).tolist() == []
        assert _column(connection, select(table.k)).dtype == np.int64


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    rows=st.lists(st.tuples(TEXTS, st.floats(allow_nan=False), st.none() | st.floats(0, 1))),
    block=st.sampled_from([1, 3, 50_000]),
)
def test_any_rows_are_stored_unchanged(database: Database, rows: list[tuple], block: int) -> None:
    """Texts of any length and script, any number and null, in blocks of any size."""
    stored = [(1, 1, k, name, x, *[x] * 7, iou) for k, (name, x, iou) in enumerate(rows)]
    with pytest.MonkeyPatch.context() as patch, database.writing() as connection:
        patch.setattr(bulk, "BLOCK_ROWS", block)
        table = bulk.table("prediction")
        connection.execute(table.delete())
        store(connection, "prediction", stored)
        assert bulk.select(connection, select(table).order_by(table.c.k)) == stored


def test_query_parameters_are_never_interpreted_as_sql(database: Database) -> None:
    """For any text and any number of parameters."""
    table = bulk.table("prediction").c
    names = ["'; DROP TABLE weight; --", "%s %(x)s", *(f"é{k}\t\\N\n" for k in (3, 5))]
    with database.reading() as connection:
        query = select(table.k).where(table.category.in_(names)).order_by(table.k)
        assert _column(connection, query).tolist() == [3, 5]
        assert _column(connection, query.where(table.k > 3)).tolist() == [5.0]
        assert _column(connection, query.where(table.category == names[0])).tolist() == []


def test_a_null_in_an_integer_column_is_an_error(database: Database) -> None:
    """It would shift all later values."""
    table = bulk.table("prediction").c
    with database.reading() as connection, pytest.raises((TypeError, ValueError)):
        _column(connection, select(cast(table.iou, Integer).label("iou")).order_by(table.k))


def test_an_error_in_the_middle_of_a_result_is_one_line(tmp_path: Path, database: Database) -> None:
    """The server reports it after some rows."""
    if database.engine.dialect.name == "sqlite":
        pytest.skip("SQLite answers null for what cannot be computed")
    table = bulk.table("prediction").c
    quotient = cast(literal(1.0), Float(53)) / (table.k - 20)
    query = select(quotient.label("quotient")).order_by(table.k)
    with pytest.raises(DatabaseError, match="division by zero") as raised, database.reading() as c:
        _column(c, query)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "wrong",
    [
        {"k": [1, 1]},  # duplicate
        {"k": [1, None]},
        {"k": [1, COUNT]},  # no such prediction
        {"k": [1, 2], "v": [0.5, None]},
        {"k": [1, 2], "v": [0.5, "heavy"]},
        {"k": [1, 2], "policy": ["spsl", None]},
    ],
)
def test_rows_that_the_table_rejects_give_one_line(database: Database, wrong: dict) -> None:
    """And none of the rows is stored."""
    if wrong.get("v") == [0.5, "heavy"] and database.engine.dialect.name == "sqlite":
        pytest.skip("SQLite's columns take values of any type")
    with pytest.raises(DatabaseError) as raised, database.writing() as connection:
        bulk.insert(connection, "weight", _weights(2) | wrong)
    assert "\n" not in str(raised.value)
    assert _stored(database, "k") == []


@pytest.mark.parametrize("k", [2**31, -(2**31) - 1, 2**63, 0.5, "one", "x" * 9])
def test_a_server_rejects_integers_that_do_not_fit(database: Database, k: object) -> None:
    """Nothing is truncated to the size of the column."""
    if database.engine.dialect.name == "sqlite":
        pytest.skip("SQLite's columns take values of any type")
    with (
        pytest.raises(DatabaseError, match=r"integer|smallint|bigint|numeric"),
        database.writing() as connection,
    ):
        bulk.insert(connection, "weight", _weights(2) | {"k": [1, k]})


def test_statistics_cover_the_rows_just_written(database: Database) -> None:
    """Before other connections can see them, and without waiting for another refresh."""
    with database.writing() as connection:
        bulk.insert(connection, "weight", _weights(COUNT))
        bulk.refresh_statistics(connection)
        if database.engine.dialect.name == "sqlite":
            query = "SELECT stat FROM sqlite_stat1 WHERE tbl = 'weight' AND idx = 'weight'"
            assert connection.execute(text(query)).scalar_one().split()[0] == str(COUNT)
            return
        query = "SELECT reltuples FROM pg_class WHERE relname = 'weight'"
        assert connection.execute(text(query)).scalar_one() == COUNT
        target = connection.execute(text("SHOW default_statistics_target")).scalar_one()
        assert target == "100"
        waited = threading.Thread(target=_refresh, args=(database,))
        waited.start()
        waited.join(20)
        assert not waited.is_alive()


def _refresh(database: Database) -> None:
    with database.writing() as connection:
        bulk.refresh_statistics(connection)
