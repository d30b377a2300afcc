"""The bulk paths: every row goes in and comes out, whatever the size of a block."""

import math
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import BigInteger, Float, Integer, cast, literal, select, text
from support.one_frame import add_one_frame
from support.stored_tuples import COLUMNS, store

from curate.errors import DatabaseError
from db import bulk, server_columns, weight_index
from db.session import Database

ENGINES = ("sqlite", "postgresql")
COUNT = 23
KEYS, SPSL = ("frame_id", "k"), {"round": 1, "policy": "spsl"}


@pytest.fixture
def database(database: Database) -> Database:
    """A database with a few predictions."""
    with database.writing() as connection:
        add_one_frame(connection)
        rows = [
            (1, 1, k, f"é{k}\t\\N\n", k / 7, *[k / 3] * 7, k / 9 if k % 2 else None)
            for k in range(COUNT)
        ]
        store(connection, "prediction", rows)
    return database


@pytest.mark.parametrize("count", [0, 1, 4, 49, 50, 51, 100, 149])
def test_rows_and_columns_are_stored_alike(database: Database, count: int) -> None:
    """To the last bit, however many rows a statement takes; null stays null."""
    keys = range(1000, 1000 + count)
    rows = [(1, 1, k, "Car", k / 7777, *[k / 3] * 7, None) for k in keys]
    weights = [(1, 1, k, "spsl", k / 3 if k % 2 else None, k / 7777, k / 9999) for k in keys]
    with database.writing() as connection:
        store(connection, "prediction", rows)
        columns = [[row[i] for row in weights] for i in range(7)]
        values = dict(zip(COLUMNS["weight"], columns, strict=True))
        bulk.insert(connection, "weight", values | {"round": 1, "policy": "spsl"})
        table = bulk.table("prediction")
        found = bulk.select(connection, select(table).where(table.c.k >= 1000).order_by(table.c.k))
        assert found == rows
        table = bulk.table("weight")
        assert bulk.select(connection, select(table).order_by(table.c.k)) == weights


@pytest.mark.parametrize("block", [1, 5, COUNT, 50_000])
def test_columns_come_out_whole_and_in_order(
    database: Database, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    """To the last bit, the first and the last row among them; null is NaN."""
    monkeypatch.setattr(bulk, "FETCHED_ROWS", block)
    monkeypatch.setattr(bulk, "BLOCK_ROWS", block)
    table = bulk.table("prediction").c

    def ordered(column):
        return select(column).order_by(table.k)

    with database.reading() as connection:
        keys = bulk.integers(connection, ordered(table.k))
        scores = bulk.numbers(connection, ordered(table.score))
        ious = bulk.numbers(connection, ordered(table.iou))
        names = [
            row[0] for part in bulk.blocks(connection, ordered(table.category)) for row in part
        ]
    assert keys.tolist() == list(range(COUNT))
    assert scores.tolist() == [k / 7 for k in range(COUNT)]
    assert np.array_equal(ious, [k / 9 if k % 2 else np.nan for k in range(COUNT)], equal_nan=True)
    assert names == [f"é{k}\t\\N\n" for k in range(COUNT)]


INFINITE = [math.inf, -math.inf, 5e-324, -1.7976931348623157e308, -0.0, 0.1]
# PostgreSQL knows no zero byte in a text, and neither engine a lone surrogate.
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


def test_numbers_of_every_kind_go_in_and_come_out(database: Database) -> None:
    """Infinite, tiny, negative and missing ones, given as lists."""
    count = len(INFINITE)
    columns = _weights(count + 1) | {"lambda_u": [*INFINITE, None], "v": [*INFINITE, 1]}
    with database.writing() as connection:
        bulk.insert(connection, "weight", columns)
    assert _stored(database, "k", "lambda_u") == [*enumerate(INFINITE), (count, None)]
    table = bulk.table("weight").c
    with database.reading() as connection:
        query = select(table.lambda_u).order_by(table.k.desc())
        found = bulk.numbers(connection, query)
        wide = cast(table.k, BigInteger) * -2_000_000_000_000
        keys = bulk.integers(connection, select(wide).order_by(table.k))
    assert np.array_equal(found, [np.nan, *INFINITE[::-1]], equal_nan=True)
    assert keys.tolist() == [-2_000_000_000_000 * k for k in range(count + 1)]


def test_arrays_are_columns_too(database: Database) -> None:
    """NaN in one of floats is null, whole numbers of any width are integers."""
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


def test_columns_of_nothing(database: Database) -> None:
    """No rows go in, none come out."""
    table = bulk.table("weight").c
    with database.writing() as connection:
        bulk.insert(connection, "weight", _weights(0))
        assert bulk.numbers(connection, select(table.v)).tolist() == []
        assert bulk.integers(connection, select(table.k)).dtype == np.int64


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    rows=st.lists(st.tuples(TEXTS, st.floats(allow_nan=False), st.none() | st.floats(0, 1))),
    block=st.sampled_from([1, 3, 50_000]),
)
def test_any_rows_are_stored_as_they_are(database: Database, rows: list[tuple], block: int) -> None:
    """Texts of any length and script, any number and null, in blocks of any size."""
    stored = [(1, 1, k, name, x, *[x] * 7, iou) for k, (name, x, iou) in enumerate(rows)]
    with pytest.MonkeyPatch.context() as patch, database.writing() as connection:
        patch.setattr(server_columns, "BLOCK_ROWS", block)
        table = bulk.table("prediction")
        connection.execute(table.delete())
        store(connection, "prediction", stored)
        assert bulk.select(connection, select(table).order_by(table.c.k)) == stored


