"""Read-only questions in SQL."""

import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, CursorResult, NullPool, create_engine
from sqlalchemy.exc import DBAPIError

from curate.errors import ConfigError, DatabaseError, joined_lines, one_line

# What SQLite may do for a question: read tables and call functions, nothing else. ATTACH would read
# other files, PRAGMA could switch the protection off.
ALLOWED = frozenset(
    {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE}
)
SERVER_ROWS = 1000  # that a server sends at once
FORBIDDEN_FUNCTIONS = frozenset(
    {"load_extension", "readfile", "writefile", "edit", "fts3_tokenizer"}
)
# Of a text or blob: randomblob, printf, replace and group_concat could ask for a gigabyte.
LONGEST_VALUE = 1 << 22
MOST_COLUMNS = 500
LONGEST_SQL = 1 << 20
# SQLite looks at the clock after so many steps of its machine.
_STEPS = 10_000
# The first rows are what somebody waits for: a server compiles nothing, hashes no table before the
# first row, tries the orders of the view's first four tables only, and seeks as memory does.
_FIRST_ROWS = (
    "jit = off",
    "cursor_tuple_fraction = 0.0001",
    "enable_hashjoin = off",
    "join_collapse_limit = 4",
    "random_page_cost = 1.1",
)
# SQLSTATE query_canceled, in every language of the server.
_TIMED_OUT = "57014"


def ask(
    url: URL, sql: str, seconds: float = 60.0
) -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    """The columns and the rows of a question.

    Args:
        url: of the database.
        sql: one SELECT.
        seconds: after which the question is given up, also while its rows are taken.

    Raises:
        ConfigError: the SQL is wrong, does more than read, or takes too long or too much.
        DatabaseError: the database cannot be opened.
    """
    if url.get_backend_name() == "sqlite":
        return _query_sqlite(Path(str(url.database)), sql, seconds)
    return _query_server(url, sql, seconds)


def _query_sqlite(
    path: Path, sql: str, seconds: float
) -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    try:
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
    except sqlite3.Error as error:
        raise DatabaseError(f"{path}: {error}") from error
    for category, limit in (
        (sqlite3.SQLITE_LIMIT_LENGTH, LONGEST_VALUE),
        (sqlite3.SQLITE_LIMIT_SQL_LENGTH, LONGEST_SQL),
        (sqlite3.SQLITE_LIMIT_COLUMN, MOST_COLUMNS),
        (sqlite3.SQLITE_LIMIT_ATTACHED, 0),
        (sqlite3.SQLITE_LIMIT_WORKER_THREADS, 0),
    ):
        connection.setlimit(category, limit)
    connection.execute("PRAGMA query_only = ON")
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.set_authorizer(may_read)
    end = time.monotonic() + seconds
    connection.set_progress_handler(lambda: time.monotonic() > end, _STEPS)
    try:
        cursor = connection.execute(sql)
    except (sqlite3.Error, sqlite3.Warning, UnicodeEncodeError, ValueError) as error:
        connection.close()
        raise _sqlite_error_message(path, error, seconds) from error
    if cursor.description is None:
        connection.close()
        raise ConfigError("query: not a question; write a SELECT")
    return [column[0] for column in cursor.description], _rows(connection, cursor, path, seconds)


def _rows(
    connection: sqlite3.Connection, cursor: sqlite3.Cursor, path: Path, seconds: float
) -> Iterator[tuple[Any, ...]]:
    """The rows as they are found; what goes wrong in the middle is said in our own words."""
    with closing(connection):
        try:
            yield from cursor
        except sqlite3.Error as error:
            raise _sqlite_error_message(path, error, seconds) from error


def _sqlite_error_message(
    path: Path, error: Exception, seconds: float
) -> ConfigError | DatabaseError:
    message = one_line(error)
    if "file is not a database" in message or "malformed" in message:
        return DatabaseError(f"{path}: {message}; restore a backup of the file")
    if "interrupted" in message:
        return _given_up(seconds)
    return ConfigError(_explain(message))


def may_read(action: int, _first: str | None, second: str | None, *_: str | None) -> int:
    """SQLite asks this before each thing that a statement would do; only reading is allowed."""
    if action == sqlite3.SQLITE_FUNCTION and second in FORBIDDEN_FUNCTIONS:
        return sqlite3.SQLITE_DENY
    return sqlite3.SQLITE_OK if action in ALLOWED else sqlite3.SQLITE_DENY


def _query_server(
    url: URL, sql: str, seconds: float
) -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    """The answer of a PostgreSQL server, a part at a time.

    The question becomes DECLARE ... CURSOR FOR, in the protocol that takes one statement only, in a
    read-only transaction: whatever is not a question is no valid SQL there.
    """
    engine = create_engine(url, poolclass=NullPool)
    try:
        connection = engine.connect()
    except DBAPIError as error:
        raise DatabaseError(f"{url.render_as_string()}: {joined_lines(error.orig)}") from error
    end = time.monotonic() + seconds
    try:
        reading = connection.execution_options(postgresql_readonly=True)
        limit = f"statement_timeout = {max(1, round(seconds * 1000))}"
        for setting in (*_FIRST_ROWS, limit):
            reading.exec_driver_sql(f"SET LOCAL {setting}")
        reading = reading.execution_options(stream_results=True, max_row_buffer=SERVER_ROWS)
        result = reading.exec_driver_sql(sql)
    except DBAPIError as error:
        connection.close()
        raise _server_error_message(error, seconds) from error
    return list(result.keys()), _server_rows(reading, result, end, seconds)


def _server_rows(
    connection: Connection, result: CursorResult[Any], end: float, seconds: float
) -> Iterator[tuple[Any, ...]]:
    """The rows as they come; the server's clock starts anew with each part, so ours runs, too."""
    with connection, closing(result):
        try:
            for row in result:
                if time.monotonic() > end:
                    raise _given_up(seconds)
                if any(isinstance(v, str | bytes) and len(v) > LONGEST_VALUE for v in row):
                    raise ConfigError("query: string or blob too big")
                yield tuple(row)
        except DBAPIError as error:
            raise _server_error_message(error, seconds) from error


def _server_error_message(error: DBAPIError, seconds: float) -> ConfigError:
    if getattr(error.orig, "sqlstate", None) == _TIMED_OUT:
        return _given_up(seconds)
    return ConfigError(_explain(joined_lines(error.orig)))


def _given_up(seconds: float) -> ConfigError:
    return ConfigError(
        f"query: given up after {seconds:g} seconds; ask for less, or allow more with --seconds"
    )


def _explain(message: str) -> str:
    if "not authorized" in message or "readonly" in message or "prohibited" in message:
        return "query: only SELECT is allowed, the connection is read-only"
    if "one statement" in message or "multiple commands" in message:
        return "query: one statement at a time"
    return f"query: {message}"
