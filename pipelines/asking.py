"""Read-only questions in SQL."""

import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from sqlalchemy import URL, create_engine
from sqlalchemy.exc import DBAPIError

from curate.errors import ConfigError, DatabaseError

# What SQLite may do for a question: read tables and call functions, nothing else. ATTACH would read
# other files, PRAGMA could switch the protection off.
ALLOWED = frozenset(
    {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE}
)
FORBIDDEN_FUNCTIONS = frozenset(
    {"load_extension", "readfile", "writefile", "edit", "fts3_tokenizer"}
)
# Of a text or blob: randomblob, printf, replace and group_concat could ask for a gigabyte.
LONGEST_VALUE = 1 << 22
MOST_COLUMNS = 500
LONGEST_SQL = 1 << 20
# SQLite looks at the clock after so many steps of its machine.
_STEPS = 10_000
_FETCHED = 1_000


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
        return _ask_sqlite(Path(str(url.database)), sql, seconds)
    return _ask_server(url, sql, seconds)


def _ask_sqlite(
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
    connection.set_authorizer(_authorize)
    end = time.monotonic() + seconds
    connection.set_progress_handler(lambda: time.monotonic() > end, _STEPS)
    try:
        cursor = connection.execute(sql)
    except (sqlite3.Error, sqlite3.Warning, UnicodeEncodeError, ValueError) as error:
        connection.close()
        raise _own_words(path, error, seconds) from error
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
            raise _own_words(path, error, seconds) from error


def _own_words(path: Path, error: Exception, seconds: float) -> ConfigError | DatabaseError:
    message = " ".join(str(error).split())
    if "file is not a database" in message or "malformed" in message:
        return DatabaseError(f"{path}: {message}")
    if "interrupted" in message:
        return ConfigError(
            f"query: given up after {seconds:g} seconds; ask for less, or allow more with --seconds"
        )
    return ConfigError(_explain(message))


def _authorize(action: int, _first: str | None, second: str | None, *_: str | None) -> int:
    """SQLite asks this before each thing that a statement would do."""
    if action == sqlite3.SQLITE_FUNCTION and second in FORBIDDEN_FUNCTIONS:
        return sqlite3.SQLITE_DENY
    return sqlite3.SQLITE_OK if action in ALLOWED else sqlite3.SQLITE_DENY


def _ask_server(
    url: URL, sql: str, seconds: float
) -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    """Asks PostgreSQL, in a transaction that can only read."""
    connection = create_engine(url).connect().execution_options(postgresql_readonly=True)
    try:
        connection.exec_driver_sql(f"SET LOCAL statement_timeout = {int(seconds * 1000)}")
        # Prepared, so that several statements in one text are refused: the first of them could
        # end the transaction that can only read.
        cursor = connection.connection.cursor()
        cursor.execute(sql, prepare=True)  # type: ignore[call-arg]
    except DBAPIError as error:
        raise ConfigError(_explain(str(error.orig))) from error
    except connection.dialect.loaded_dbapi.Error as error:
        raise ConfigError(_explain(" ".join(str(error).split()))) from error
    if cursor.description is None:
        raise ConfigError("query: not a question; write a SELECT")
    return [column[0] for column in cursor.description], _fetched(cursor)


def _fetched(cursor: Any) -> Iterator[tuple[Any, ...]]:
    while rows := cursor.fetchmany(_FETCHED):
        yield from map(tuple, rows)


def _explain(message: str) -> str:
    if "not authorized" in message or "readonly" in message or "prohibited" in message:
        return "query: only SELECT is allowed, the connection is read-only"
    if "one statement" in message or "multiple commands" in message:
        return "query: one statement at a time"
    return f"query: {message}"
