"""Read-only questions in SQL."""

import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, CursorResult, NullPool, create_engine
from sqlalchemy.exc import DBAPIError

from curate.errors import ConfigError, DatabaseError

# What SQLite may do for a question: read tables and call functions, nothing else. ATTACH would read
# other files, PRAGMA could switch the protection off.
ALLOWED = frozenset(
    {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE}
)
SERVER_ROWS = 1000  # that a server sends at once
FORBIDDEN_FUNCTIONS = frozenset(
    {"load_extension", "readfile", "writefile", "edit", "fts3_tokenizer"}
)


def ask(url: URL, sql: str) -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    """The columns and the rows of a question.

    Raises:
        ConfigError: the SQL is wrong, or does more than read.
        DatabaseError: the database cannot be opened.
    """
    if url.get_backend_name() == "sqlite":
        return _ask_sqlite(Path(str(url.database)), sql)
    return _ask_server(url, sql)


def _ask_sqlite(path: Path, sql: str) -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    try:
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
    except sqlite3.Error as error:
        raise DatabaseError(f"{path}: {error}") from error
    connection.execute("PRAGMA query_only = ON")
    connection.set_authorizer(may_read)
    try:
        cursor = connection.execute(sql)
    except (sqlite3.Error, sqlite3.Warning) as error:
        if "file is not a database" in str(error) or "malformed" in str(error):
            raise DatabaseError(f"{path}: {error}") from error
        raise ConfigError(_explain(str(error))) from error
    if cursor.description is None:
        raise ConfigError("query: not a question; write a SELECT")
    return [column[0] for column in cursor.description], iter(cursor)


def may_read(action: int, _first: str | None, second: str | None, *_: str | None) -> int:
    """SQLite asks this before each thing that a statement would do; only reading is allowed."""
    if action == sqlite3.SQLITE_FUNCTION and second in FORBIDDEN_FUNCTIONS:
        return sqlite3.SQLITE_DENY
    return sqlite3.SQLITE_OK if action in ALLOWED else sqlite3.SQLITE_DENY


def _ask_server(url: URL, sql: str) -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    """The answer of a PostgreSQL server, a part at a time.

    The question becomes DECLARE ... CURSOR FOR, in the protocol that takes one statement only, in a
    read-only transaction: whatever is not a question is no valid SQL there.
    """
    engine = create_engine(url, poolclass=NullPool)
    try:
        connection = engine.connect()
    except DBAPIError as error:
        raise DatabaseError(f"{url.render_as_string()}: {_one_line(error.orig)}") from error
    reading = connection.execution_options(
        postgresql_readonly=True, stream_results=True, max_row_buffer=SERVER_ROWS
    )
    try:
        result = reading.exec_driver_sql(sql)
    except DBAPIError as error:
        raise ConfigError(_explain(_one_line(error.orig))) from error
    return list(result.keys()), _rows(reading, result)


def _rows(connection: Connection, result: CursorResult[Any]) -> Iterator[tuple[Any, ...]]:
    with connection:
        for row in result:
            yield tuple(row)


def _one_line(error: BaseException | None) -> str:
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def _explain(message: str) -> str:
    if "not authorized" in message or "readonly" in message or "prohibited" in message:
        return "query: only SELECT is allowed, the connection is read-only"
    if "one statement" in message:
        return "query: one statement at a time"
    return f"query: {message}"
