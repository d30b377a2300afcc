"""The one bulk reader and writer: named columns in, columns or tuples out."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from itertools import count as count_from
from typing import Any

import numpy as np
from sqlalchemy import Connection, Select, Table

from db import server_columns
from db.evidence import Declaration, evidence_table
from db.models import Base

Row = tuple[Any, ...]
BLOCK_ROWS = 50_000
FETCHED_ROWS = 1000  # from SQLite at a time: more do not stay in the processor's cache

_END = -1  # no key is negative
_BULK_CACHE_KIB = 64 * 1024
# Of one INSERT; every SQLite takes so many variables.
_MOST_ROWS, _MOST_VARIABLES = 50, 999


SCHEMA_TABLES = frozenset(Base.metadata.tables)
_OF_SOURCES: dict[str, Table] = {}


def table(name: str) -> Table:
    """Return the table of that name: of the schema, or of a source that is in use."""
    return Base.metadata.tables[name] if name in SCHEMA_TABLES else _OF_SOURCES[name]


def use_source(declaration: Declaration) -> None:
    """Make the table of an evidence source known by its name."""
    if declaration.table not in SCHEMA_TABLES:
        _OF_SOURCES[declaration.table] = evidence_table(declaration)


def insert_rows(connection: Connection, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Insert a few rows, each a mapping from column to value; what is left out is null."""
    if rows:
        connection.execute(table(name).insert(), list(rows))


def insert(connection: Connection, name: str, values: Mapping[str, Any]) -> None:
    """Insert rows that are given as columns: no tuple is made of them where it can be spared.

    Args:
        connection: to the database.
        name: of the table.
        values: a list or array per column, all of one length, NaN in an array of floats for null;
            what is neither is the value of every row.
    """
    if on_server(connection):
        server_columns.insert(connection, table(name), values)
        return
    # SQLite stores NaN as null by itself.
    values = {c: v.tolist() if isinstance(v, np.ndarray) else v for c, v in values.items()}
    fixed = {column: value for column, value in values.items() if not isinstance(value, list)}
    varying = {column: value for column, value in values.items() if column not in fixed}
    if not any(varying.values()):
        return
    length, width = len(next(iter(varying.values()))), len(varying)
    # The values of all columns, row by row.
    flat: list[Any] = [None] * (length * width)
    for place, column in enumerate(varying.values()):
        flat[place::width] = column
    names, head = (*fixed, *varying), tuple(fixed.values())
    for start, end, count in _statements(length, _rows_per_statement(width, len(head))):
        marks = [_numbered(len(head), width, row) for row in range(count)]
        step = count * width
        parts = (flat[i : i + step] for i in range(start * width, end * width, step))
        connection.exec_driver_sql(
            _insertion(name, names, marks), [(*head, *part) for part in parts]
        )


def update_columns(
    connection: Connection,
    name: str,
    within: Mapping[str, Any],
    keys: Sequence[str],
    values: Mapping[str, np.ndarray],
) -> bool:
    """Gives the rows of an SQLite table new values, in one walk along its key.

    It takes half as long as to delete each row and insert it again.

    Args:
        connection: to the database.
        name: of the table.
        within: what these rows have in common, the first column of the key first.
        keys: the columns that tell these rows apart, in the order of the table's key.
        values: an array per column, of the keys and of what is new; NaN for null.

    Returns:
        Whether it was done: there were rows of these keys and no others. If not, some may have new
        values and all are to be replaced.
    """
    first, *others = within
    # A condition within CASE leads to no index, which could have another order.
    common = " AND ".join(f'"{column}" = ?' for column in others)
    same = " AND ".join(f'"{column}" = next_{column}()' for column in keys)
    new = ", ".join(f'"{column}" = next_{column}()' for column in values if column not in keys)
    chosen = f'"{first}" = ? AND CASE WHEN {common} THEN {same} END'
    with _drawn(connection, values) as drawn:
        statement = f'UPDATE "{name}" SET {new} WHERE {chosen}'  # noqa: S608
        found = connection.exec_driver_sql(statement, tuple(within.values())).rowcount
        return found == len(values[keys[0]]) and all(next(drawn[key]) == _END for key in keys)


@contextmanager
def _drawn(
    connection: Connection, values: Mapping[str, np.ndarray]
) -> Iterator[Mapping[str, Iterator[float]]]:
    """Within it next_COLUMN() in a statement draws the next value of that column.

    After the last one come _END, _END - 1 and so on.
    """
    driver: Any = connection.connection.driver_connection
    drawn = {
        column: chain(_values(array), count_from(_END, -1)) for column, array in values.items()
    }
    for column, each in drawn.items():
        driver.create_function(f"next_{column}", 0, each.__next__)
    try:
        yield drawn
    finally:
        for column in drawn:
            driver.create_function(f"next_{column}", 0, None)


