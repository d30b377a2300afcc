"""The one bulk reader and writer: tuples in, tuples out, no objects in between."""

from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import Connection, Select, Table

from db.models import Base

Row = tuple[Any, ...]


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


def delete_frames(
    connection: Connection, name: str, round_number: int, frame_ids: Sequence[int]
) -> None:
    """Deletes the rows of some frames of a round, and what hangs on them."""
    of = table(name)
    connection.execute(of.delete().where(of.c.round == round_number, of.c.frame_id.in_(frame_ids)))
