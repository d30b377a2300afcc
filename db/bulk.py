"""Bulk reading and writing of tables, in columns or in rows.

An ORM object, or even an SQLAlchemy row, costs more than the stored row itself. With millions of
labels that is most of the running time, so the functions here pass plain values.

Writing, e.g. the losses of two labels of a frame:

    insert_rows(connection, "consistency", [{"round": 1, "frame_id": 7, "k": 0, "loss": 0.2, ...}])
    insert(connection, "consistency", {"round": 1, "frame_id": 7, "k": np.array([0, 1]),
                                       "loss": np.array([0.2, nan]), ...})

`insert_rows` takes a few rows as mappings. `insert` takes columns of any length: here `round` and
`frame_id` have one value for all rows, and NaN is stored as null. SQLite gets blocks of
BLOCK_ROWS rows, PostgreSQL gets one COPY.

Reading `SELECT k, loss FROM consistency`:

    select(connection, query)          [(0, 0.2), (1, None)]: all rows as tuples
    blocks(connection, query)          the same rows, one block at a time, for large results
    select_columns(connection, query)  {"k": array([0, 1]), "loss": array([0.2, nan])}

`grouped` turns rows into a mapping by their first value: {0: [(0.2,)], 1: [(None,)]}.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, repeat
from typing import Any

import numpy as np
from sqlalchemy import Connection, Select, Table, TextualSelect

from curate.files.batches import batched
from db.evidence import Declaration, evidence_table
from db.models import Base

Row = tuple[Any, ...]
BLOCK_ROWS = 50_000
FETCHED_ROWS = 1000  # per fetch from SQLite: a larger block does not fit into the processor's cache

# The tables behind the view weighted_labels and the counts of labels.
_ANALYZED_TABLES = (
    "weight", "label_count", "prediction", "consistency", "point_prior", "semantic_prior", "frame",
    "human_label", "human_match", "round", "task",
)  # fmt: skip
# PostgreSQL samples 300 rows per unit, so 9,000 rows of each table; its default is 100 units.
_STATISTICS_TARGET = 30


SCHEMA_TABLES = frozenset(Base.metadata.tables)
_SOURCE_TABLES: dict[str, Table] = {}


def table(name: str) -> Table:
    """Return the table with this name, from the schema or from a registered evidence source."""
    return Base.metadata.tables[name] if name in SCHEMA_TABLES else _SOURCE_TABLES[name]


def use_source(declaration: Declaration) -> None:
    """Register the table of an evidence source, so that `table` returns it."""
    if declaration.table not in SCHEMA_TABLES:
        _SOURCE_TABLES[declaration.table] = evidence_table(declaration)


def insert_rows(connection: Connection, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Insert a few rows, each a mapping from column to value; a missing column becomes null."""
    if rows:
        connection.execute(table(name).insert(), list(rows))


def insert(connection: Connection, name: str, values: Mapping[str, Any]) -> None:
    """Insert rows that are given as columns.

    Args:
        connection: connection to the database.
        name: name of the table.
        values: per column a list or (n,) array, or a single value that all n rows get. NaN in an
            array of floats is stored as null.
    """
    length = next(len(value) for value in values.values() if isinstance(value, list | np.ndarray))
    names = ", ".join(f'"{column}"' for column in values)
    rows = chain.from_iterable(
        zip(*(_part(value, start, length) for value in values.values()), strict=True)
        for start in range(0, length, BLOCK_ROWS)
    )
    if is_postgresql(connection):
        with connection.connection.cursor().copy(f'COPY "{name}" ({names}) FROM STDIN') as copy:
            for row in rows:
                copy.write_row(row)
        return
    statement = f'INSERT INTO "{name}" ({names}) VALUES ({", ".join("?" * len(values))})'  # noqa: S608
    for block in batched(rows, BLOCK_ROWS):
        connection.exec_driver_sql(statement, block)


