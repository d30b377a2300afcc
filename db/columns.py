"""Whole columns of committed rows as NumPy arrays, the fastest way that a database offers."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import Connection, Select

from db import bulk, sqlite_columns
from db.session import BUSY_TIMEOUT_MS, Database


@dataclass(frozen=True)
class Columns:
    """Answers queries of one column.

    Attributes:
        numbers: (n,) float64; NaN for null.
        integers: (n,) int64, without nulls.
    """

    numbers: Callable[[Select[Any]], np.ndarray]
    integers: Callable[[Select[Any]], np.ndarray]


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
        yield Columns(partial(bulk.numbers, connection), partial(bulk.integers, connection))
        return

    def written(statement: Select[Any]) -> str:
        return str(statement.compile(dialect=dialect, compile_kwargs={"literal_binds": True}))

    path = Path(str(database.url.database))
    with closing(sqlite_columns.SqliteColumns(path, BUSY_TIMEOUT_MS)) as asked:
        yield Columns(
            lambda statement: asked.numbers(written(statement)),
            lambda statement: asked.integers(written(statement)),
        )