def _values(array: np.ndarray) -> Iterator[float]:
    """The values as Python's, some at a time."""
    parts = (array[i : i + BLOCK_ROWS].tolist() for i in range(0, len(array), BLOCK_ROWS))
    return chain.from_iterable(parts)


def on_server(connection: Connection) -> bool:
    """Whether a PostgreSQL server answers."""
    return connection.dialect.name == "postgresql"


def _insertion(name: str, names: Sequence[str], rows: Sequence[str]) -> str:
    """An INSERT of several rows of marks, which costs SQLite half as much as one of each."""
    quoted = ", ".join(f'"{column}"' for column in names)
    return f'INSERT INTO "{name}" ({quoted}) VALUES {", ".join(rows)}'  # noqa: S608


def _numbered(constants: int, width: int, row: int) -> str:
    """The marks of a row: the values that all rows share, then its own."""
    first = constants + row * width + 1
    places = (*range(1, constants + 1), *range(first, first + width))
    return f"({', '.join(f'?{place}' for place in places)})"


def _rows_per_statement(width: int, constants: int = 0) -> int:
    return min(_MOST_ROWS, (_MOST_VARIABLES - constants) // width)


def _statements(length: int, step: int) -> Iterator[tuple[int, int, int]]:
    """First row, end and rows per statement: of the full statements, and of the rest."""
    whole = length - length % step
    if whole:
        yield 0, whole, step
    if whole < length:
        yield whole, length, length - whole


def select(connection: Connection, statement: Select[Any]) -> Sequence[Row]:
    """All rows of a query as plain tuples."""
    result = connection.execute(statement)
    if result.cursor is not None and _as_they_are(connection, statement):
        rows: Sequence[Row] = result.cursor.fetchall()
        result.close()
        return rows
    return [tuple(row) for row in result]


def _as_they_are(connection: Connection, statement: Select[Any]) -> bool:
    """Whether SQLite's driver gives the values that are meant, as it does but for times.

    An object of SQLAlchemy per row takes as long as the row itself.
    """
    dialect = connection.dialect
    return dialect.name == "sqlite" and all(
        column.type.dialect_impl(dialect).result_processor(dialect, None) is None
        for column in statement.selected_columns
    )


def blocks(connection: Connection, statement: Select[Any]) -> Iterator[Sequence[Row]]:
    """The rows of a query, some at a time."""
    if _as_they_are(connection, statement):
        result = connection.execute(statement)
        cursor = result.cursor
        while cursor is not None and (rows := cursor.fetchmany(FETCHED_ROWS)):
            yield rows
        result.close()
    else:
        options = {"yield_per": BLOCK_ROWS}
        yield from connection.execute(statement, execution_options=options).partitions()


def numbers(connection: Connection, statement: Select[Any]) -> np.ndarray:
    """(n,) float64 the only column of a query; NaN for null."""
    if on_server(connection):
        return server_columns.numbers(connection, statement)
    found = [
        np.array([value for (value,) in rows], dtype=np.float64)
        for rows in blocks(connection, statement)
    ]
    return np.concatenate([np.zeros(0), *found])


def integers(connection: Connection, statement: Select[Any]) -> np.ndarray:
    """(n,) int64 the only column of a query, without nulls."""
    if on_server(connection):
        return server_columns.integers(connection, statement)
    found = [
        np.fromiter((value for (value,) in rows), np.int64, len(rows))
        for rows in blocks(connection, statement)
    ]
    return np.concatenate([np.zeros(0, dtype=np.int64), *found])


@contextmanager
def roomy(connection: Connection) -> Iterator[None]:
    """Within it SQLite has room for the pages in work, and sorts an index on a second core."""
    usual = connection.exec_driver_sql("PRAGMA cache_size").scalar_one()
    connection.exec_driver_sql(f"PRAGMA cache_size = -{_BULK_CACHE_KIB}")
    connection.exec_driver_sql("PRAGMA threads = 1")
    try:
        yield
    finally:
        connection.exec_driver_sql(f"PRAGMA cache_size = {usual}")
        connection.exec_driver_sql("PRAGMA threads = 0")


def refresh_statistics(connection: Connection) -> None:
    """Lets the database look at samples of the tables that questions about labels touch.

    Without them SQLite reads all weights where somebody asks for one frame, and a server joins row
    by row what this transaction has written, until it looks by itself a minute later.
    """
    if on_server(connection):
        server_columns.refresh_statistics(connection)
    else:
        connection.exec_driver_sql("PRAGMA analysis_limit = 400")
        connection.exec_driver_sql("ANALYZE")


def delete_frames(
    connection: Connection, name: str, round_number: int, frame_ids: Sequence[int]
) -> None:
    """Deletes the rows of some frames of a round, and what hangs on them."""
    of = table(name)
    connection.execute(of.delete().where(of.c.round == round_number, of.c.frame_id.in_(frame_ids)))
