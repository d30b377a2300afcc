"""A SQLite file as strangers may query it: nothing but reading, and never much of anything."""

import asyncio
import os
import sqlite3
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from datasette.database import Database

from curate.errors import DatabaseError
from pipelines.queries.functions import register_functions
from pipelines.queries.run_query import may_read

# What Datasette asks of a file to describe it; none of them changes anything without a value.
_PRAGMAS = frozenset(
    {"database_list", "foreign_key_list", "index_list", "schema_version", "table_info",
     "table_xinfo"}
)  # fmt: skip
# One call of these can run for minutes, and no time limit reaches into a call.
_SLOW_FUNCTIONS = frozenset({"printf", "format"})
# These name files of the machine, or show raw pages.
_HIDDEN_TABLES = ("pragma_", "sqlite_dbpage", "dbstat")
_COUNT_LIMIT_MS = 300
# The longest text that curate stores is a round's configuration, some kilobytes. A question needs
# no more: zeroblob(1e9) in a thousand rows would fill the memory, and replace() of long texts takes
# the square of their length.
_LIMITS = {
    sqlite3.SQLITE_LIMIT_LENGTH: 30_000,
    sqlite3.SQLITE_LIMIT_SQL_LENGTH: 20_000,
    sqlite3.SQLITE_LIMIT_COLUMN: 100,
    sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 100,
    sqlite3.SQLITE_LIMIT_COMPOUND_SELECT: 20,
    sqlite3.SQLITE_LIMIT_LIKE_PATTERN_LENGTH: 200,
    sqlite3.SQLITE_LIMIT_ATTACHED: 0,
    sqlite3.SQLITE_LIMIT_WORKER_THREADS: 0,
}


class ReadOnlyDatabase(Database):  # type: ignore[misc]
    """A database of Datasette whose every connection is opened by `connect_read_only`.

    Args:
        datasette: that serves it.
        path: of the SQLite file; where another file takes its place, as an export does, the next
            question goes to that one.
    """

    def __init__(self, datasette: Any, path: Path) -> None:
        # Mutable: a run may be writing to it, so that neither size nor counts may be remembered.
        super().__init__(datasette, str(path), is_mutable=True)
        self._file = path
        self._own = threading.local()

    def connect(self, write: bool = False) -> sqlite3.Connection:
        """Return a connection.

        Raises:
            DatabaseError: if one that writes is asked for.
        """
        if write:
            raise DatabaseError(f"{self._file}: served for reading only")
        return connect_read_only(self._file)

    async def execute_fn(self, fn: Callable[[sqlite3.Connection], Any]) -> Any:
        """What a function makes of this thread's connection, in a thread of the pool."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self.ds.executor, lambda: fn(self._connection()))

    async def execute(self, sql: str, *arguments: Any, **options: Any) -> Any:
        """The rows of a question; what is wrong with it is told to who asked, not to the log."""
        if sql.lstrip().startswith("select count(*)") and "truncate" not in options:
            # Datasette's own, for the head of a table: not worth the time of a question.
            options["custom_time_limit"] = _COUNT_LIMIT_MS
        return await super().execute(sql, *arguments, **options | {"log_sql_errors": False})

    def _connection(self) -> sqlite3.Connection:
        state = os.stat(self._file)  # noqa: PTH116 - one call per question
        place = (state.st_dev, state.st_ino)
        if getattr(self._own, "place", None) != place:
            self._own.connection = self.connect()
            self.ds._prepare_connection(self._own.connection, self.name)  # noqa: SLF001
            self._own.place = place
        connection: sqlite3.Connection = self._own.connection
        return connection


def connect_read_only(path: Path) -> sqlite3.Connection:
    """Return a connection that can read this file's tables and nothing else.

    Four locks, one behind the other: the file is opened for reading, the connection refuses to
    write, the authorizer admits SELECT alone, and the sizes of values and questions are bounded.

    Raises:
        DatabaseError: if there is no SQLite file, or it is damaged.
    """
    try:
        # The URI quotes what would mean something in a path, such as a ? in a folder's name.
        uri = f"{path.resolve().as_uri()}?mode=ro"
        connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
        connection.execute("PRAGMA query_only = ON")
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.Error as error:
        raise DatabaseError(f"{path}: {error}; name a SQLite file of curate") from error
    for limit, value in _LIMITS.items():
        connection.setlimit(limit, value)
    register_functions(connection)
    connection.set_authorizer(_authorize)
    return connection


def _authorize(action: int, first: str | None, second: str | None, *_: str | None) -> int:
    """SQLite asks this before each thing that a statement would do."""
    name = (first or "").lower()
    if action == sqlite3.SQLITE_PRAGMA:
        harmless = name in _PRAGMAS and (name != "schema_version" or second is None)
        return sqlite3.SQLITE_OK if harmless else sqlite3.SQLITE_DENY
    if action == sqlite3.SQLITE_READ and name.startswith(_HIDDEN_TABLES):
        return sqlite3.SQLITE_DENY
    if action == sqlite3.SQLITE_FUNCTION and (second or "").lower() in _SLOW_FUNCTIONS:
        return sqlite3.SQLITE_DENY
    return may_read(action, first, second)
