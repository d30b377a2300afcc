"""Columns from and to a PostgreSQL server, as bytes that NumPy reads and writes.

Reading: the server itself strings the values of a column together, each as its `float8send` or
`int8send` writes it, and answers one value. COPY would send a message per row, which takes a
client longer to collect than the server to find. Writing: the rows of COPY's binary format
(PostgreSQL, "COPY", Binary Format) as a matrix of bytes, without those that a null does not have.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
from sqlalchemy import (
    BigInteger,
    Connection,
    Float,
    Integer,
    LargeBinary,
    Select,
    Table,
    Text,
    cast,
    func,
    literal,
    select,
)
from sqlalchemy.types import TypeEngine

# The most that one value of an answer is made of, 128 MB: a server holds no value over 1 GB.
PART_ROWS = 16_000_000
BLOCK_ROWS = 50_000  # rows of a COPY that are bytes at a time
# Texts are a matrix as wide as the longest; where it is larger, rows are written one by one.
MOST_TEXT_BYTES = 64 << 20

# What the view weighted_labels and the counts are made of.
_ASKED_TABLES = (
    "weight", "label_count", "prediction", "consistency", "point_prior", "semantic_prior", "frame",
    "human_label", "human_match", "round", "task",
)  # fmt: skip
# 300 sampled rows for each of them, of a table 9,000; a server takes 100 by itself.
_STATISTICS_TARGET = 30

_HEADER = b"PGCOPY\n\xff\r\n\0" + bytes(8)
_TRAILER = b"\xff\xff"


def numbers(connection: Connection, statement: Select[Any]) -> np.ndarray:
    """(n,) float64 the only column of a query; NaN for null."""
    return _column(connection, statement, ">f8", _sent_number).astype(np.float64)


def integers(connection: Connection, statement: Select[Any]) -> np.ndarray:
    """(n,) int64 the only column of a query, without nulls.

    Raises:
        ValueError: there is a null.
    """
    return _column(connection, statement, ">i8", _sent_integer).astype(np.int64)


def _sent_number(value: Any) -> Any:
    return func.float8send(func.coalesce(cast(value, Float(53)), cast("NaN", Float(53))))


def _sent_integer(value: Any) -> Any:
    return func.int8send(cast(value, BigInteger))


def _column(
    connection: Connection, statement: Select[Any], kind: str, sent: Callable[[Any], Any]
) -> np.ndarray:
    """(n,) of a kind of eight bytes, the only column of a query in its order."""
    parts: list[bytes] = []
    rows = PART_ROWS
    while rows == PART_ROWS:
        part = statement.limit(PART_ROWS).offset(PART_ROWS * len(parts)).subquery()
        # An aggregate takes the rows of an ordered subquery in their order where, as here, nothing
        # else is done to them (PostgreSQL, "Aggregate Functions"); an order of its own sorts anew.
        joined = func.string_agg(sent(part.c[0]), literal(b"", LargeBinary), type_=LargeBinary)
        query = select(func.count(), joined).select_from(part)
        rows, found = connection.execute(query).one()
        parts.append(found or b"")
        if len(parts[-1]) != 8 * rows:
            raise ValueError(f"a null where a number was asked for: {statement}")
    return np.frombuffer(b"".join(parts) if len(parts) > 1 else parts[0], dtype=kind)


def insert(connection: Connection, table: Table, values: Mapping[str, Any]) -> None:
    """COPY of rows that are given as columns.

    Args:
        connection: to the server.
        table: where they go.
        values: a list, tuple or array per column, all of one length, NaN in an array of floats for
            null; what is none of them is the value of every row.
    """
    length = next(len(value) for value in values.values() if _varies(value))
    names = ", ".join(f'"{name}"' for name in values)
    target = f'COPY "{table.name}" ({names}) FROM STDIN'
    fields = _fields(table, values, length)
    cursor = connection.connection.cursor()
    if fields is None:
        each = [value if _varies(value) else repeat(value, length) for value in values.values()]
        with cursor.copy(target) as copy:
            for row in zip(*each, strict=True):
                copy.write_row(row)
        return
    with cursor.copy(f"{target} (FORMAT BINARY)") as copy:
        copy.write(_HEADER)
        for start in range(0, length, BLOCK_ROWS):
            copy.write(_rows(fields, slice(start, min(start + BLOCK_ROWS, length))))
        copy.write(_TRAILER)


def refresh_statistics(connection: Connection) -> None:
    """Samples the tables that questions about labels touch, with the rows of this transaction.

    Where another process has a table sampled at this moment, that will do: nobody waits.
    """
    tables = ", ".join(_ASKED_TABLES)
    connection.exec_driver_sql(f"SET LOCAL default_statistics_target = {_STATISTICS_TARGET}")
    connection.exec_driver_sql(f"ANALYZE (SKIP_LOCKED) {tables}")
    connection.exec_driver_sql("SET LOCAL default_statistics_target = DEFAULT")


@dataclass(frozen=True)
class _Field:
    """A column of n values as COPY wants it.

    Attributes:
        content: (n, w) uint8, of each value its bytes from the left.
        sizes: (n,) int32 how many they are; -1 for null.
    """

    content: np.ndarray
    sizes: np.ndarray

    def repeated(self, length: int) -> "_Field":
        """The only value, so many times."""
        content = np.broadcast_to(self.content, (length, self.content.shape[1]))
        return _Field(content, np.broadcast_to(self.sizes, length))


def _varies(value: Any) -> bool:
    return isinstance(value, list | tuple | np.ndarray)


def _fields(table: Table, values: Mapping[str, Any], length: int) -> list[_Field] | None:
    """The columns; None where one is of another type than the table's, or of no known one.

    Then rows are written one by one, and the server says what is wrong with them, if anything.
    """
    fields = []
    for name, value in values.items():
        make = _MAKERS.get(type(table.c[name].type))
        if make is None:
            return None
        try:
            field = make(value if _varies(value) else [value])
        except (TypeError, ValueError, OverflowError):
            return None
        fields.append(field if _varies(value) else field.repeated(length))
    return fields


def _rows(fields: Sequence[_Field], chosen: slice) -> bytes:
    """Some rows: of each the number of fields, then of each field its size and its bytes."""
    count = chosen.stop - chosen.start
    width = 2 + sum(4 + field.content.shape[1] for field in fields)
    rows = np.empty((count, width), dtype=np.uint8)
    kept = np.ones((count, width), dtype=np.bool_)
    rows[:, :2] = _bytes_of(np.array([len(fields)]), ">i2")
    start = 2
    for field in fields:
        content, sizes = field.content[chosen], field.sizes[chosen]
        end = start + 4 + content.shape[1]
        rows[:, start : start + 4] = _bytes_of(sizes, ">i4")
        rows[:, start + 4 : end] = content
        kept[:, start + 4 : end] = np.arange(content.shape[1]) < sizes[:, np.newaxis]
        start = end
    return (rows if kept.all() else rows[kept]).tobytes()


def _bytes_of(values: np.ndarray, kind: str) -> np.ndarray:
    """(n, w) uint8 the bytes of n numbers."""
    return np.array(values, dtype=kind, order="C").view(np.uint8).reshape(len(values), -1)


def _floats(values: Any) -> _Field:
    found, nulls = _numeric(values)
    return _Field(_bytes_of(found, ">f8"), _sizes(8, nulls))


def _integers(values: Any) -> _Field:
    found, nulls = _numeric(values)
    found = np.where(nulls, 0, found)
    limits = np.iinfo(np.int32)
    if not np.all((found >= limits.min) & (found <= limits.max) & (found == np.trunc(found))):
        raise ValueError("no integers of four bytes")
    return _Field(_bytes_of(found, ">i4"), _sizes(4, nulls))


def _numeric(values: Any) -> tuple[np.ndarray, np.ndarray]:
    """(n,) int64 or float64 the numbers, (n,) bool which of them are null."""
    found = np.asarray(values)
    nulls = np.zeros(len(found), dtype=np.bool_)
    if found.dtype == np.object_:
        nulls = np.equal(found, np.array(None)).astype(np.bool_)
        found = np.where(nulls, np.nan, found).astype(np.float64)
    elif found.dtype.kind == "f" and found is values:
        nulls = np.isnan(found)
    if found.dtype.kind not in "iuf" or found.ndim != 1:
        raise ValueError("no numbers")
    return found, nulls


def _texts(values: Any) -> _Field:
    nulls = np.array([value is None for value in values])
    encoded = [b"" if value is None else str.encode(value) for value in values]
    sizes = np.fromiter(map(len, encoded), np.int32, len(encoded))
    width = int(sizes.max())
    if width * len(encoded) > MOST_TEXT_BYTES:
        raise ValueError("texts too long")
    content = np.array(encoded, dtype=f"S{max(width, 1)}").view(np.uint8)
    return _Field(content.reshape(len(encoded), -1), np.where(nulls, -1, sizes))


def _sizes(size: int, nulls: np.ndarray) -> np.ndarray:
    return np.where(nulls, -1, size)


_MAKERS: dict[type[TypeEngine[Any]], Callable[[Any], _Field]] = {
    Integer: _integers,
    Float: _floats,
    Text: _texts,
}