@pytest.mark.parametrize("part", [1, 5, COUNT - 1, COUNT, COUNT + 1])
def test_a_column_of_many_parts(
    database: Database, monkeypatch: pytest.MonkeyPatch, part: int
) -> None:
    """A server answers no value of any length; the parts are one column, each row once."""
    monkeypatch.setattr(server_columns, "PART_ROWS", part)
    table = bulk.table("prediction").c
    with database.reading() as connection:
        keys = bulk.integers(connection, select(table.k).order_by(table.k.desc()))
    assert keys.tolist() == list(range(COUNT))[::-1]


def test_parameters_of_a_query_stay_values(database: Database) -> None:
    """Whatever a text holds, and however many there are."""
    table = bulk.table("prediction").c
    names = ["'; DROP TABLE weight; --", "%s %(x)s", *(f"é{k}\t\\N\n" for k in (3, 5))]
    with database.reading() as connection:
        query = select(table.k).where(table.category.in_(names)).order_by(table.k)
        assert bulk.integers(connection, query).tolist() == [3, 5]
        assert bulk.numbers(connection, query.where(table.k > 3)).tolist() == [5.0]
        assert bulk.numbers(connection, query.where(table.category == names[0])).tolist() == []


def test_a_null_where_integers_are_asked_for_is_no_number(database: Database) -> None:
    """It would shift all that come after it."""
    table = bulk.table("prediction").c
    with database.reading() as connection, pytest.raises((TypeError, ValueError)):
        bulk.integers(connection, select(cast(table.iou, Integer)).order_by(table.k))


def test_an_error_in_mid_answer_is_one_line(tmp_path: Path, database: Database) -> None:
    """The server names it, after some rows already."""
    if database.engine.dialect.name == "sqlite":
        pytest.skip("SQLite answers null for what cannot be computed")
    table = bulk.table("prediction").c
    query = select(cast(literal(1.0), Float(53)) / (table.k - 20)).order_by(table.k)
    with pytest.raises(DatabaseError, match="division by zero") as raised, database.reading() as c:
        bulk.numbers(c, query)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "wrong",
    [
        {"k": [1, 1]},  # doubled
        {"k": [1, None]},
        {"k": [1, COUNT]},  # no such prediction
        {"k": [1, 2], "v": [0.5, None]},
        {"k": [1, 2], "v": [0.5, "heavy"]},
        {"k": [1, 2], "policy": ["spsl", None]},
    ],
)
def test_rows_that_the_table_refuses_are_one_line(database: Database, wrong: dict) -> None:
    """And none of the rows is stored."""
    if wrong.get("v") == [0.5, "heavy"] and database.engine.dialect.name == "sqlite":
        pytest.skip("SQLite's columns take values of any type")
    with pytest.raises(DatabaseError) as raised, database.writing() as connection:
        bulk.insert(connection, "weight", _weights(2) | wrong)
    assert "\n" not in str(raised.value)
    assert _stored(database, "k") == []


@pytest.mark.parametrize("k", [2**31, -(2**31) - 1, 2**63, 0.5, "one", "x" * 9])
def test_a_server_says_what_is_no_integer_of_its_own(database: Database, k: object) -> None:
    """Nothing is cut to the bytes that it would have."""
    if database.engine.dialect.name == "sqlite":
        pytest.skip("SQLite's columns take values of any type")
    with (
        pytest.raises(DatabaseError, match=r"integer|smallint|bigint|numeric"),
        database.writing() as connection,
    ):
        bulk.insert(connection, "weight", _weights(2) | {"k": [1, k]})


