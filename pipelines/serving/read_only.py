"""Read-only access to a SQLite file for untrusted queries, with limits on time and memory."""

import asyncio
import os
import sqlite3
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from datasette.database import Database

from curate.errors import DatabaseError
from db.read_only import read_only_uri
from pipelines.queries.functions import register_functions
from pipelines.queries.run_query import may_read

# Datasette describes a file with these. Without a value they change nothing.
_PRAGMAS = frozenset(
    {"database_list", "foreign_key_list", "index_list", "schema_version", "table_info",
     "table_xinfo"}
)  # fmt: skip
# One call of these can run for minutes, and the time limit does not interrupt a call.
_SLOW_FUNCTIONS = frozenset({"printf", "format"})
# These show paths of this machine or raw database pages.
_HIDDEN_TABLES = ("pragma_", "sqlite_dbpage", "dbstat")
_COUNT_LIMIT_MS = 300
# The longest text that curate stores is a round's configuration, some kilobytes; a query needs no
# more. Without limits, zeroblob(1e9) in a thousand rows would fill the memory, and the time of
# replace() grows with the square of the text's length.
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
    """A Datasette database that opens every connection with `connect_read_only`.

    Args:
        datasette: the server.
        path: of the SQLite file. After an export has replaced the file, queries read the new one.
    """

    def __init__(self, datasette: Any, path: Path) -> None:
        # Mutable: a run may write to it, so Datasette must not cache its size and counts.
        super().__init__(datasette, str(path), is_mutable=True)
        self._file = path
        self._local = threading.local()

    def connect(self, write: bool = False) -> sqlite3.Connection:
        """Return a read-only connection.

        Raises:
            DatabaseError: if a connection for writing is requested.
        """
        if write:
            raise DatabaseError(f"{self._file}: served read-only")
        return connect_read_only(self._file)

    async def execute_fn(self, fn: Callable[[sqlite3.Connection], Any]) -> Any:
        """Call a function with the connection of a thread of the pool, in that thread."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self.ds.executor, lambda: fn(self._connection()))

    async def execute(self, sql: str, *arguments: Any, **options: Any) -> Any:
        """Run a query; its errors are sent to the client, not to the log."""
        if sql.lstrip().startswith("select count(*)") and "truncate" not in options:
            # Datasette's own query for the head of a table: it gets a shorter time limit.
            options["custom_time_limit"] = _COUNT_LIMIT_MS
        return await super().execute(sql, *arguments, **options | {"log_sql_errors": False})

    def _connection(self) -> sqlite3.Connection:
        state = os.stat(self._file)  # noqa: PTH116 - one call per query
        place = (state.st_dev, state.st_ino)
        if getattr(self._local, "place", None) != place:
            self._local.connection = self.connect()
            self.ds._prepare_connection(self._local.connection, self.name)  # noqa: SLF001
            self._local.place = place
        connection: sqlite3.Connection = self._local.connection
        return connection


def connect_read_only(path: Path) -> sqlite3.Connection:
    """Return a connection that can read this file's tables and nothing else.

    Four layers of protection: the file is opened for reading, the connection rejects writes, the
    authorizer allows only SELECT, and the sizes of values and queries are limited.

    Raises:
        DatabaseError: if the file is missing, damaged or not a SQLite file.
    """
    try:
        connection = sqlite3.connect(read_only_uri(path), uri=True, check_same_thread=False)
        connection.execute("PRAGMA query_only = ON")
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.Error as error:
        raise DatabaseError(f"{path}: {error}; specify a SQLite file of curate") from error
    for limit, value in _LIMITS.items():
        connection.setlimit(limit, value)
    register_functions(connection)
    connection.set_authorizer(_authorize)
    return connection


def _authorize(action: int, first: str | None, second: str | None, *_: str | None) -> int:
    """Return whether SQLite may take a step of a statement."""
    name = (first or "").lower()
    if action == sqlite3.SQLITE_PRAGMA:
        harmless = name in _PRAGMAS and (name != "schema_version" or second is None)
        return sqlite3.SQLITE_OK if harmless else sqlite3.SQLITE_DENY
    if action == sqlite3.SQLITE_READ and name.startswith(_HIDDEN_TABLES):
        return sqlite3.SQLITE_DENY
    if action == sqlite3.SQLITE_FUNCTION and (second or "").lower() in _SLOW_FUNCTIONS:
        return sqlite3.SQLITE_DENY
    return may_read(action, first, second)
