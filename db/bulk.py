"""The one bulk reader and writer: named columns in, columns or tuples out."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, repeat
from typing import Any

import numpy as np
from sqlalchemy import Connection, Select, Table

from curate.files.batches import batched
from db.evidence import Declaration, evidence_table
from db.models import Base

Row = tuple[Any, ...]
BLOCK_ROWS = 50_000
FETCHED_ROWS = 1000  # from SQLite at a time: more do not stay in the processor's cache

# What the view weighted_labels and the counts are made of.
_ASKED_TABLES = (
    "weight", "label_count", "prediction", "consistency", "point_prior", "semantic_prior", "frame",
    "human_label", "human_match", "round", "task",
)  # fmt: skip
# 300 sampled rows for each of them, of a table 9,000; a server takes 100 by itself.
_STATISTICS_TARGET = 30


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
    """Insert rows that are given as columns.

    Args:
        connection: to the database.
        name: of the table.
        values: a list or array per column, all of one length, NaN in an array of floats for null;
            what is neither is the value of every row.
    """
    length = next(len(value) for value in values.values() if isinstance(value, list | np.ndarray))
    names = ", ".join(f'"{column}"' for column in values)
    rows = chain.from_iterable(
        zip(*(_part(value, start, length) for value in values.values()), strict=True)
        for start in range(0, length, BLOCK_ROWS)
    )
    if on_server(connection):
        with connection.connection.cursor().copy(f'COPY "{name}" ({names}) FROM STDIN') as copy:
            for row in rows:
                copy.write_row(row)
        return
    statement = f'INSERT INTO "{name}" ({names}) VALUES ({", ".join("?" * len(values))})'  # noqa: S608
    for block in batched(rows, BLOCK_ROWS):
        connection.exec_driver_sql(statement, block)


def _part(value: Any, start: int, length: int) -> Iterable[Any]:
    """A block of a column as Python objects, None for NaN; of a single value its repetition."""
    if not isinstance(value, list | np.ndarray):
        return repeat(value, min(BLOCK_ROWS, length - start))
    # A column that is too long shows in the last block.
    end = start + BLOCK_ROWS if start + BLOCK_ROWS < length else len(value)
    part = value[start:end]
    if isinstance(part, list):
        return part
    found: list[Any] = part.tolist()
    if part.dtype.kind == "f":
        for i in np.flatnonzero(np.isnan(part)):
            found[i] = None
    return found


def on_server(connection: Connection) -> bool:
    """Return whether a PostgreSQL server answers."""
    return connection.dialect.name == "postgresql"


def select(connection: Connection, statement: Select[Any]) -> Sequence[Row]:
    """Return all rows of a query as plain tuples."""
    result = connection.execute(statement)
    if result.cursor is not None and _unchanged(connection, statement):
        rows: Sequence[Row] = result.cursor.fetchall()
        result.close()
        return rows
    return [tuple(row) for row in result]


def grouped(rows: Iterable[Row], keys: Iterable[Any] = ()) -> dict[Any, list[Row]]:
    """Return the rows by their first value, without it; an empty list for a key without rows."""
    found: dict[Any, list[Row]] = {key: [] for key in keys}
    for key, *row in rows:
        found.setdefault(key, []).append(tuple(row))
    return found


def _unchanged(connection: Connection, statement: Select[Any]) -> bool:
    """Return whether SQLite's driver gives the values that are meant, as it does but for times.

    An object of SQLAlchemy per row takes as long as the row itself.
    """
    dialect = connection.dialect
    return dialect.name == "sqlite" and all(
        column.type.dialect_impl(dialect).result_processor(dialect, None) is None
        for column in statement.selected_columns
    )


def blocks(connection: Connection, statement: Select[Any]) -> Iterator[Sequence[Row]]:
    """Yield the rows of a query, some at a time."""
    if _unchanged(connection, statement):
        result = connection.execute(statement)
        cursor = result.cursor
        while cursor is not None and (rows := cursor.fetchmany(FETCHED_ROWS)):
            yield rows
        result.close()
    else:
        options = {"yield_per": BLOCK_ROWS}
        with connection.execute(statement, execution_options=options) as result:
            yield from result.partitions()


def select_columns(connection: Connection, statement: Select[Any]) -> dict[str, np.ndarray]:
    """Return the columns of a query by name: (n,) int64, float64 with NaN for null, or str.

    Raises:
        TypeError: if a null among integers.
    """
    kinds = {column.name: column.type.python_type for column in statement.selected_columns}
    parts = {name: [np.zeros(0, kind)] for name, kind in kinds.items()}
    for rows in blocks(connection, statement):
        for (name, kind), values in zip(kinds.items(), zip(*rows, strict=True), strict=True):
            parts[name].append(np.array(values, dtype=kind))
    return {name: np.concatenate(parts.pop(name)) for name in kinds}


def refresh_statistics(connection: Connection) -> None:
    """Let the database look at samples of the tables that questions about labels touch.

    Without them SQLite reads all weights where somebody asks for one frame, and a server joins row
    by row what this transaction has written, until it looks by itself a minute later. Where another
    process has a table of a server sampled at this moment, that will do: nobody waits.
    """
    if on_server(connection):
        tables = ", ".join(_ASKED_TABLES)
        connection.exec_driver_sql(f"SET LOCAL default_statistics_target = {_STATISTICS_TARGET}")
        connection.exec_driver_sql(f"ANALYZE (SKIP_LOCKED) {tables}")
        connection.exec_driver_sql("SET LOCAL default_statistics_target = DEFAULT")
    else:
        connection.exec_driver_sql("PRAGMA analysis_limit = 400")
        connection.exec_driver_sql("ANALYZE")


def delete_frames(
    connection: Connection, name: str, round_number: int, frame_ids: Sequence[int]
) -> None:
    """Delete the rows of some frames of a round, and what hangs on them."""
    of = table(name)
    connection.execute(of.delete().where(of.c.round == round_number, of.c.frame_id.in_(frame_ids)))
