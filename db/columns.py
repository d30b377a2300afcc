"""Whole columns of committed rows as NumPy arrays, the fastest way that a database offers."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from sqlalchemy import Connection, Dialect, Select

from db import bulk, sqlite_columns
from db.session import BUSY_TIMEOUT_MS, Database


class Columns(Protocol):
    """Answers queries of one column."""

    def numbers(self, statement: Select[Any]) -> np.ndarray:
        """(n,) float64; NaN for null."""

    def integers(self, statement: Select[Any]) -> np.ndarray:
        """(n,) int64, without nulls."""


@contextmanager
def reading_columns(
    database: Database, connection: Connection, *, many: bool = False
) -> Iterator[Columns]:
    """Answers queries of one column.

    Args:
        database: see `Database`.
        connection: to it, from `Database.reading`.
        many: whether millions of rows are asked for, so that a second of preparation pays.
    """
    dialect = connection.dialect
    if not many or dialect.name != "sqlite" or not sqlite_columns.available():
        yield _Driver(connection)
        return
    path = Path(str(database.url.database))
    with closing(sqlite_columns.SqliteColumns(path, BUSY_TIMEOUT_MS)) as asked:
        yield _Library(asked, dialect)


class _Driver:
    """`Columns` through the driver of a connection."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def numbers(self, statement: Select[Any]) -> np.ndarray:
        return bulk.numbers(self._connection, statement)

    def integers(self, statement: Select[Any]) -> np.ndarray:
        return bulk.integers(self._connection, statement)


class _Library:
    """`Columns` from SQLite's own library."""

    def __init__(self, asked: sqlite_columns.SqliteColumns, dialect: Dialect) -> None:
        self._asked = asked
        self._dialect = dialect

    def numbers(self, statement: Select[Any]) -> np.ndarray:
        return self._asked.numbers(self._sql(statement))

    def integers(self, statement: Select[Any]) -> np.ndarray:
        return self._asked.integers(self._sql(statement))

    def _sql(self, statement: Select[Any]) -> str:
        written = statement.compile(dialect=self._dialect, compile_kwargs={"literal_binds": True})
        return str(written)