def _part(value: Any, start: int, length: int) -> Iterable[Any]:
    """Return a block of a column as Python objects: None for NaN, a single value repeated."""
    if not isinstance(value, list | np.ndarray):
        return repeat(value, min(BLOCK_ROWS, length - start))
    # The last block takes all that remains, so that zip(strict=True) notices a longer column.
    end = start + BLOCK_ROWS if start + BLOCK_ROWS < length else len(value)
    part = value[start:end]
    if isinstance(part, list):
        return part
    values: list[Any] = part.tolist()
    if part.dtype.kind == "f":
        for i in np.flatnonzero(np.isnan(part)):
            values[i] = None
    return values


def is_postgresql(connection: Connection) -> bool:
    """Return whether the database is PostgreSQL."""
    return connection.dialect.name == "postgresql"


def select(connection: Connection, statement: Select[Any] | TextualSelect) -> Sequence[Row]:
    """Return all rows of a query as plain tuples."""
    result = connection.execute(statement)
    if result.cursor is not None and _needs_no_conversion(connection, statement):
        rows: Sequence[Row] = result.cursor.fetchall()
        result.close()
        return rows
    return [tuple(row) for row in result]


def grouped(rows: Iterable[Row], keys: Iterable[Any] = ()) -> dict[Any, list[Row]]:
    """Group rows by their first value, which is removed from them.

    Args:
        rows: rows of at least one value.
        keys: keys that get an empty list if they have no rows.
    """
    groups: dict[Any, list[Row]] = {key: [] for key in keys}
    for key, *row in rows:
        groups.setdefault(key, []).append(tuple(row))
    return groups


def _needs_no_conversion(connection: Connection, statement: Select[Any] | TextualSelect) -> bool:
    """Return whether the values from SQLite's driver can be used as they are.

    They can, except for times, which SQLAlchemy converts. Without conversion the rows are fetched
    from the driver directly: creating SQLAlchemy's row object takes as long as fetching the row.
    """
    dialect = connection.dialect
    return dialect.name == "sqlite" and all(
        column.type.dialect_impl(dialect).result_processor(dialect, None) is None
        for column in statement.selected_columns
    )


def blocks(connection: Connection, statement: Select[Any]) -> Iterator[Sequence[Row]]:
    """Yield the rows of a query in blocks."""
    if _needs_no_conversion(connection, statement):
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
        TypeError: if a column of integers contains a null.
    """
    kinds = {column.name: column.type.python_type for column in statement.selected_columns}
    parts = {name: [np.zeros(0, kind)] for name, kind in kinds.items()}
    for rows in blocks(connection, statement):
        for (name, kind), values in zip(kinds.items(), zip(*rows, strict=True), strict=True):
            parts[name].append(np.array(values, dtype=kind))
    return {name: np.concatenate(parts.pop(name)) for name in kinds}


def refresh_statistics(connection: Connection) -> None:
    """Update the query planner's statistics of the tables that queries for labels read.

    Without them SQLite reads all weights to find those of one frame. PostgreSQL joins the rows of
    this transaction one by one, until its own autovacuum runs about a minute later. A table that
    another process is analyzing at the moment is skipped, which avoids waiting for it.
    """
    if is_postgresql(connection):
        tables = ", ".join(_ANALYZED_TABLES)
        connection.exec_driver_sql(f"SET LOCAL default_statistics_target = {_STATISTICS_TARGET}")
        connection.exec_driver_sql(f"ANALYZE (SKIP_LOCKED) {tables}")
        connection.exec_driver_sql("SET LOCAL default_statistics_target = DEFAULT")
    else:
        connection.exec_driver_sql("PRAGMA analysis_limit = 400")
        connection.exec_driver_sql("ANALYZE")


def delete_frames(
    connection: Connection, name: str, round_number: int, frame_ids: Sequence[int]
) -> None:
    """Delete the rows of some frames of a round, and the rows of other tables that refer to them.

    Args:
        connection: connection to the database.
        name: name of the table.
        round_number: number of the round.
        frame_ids: keys of the frames.
    """
    rows = table(name)
    selected = (rows.c.round == round_number, rows.c.frame_id.in_(frame_ids))
    connection.execute(rows.delete().where(*selected))
