"""Columns from SQLite's own library: those of Python's module, to the last bit."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import func, select, text
from support.stored_tuples import store

from curate.errors import DatabaseError
from db import bulk, columns, sqlite_columns
from db.session import Database
from db.sqlite_columns import SqliteColumns

if not sqlite_columns.available():
    pytest.skip("this Python hides SQLite's functions", allow_module_level=True)

LARGEST = 2**63 - 1


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file for a table of any values."""
    return tmp_path_factory.mktemp("columns") / "a.db"


def _stored(path: Path, kind: str, values: list) -> None:
    with closing(sqlite3.connect(path)) as raw, raw:
        raw.execute("DROP TABLE IF EXISTS t")
        raw.execute(f"CREATE TABLE t (id INTEGER PRIMARY KEY, value {kind})")
        raw.executemany("INSERT INTO t (value) VALUES (?)", [(value,) for value in values])


@given(values=st.lists(st.floats(allow_nan=False) | st.none(), max_size=40))
def test_numbers_are_those_of_the_driver(path: Path, values: list[float | None]) -> None:
    """Infinity, the smallest numbers and null among them."""
    _stored(path, "FLOAT", values)
    with closing(SqliteColumns(path, 1000)) as asked:
        found = asked.numbers("SELECT value FROM t ORDER BY id")
    expected = np.array(values, dtype=np.float64)
    # SQLite keeps an integral number as an integer, which has no sign of zero.
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.float64


@given(values=st.lists(st.integers(-LARGEST - 1, LARGEST), max_size=40))
def test_integers_are_those_of_the_driver(path: Path, values: list[int]) -> None:
    """All that 64 bits hold."""
    _stored(path, "INTEGER", values)
    with closing(SqliteColumns(path, 1000)) as asked:
        found = asked.integers("SELECT value FROM t ORDER BY id")
    assert found.tolist() == values


@pytest.mark.parametrize("block", [1, 2, 6, 7, 8])
def test_blocks_do_not_show(path: Path, monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    """Whether the rows fill the last one or not."""
    _stored(path, "INTEGER", list(range(7)))
    monkeypatch.setattr(sqlite_columns, "BLOCK_ROWS", block)
    with closing(SqliteColumns(path, 1000)) as asked:
        assert asked.integers("SELECT value FROM t ORDER BY id").tolist() == list(range(7))


def test_all_columns_are_of_one_moment(path: Path) -> None:
    """What another connection writes between two of them is not seen."""
    _stored(path, "INTEGER", [1, 2])
    with closing(sqlite3.connect(path)) as raw:
        raw.execute("PRAGMA journal_mode = WAL")
        with closing(SqliteColumns(path, 1000)) as asked:
            before = asked.integers("SELECT value FROM t")
            with raw:
                raw.execute("DELETE FROM t")
            assert asked.integers("SELECT value FROM t").tolist() == before.tolist() == [1, 2]
        with closing(SqliteColumns(path, 1000)) as asked:
            assert asked.integers("SELECT value FROM t").tolist() == []


def test_a_query_that_fails_says_why(tmp_path: Path) -> None:
    """At its start or in its middle, as an error of Python's module."""
    with pytest.raises(sqlite3.OperationalError, match="unable to open"):
        SqliteColumns(tmp_path / "absent.db", 1000)
    _stored(tmp_path / "a.db", "INTEGER", [1, -LARGEST - 1])
    with closing(SqliteColumns(tmp_path / "a.db", 1000)) as asked:
        with pytest.raises(sqlite3.OperationalError, match="no such table: absent"):
            asked.integers("SELECT a FROM absent")
        with pytest.raises(sqlite3.OperationalError, match="integer overflow"):
            asked.integers("SELECT abs(value) FROM t ORDER BY id")


@pytest.mark.parametrize("reachable", [True, False])
def test_a_database_answers_by_whatever_is_there(
    database: Database, monkeypatch: pytest.MonkeyPatch, reachable: bool
) -> None:
    """The library, or the driver where Python hides it; text in a query is quoted."""
    monkeypatch.setattr(sqlite_columns, "available", lambda: reachable)
    with database.writing() as connection:
        rows = [("it's", f"{i}", "val", "p", "i", "c", None) for i in range(3)]
        store(connection, "frame", rows)
    frame = bulk.table("frame").c
    query = select(frame.id).where(frame.dataset == "it's").order_by(frame.id.desc())
    with (
        database.reading() as connection,
        columns.reading_columns(database, connection, many=True) as asked,
    ):
        assert asked.integers(query).tolist() == [3, 2, 1]
        assert asked.numbers(query.with_only_columns(frame.id * 0.5)).tolist() == [1.5, 1.0, 0.5]


def test_damage_is_told_in_our_own_words(database: Database) -> None:
    """As everywhere: one line that names the file."""
    with (
        pytest.raises(DatabaseError, match=r"curate.db: no such function: absent"),
        database.reading() as connection,
        columns.reading_columns(database, connection, many=True) as asked,
    ):
        asked.numbers(select(func.absent(text("1"))))
