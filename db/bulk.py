"""The one bulk reader and writer: tuples in, tuples out, no objects in between."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from sqlalchemy import Connection, Select, Table, func
from sqlalchemy import select as query_of
from sqlalchemy.schema import CreateIndex, DropIndex

from db.models import Base

Row = tuple[Any, ...]
BLOCK_ROWS = 50_000

# Building an index anew costs a sixth of a row's way in and out of it, measured at 10 million rows.
_REBUILT_FROM = 100_000
_REBUILT_SHARE = 1 / 5


def table(name: str) -> Table:
    """The table of that name."""
    return Base.metadata.tables[name]


def columns(name: str) -> tuple[str, ...]:
    """The columns of a table, in the order in which `insert` expects their values.

    A surrogate key is not among them: the database draws it.
    """
    return tuple(column.name for column in table(name).columns if column.name != "id")


def insert(connection: Connection, name: str, rows: Iterable[Row]) -> None:
    """Inserts rows; every value of the table in its column order, see `columns`."""
    rows = list(rows)
    if not rows:
        return
    names = columns(name)
    quoted = ", ".join(f'"{column}"' for column in names)
    if connection.dialect.name == "postgresql":
        cursor = connection.connection.cursor()
        with cursor.copy(f'COPY "{name}" ({quoted}) FROM STDIN') as copy:
            for row in rows:
                copy.write_row(row)
        return
    marks = ", ".join("?" * len(names))
    connection.exec_driver_sql(f'INSERT INTO "{name}" ({quoted}) VALUES ({marks})', rows)  # noqa: S608


def select(connection: Connection, statement: Select[Any]) -> Sequence[Row]:
    """All rows of a query as plain tuples."""
    cursor = connection.execute(statement)
    return [tuple(row) for row in cursor]


def stream(connection: Connection, statement: Select[Any]) -> Iterator[Sequence[Any]]:
    """The values of a query's only column in blocks, as many as a block holds at a time."""
    result = connection.execution_options(yield_per=BLOCK_ROWS).execute(statement)
    yield from result.scalars().partitions()


def numbers(connection: Connection, statement: Select[Any]) -> np.ndarray:
    """(n,) float64 the only column of a query; NaN for null."""
    blocks = stream(connection, statement)
    found = [np.array(values, dtype=np.float64) for values in blocks]
    return np.concatenate([np.zeros(0), *found])


def integers(connection: Connection, statement: Select[Any]) -> np.ndarray:
    """(n,) int64 the only column of a query, without nulls."""
    found = [np.array(values, dtype=np.int64) for values in stream(connection, statement)]
    return np.concatenate([np.zeros(0, dtype=np.int64), *found])


@contextmanager
def replacing(connection: Connection, name: str, count: int) -> Iterator[None]:
    """Within it so many rows of a table come, or leave and come again.

    Where they are most of the table, SQLite's indices are made anew afterwards: row by row, each
    entry of an index by value is a seek of its own. A server's tables stay open to others.
    """
    worthwhile = connection.dialect.name == "sqlite" and count >= _REBUILT_FROM
    if worthwhile:
        stored = connection.execute(query_of(func.count()).select_from(table(name))).scalar_one()
        worthwhile = count >= stored * _REBUILT_SHARE
    indices = sorted(table(name).indexes, key=lambda each: str(each.name)) if worthwhile else []
    for index in indices:
        connection.execute(DropIndex(index))
    yield
    for index in indices:
        connection.execute(CreateIndex(index))


def refresh_statistics(connection: Connection) -> None:
    """Lets SQLite look at samples of its tables, some milliseconds; a server does so by itself.

    Without them it reads all weights where somebody asks for one frame.
    """
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql("PRAGMA analysis_limit = 400")
        connection.exec_driver_sql("ANALYZE")


def delete_frames(
    connection: Connection, name: str, round_number: int, frame_ids: Sequence[int]
) -> None:
    """Deletes the rows of some frames of a round, and what hangs on them."""
    of = table(name)
    connection.execute(of.delete().where(of.c.round == round_number, of.c.frame_id.in_(frame_ids)))
