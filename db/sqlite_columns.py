"""Columns of an SQLite file as NumPy arrays, without a Python object for each value.

Python's sqlite3 makes a tuple and a number of every row, which takes several times as long as
SQLite needs to find it. Here a compiled loop asks SQLite itself: the very library that Python's
module is linked to, since two of them in one process would undo each other's locks. Where that
library does not show its functions (some builds of Python hide them), `available` says so.
"""

import _sqlite3
import ctypes
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

_ROW, _DONE, _NULL = 100, 101, 5
# Read only, and without locks against other threads: a connection here belongs to one.
_FLAGS = 0x1 | 0x8000
BLOCK_ROWS = 1_000_000  # that are read at a time
# A statement, the array to fill; how many rows it filled, and SQLite's last answer.
_Fill = Callable[[int | None, np.ndarray], tuple[int, int]]


class SqliteColumns:
    """Asks for columns, all of them as the file was at the first one.

    Args:
        path: the database.
        busy_timeout_ms: how long it waits for another process.

    Raises:
        sqlite3.OperationalError: it cannot be opened or read, as from Python's own module.
    """

    def __init__(self, path: Path, busy_timeout_ms: int) -> None:
        self._library = _library()
        self._connection = ctypes.c_void_p()
        name, own = str(path).encode(), ctypes.byref(self._connection)
        opened = self._library.sqlite3_open_v2(name, own, _FLAGS, None)
        try:
            self._must(opened)
            self._library.sqlite3_busy_timeout(self._connection, busy_timeout_ms)
            with self._statement("BEGIN") as begin:
                self._must(self._library.sqlite3_step(begin), _DONE)
        except sqlite3.OperationalError:
            self.close()
            raise

    def numbers(self, sql: str) -> np.ndarray:
        """(n,) float64 the only column of a query; NaN for null."""
        return self._column(sql, np.float64)

    def integers(self, sql: str) -> np.ndarray:
        """(n,) int64 the only column of a query, without nulls."""
        return self._column(sql, np.int64)

    def close(self) -> None:
        """Lets the file go."""
        self._library.sqlite3_close_v2(self._connection)

    def _column(self, sql: str, kind: type) -> np.ndarray:
        fill = _fill(kind)
        found = []
        with self._statement(sql) as statement:
            answer = _ROW
            while answer == _ROW:
                block: np.ndarray = np.empty(BLOCK_ROWS, kind)
                count, answer = fill(statement.value, block)
                found.append(block[:count])
            self._must(answer, _DONE)
        return np.concatenate(found)

    @contextmanager
    def _statement(self, sql: str) -> Iterator[ctypes.c_void_p]:
        statement = ctypes.c_void_p()
        own = ctypes.byref(statement)
        self._must(self._library.sqlite3_prepare_v2(self._connection, sql.encode(), -1, own, None))
        try:
            yield statement
        finally:
            self._library.sqlite3_finalize(statement)

    def _must(self, answer: int, expected: int = 0) -> None:
        if answer != expected:
            message = self._library.sqlite3_errmsg(self._connection)
            raise sqlite3.OperationalError(message.decode(errors="replace"))


def available() -> bool:
    """Whether the library of Python's module can be asked."""
    try:
        _library()
    except (OSError, AttributeError):
        return False
    return True


@cache
def _library() -> Any:
    """The library, its functions with their types."""
    # A module that is part of the interpreter itself has no file.
    library = ctypes.CDLL(getattr(_sqlite3, "__file__", None))
    handle, text, number = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int
    place = ctypes.POINTER(ctypes.c_void_p)
    for name, answer, *arguments in (
        ("open_v2", number, text, place, number, text),
        ("busy_timeout", number, handle, number),
        ("prepare_v2", number, handle, text, number, place, handle),
        ("step", number, handle),
        ("finalize", number, handle),
        ("close_v2", number, handle),
        ("errmsg", text, handle),
        ("column_type", number, handle, number),
        ("column_double", ctypes.c_double, handle, number),
        ("column_int64", ctypes.c_int64, handle, number),
    ):
        function = getattr(library, f"sqlite3_{name}")
        function.restype, function.argtypes = answer, arguments
    return library


@cache
def _fill(kind: type) -> _Fill:
    """The loop for float64 or int64; compiled once per process, in about a second."""
    from numba import njit

    library = _library()
    step, type_of = library.sqlite3_step, library.sqlite3_column_type
    is_float = kind is np.float64
    value_of = library.sqlite3_column_double if is_float else library.sqlite3_column_int64
    missing = np.nan if is_float else 0

    @njit
    def fill(statement: Any, found: np.ndarray) -> Any:
        for i in range(len(found)):
            answer = step(statement)
            if answer != _ROW:
                return i, answer
            value = value_of(statement, 0)
            # Null is 0 here, so only of that is the type asked.
            found[i] = missing if value == 0 and type_of(statement, 0) == _NULL else value
        return len(found), _ROW

    filled: _Fill = fill
    return filled