def test_texts_too_long_for_a_matrix_go_row_by_row(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rows are the same."""
    monkeypatch.setattr(server_columns, "MOST_TEXT_BYTES", 10)
    rows = [(1, 1, k, name, 0.5, *[1.0] * 7, None) for k, name in ((50, "a"), (51, "b" * 99))]
    table = bulk.table("prediction")
    with database.writing() as connection:
        store(connection, "prediction", rows)
        found = select(table).where(table.c.k >= 50).order_by(table.c.k)
        assert bulk.select(connection, found) == rows


def test_statistics_are_those_of_the_rows_just_written(database: Database) -> None:
    """Before anybody else can see them, and without waiting for one who samples the table too."""
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


@pytest.fixture
def labels(tmp_path: Path) -> Database:
    """Some predictions in SQLite."""
    database = Database(f"sqlite:///{tmp_path / 'curate.db'}")
    with database.writing() as connection:
        add_one_frame(connection)
        rows = [(1, 1, k, "Car", 0.5, *[1.0] * 7, None) for k in range(COUNT)]
        store(connection, "prediction", rows)
    return database


@pytest.mark.parametrize("count", [COUNT - 1, COUNT, COUNT + 1])
def test_rows_get_new_values_along_their_key(labels: Database, count: int) -> None:
    """Each its own, null among them, whatever indices lead elsewhere; or it says that they do not.

    A policy that stands beside keeps its weights.
    """
    falling = np.arange(count, 0, -1) / 7
    values = {"frame_id": np.ones(count, np.int64), "k": np.arange(count)}
    new = {"lambda_u": np.where(falling > 2, np.nan, falling), "rho_det": falling**2}
    order = np.random.default_rng(0).permutation(COUNT).tolist()
    weight_index.prepare(labels, "spsl")
    with labels.writing() as connection:
        for policy in ("aside", "spsl"):
            shuffled = {"k": order, "v": [k / COUNT for k in order], "policy": policy}
            bulk.insert(connection, "weight", _weights(COUNT) | shuffled)
    before = _of_policy(labels, "aside")
    with labels.writing() as connection:
        new["v"] = falling / COUNT
        done = bulk.update_columns(connection, "weight", SPSL, KEYS, values | new)
    assert done == (count == COUNT)
    assert _of_policy(labels, "aside") == before
    if done:
        expected = zip(*(each.tolist() for each in new.values()), strict=True)
        found = _of_policy(labels, "spsl")
        assert [row[:1] + row[2:] for row in found if row[1] is None] == [
            (k, rho, v) for k, (age, rho, v) in enumerate(expected) if math.isnan(age)
        ]
        names = ("lambda_u", "rho_det", "v")
        stored = np.array([row[1:] for row in found], dtype=np.float64)
        assert stored.tobytes() == np.stack([new[name] for name in names], axis=1).tobytes()


def _of_policy(database: Database, policy: str) -> list[tuple]:
    table = bulk.table("weight").c
    query = select(table.k, table.lambda_u, table.rho_det, table.v).where(table.policy == policy)
    with database.reading() as connection:
        return bulk.select(connection, query.order_by(table.k))


@pytest.mark.parametrize("k", [
    [0, 1, 2, 4], [0, 1, 2, 3, 4], [0, 1, 2], [1, 2, 3], [0, 2, 3], [1, 0, 2, 3], [0, 1, 3, 2], [],
])  # fmt: skip
@pytest.mark.parametrize("frame_id", [1, 2])
def test_only_the_very_same_rows_get_new_values(
    labels: Database, k: list[int], frame_id: int
) -> None:
    """More, fewer, others, another order or another frame are told."""
    with labels.writing() as connection:
        bulk.insert(connection, "weight", _weights(4))
    values = {"frame_id": np.full(len(k), frame_id), "k": np.array(k), "v": np.ones(len(k))}
    with labels.writing() as connection:
        assert not bulk.update_columns(connection, "weight", SPSL, KEYS, values)


def test_new_values_that_the_table_refuses_are_one_line(labels: Database) -> None:
    """And the rows are as they were; the next values are drawn from the start."""
    keys = {"frame_id": np.ones(COUNT, np.int64), "k": np.arange(COUNT)}
    with labels.writing() as connection:
        bulk.insert(connection, "weight", _weights(COUNT))
    before = _of_policy(labels, "spsl")
    missing = {"v": np.where(np.arange(COUNT) == 9, np.nan, 0.25)}
    with pytest.raises(DatabaseError, match="NOT NULL") as raised, labels.writing() as connection:
        bulk.update_columns(connection, "weight", SPSL, KEYS, keys | missing)
    assert "\n" not in str(raised.value)
    assert _of_policy(labels, "spsl") == before
    with labels.writing() as connection:
        values = keys | {"v": np.full(COUNT, 0.25)}
        assert bulk.update_columns(connection, "weight", SPSL, KEYS, values)
    assert {row[3] for row in _of_policy(labels, "spsl")} == {0.25}
