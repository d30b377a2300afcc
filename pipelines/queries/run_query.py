"""Read-only SQL on a workspace's database or an exported label file."""

import re
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, CursorResult, NullPool, create_engine
from sqlalchemy.exc import DBAPIError

from curate.errors import ConfigError, DatabaseError, joined_lines, one_line
from curate.spelling import did_you_mean
from db.read_only import read_only_uri
from pipelines.queries.functions import FUNCTIONS, register_functions

Names = Mapping[str, Sequence[str]]
"""The columns of each table and view."""

# A query may only read tables and call functions. ATTACH would read other files, and PRAGMA could
# switch the protection off.
ALLOWED = frozenset(
    {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE}
)
SERVER_ROWS = 1000  # rows that a server sends at once
FORBIDDEN_FUNCTIONS = frozenset(
    {"load_extension", "readfile", "writefile", "edit", "fts3_tokenizer"}
)
# Of a text or blob: randomblob, printf, replace and group_concat could request a gigabyte.
LONGEST_VALUE = 1 << 22
MOST_COLUMNS = 500
LONGEST_SQL = 1 << 20
# SQLite checks the time limit after this number of steps of its virtual machine.
_STEPS = 10_000
# Settings of PostgreSQL for an early first row: no compilation; no table is hashed before the first
# row; only orders of four tables of a view are tried; random access costs little, as in memory.
_FIRST_ROWS = (
    "jit = off",
    "cursor_tuple_fraction = 0.0001",
    "enable_hashjoin = off",
    "join_collapse_limit = 4",
    "random_page_cost = 1.1",
)
# SQLSTATE query_canceled; the message depends on the language of the server.
_TIMED_OUT = "57014"
# Messages of SQLite and PostgreSQL about something unknown: its kind and its name.
_UNKNOWN = re.compile(
    r"no such (?P<kind>column|table|function): \"?(?P<name>[\w.]+)"
    r"|(?P<kind_>column|relation|function) \"?(?P<name_>[\w.]+).* does not exist"
)
_FUNCTION_NAMES = (
    *(each.name for each in FUNCTIONS),
    *("abs", "avg", "coalesce", "count", "group_concat", "max", "min", "round", "sqrt", "sum"),
)


def run_query(
    url: URL, sql: str, seconds: float = 60.0
) -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    """Return the columns and the rows of a query.

    Args:
        url: of the database.
        sql: one SELECT.
        seconds: time after which the query is stopped, even while its rows are read.

    Raises:
        ConfigError: if the SQL is invalid, does more than read, or takes too much time or memory.
        DatabaseError: if the database cannot be opened.
    """
    if url.get_backend_name() == "sqlite":
        return _run_on_sqlite(Path(str(url.database)), sql, seconds)
    return _run_on_server(url, sql, seconds)


def _run_on_sqlite(
    path: Path, sql: str, seconds: float
) -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    try:
        connection = sqlite3.connect(read_only_uri(path), uri=True)
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
    function_errors = register_functions(connection)
    connection.set_authorizer(may_read)
    end = time.monotonic() + seconds
    connection.set_progress_handler(lambda: time.monotonic() > end, _STEPS)
    try:
        cursor = connection.execute(sql)
    except (sqlite3.Error, sqlite3.Warning, UnicodeEncodeError, ValueError) as error:
        converted = _sqlite_error_message(path, error, seconds, connection)
        connection.close()
        raise converted from error
    if cursor.description is None:
        connection.close()
        raise ConfigError("query: this statement returns no rows; write a SELECT")
    rows = _rows(connection, cursor, path, seconds, function_errors)
    return [column[0] for column in cursor.description], rows


def _rows(
    connection: sqlite3.Connection,
    cursor: sqlite3.Cursor,
    path: Path,
    seconds: float,
    function_errors: Sequence[str],
) -> Iterator[tuple[Any, ...]]:
    """Yield the rows; an error between them is raised as an error of curate."""
    with closing(connection):
        try:
            for row in cursor:
                _check_functions(function_errors)
                yield row
            _check_functions(function_errors)
        except sqlite3.Error as error:
            raise _sqlite_error_message(path, error, seconds, connection) from error


def _check_functions(errors: Sequence[str]) -> None:
    """Raise ConfigError if an SQL function has reported an invalid argument."""
    if errors:
        raise ConfigError(f"query: {errors[-1]}")


def _sqlite_error_message(
    path: Path, error: Exception, seconds: float, connection: sqlite3.Connection
) -> ConfigError | DatabaseError:
    message = one_line(error)
    if "file is not a database" in message or "malformed" in message:
        return DatabaseError(f"{path}: {message}; restore a backup of the file")
    if "interrupted" in message:
        return _timeout(seconds)
    return ConfigError(_explain(message) + _suggestion(message, lambda: _sqlite_names(connection)))


def _sqlite_names(connection: sqlite3.Connection) -> Names:
    """Return the columns of each table and view."""
    connection.set_authorizer(None)
    query = (
        "SELECT m.name, c.name FROM sqlite_master AS m, pragma_table_info(m.name) AS c "
        "WHERE m.type IN ('table', 'view')"
    )
    try:
        return _grouped(connection.execute(query))
    except sqlite3.Error:  # a file from elsewhere may contain an invalid view
        return {}


def _server_names(connection: Connection) -> Names:
    """Return the columns of each table and view of a server."""
    connection.rollback()
    rows = connection.exec_driver_sql(
        "SELECT table_name, column_name FROM information_schema.columns "
        "WHERE table_schema = current_schema()"
    )
    return _grouped(tuple(row) for row in rows)


def _grouped(rows: Iterable[tuple[str, str]]) -> Names:
    names: dict[str, list[str]] = {}
    for table, column in rows:
        names.setdefault(table, []).append(column)
    return names


def _suggestion(message: str, read_names: Callable[[], Names]) -> str:
    """Suggest a known name for an unknown one, and say where the known names are listed."""
    found = _UNKNOWN.search(message)
    if found is None:
        return ""
    kind, name = found["kind"] or found["kind_"], (found["name"] or found["name_"]).split(".")[-1]
    if kind == "function":
        for each in FUNCTIONS:
            if each.name == name and "does not exist" in message:
                return f"; on PostgreSQL: {each.postgresql.replace('`', '')}"
        suggestion = did_you_mean(name, _FUNCTION_NAMES)
        return _hint(suggestion, "docs/queries.md lists the functions of curate")
    names = read_names()
    owners = sorted(table for table, columns in names.items() if name in columns)
    if kind == "column" and owners:
        others = " and others" if len(owners) > 3 else ""
        return f"; it is a column of {', '.join(owners[:3])}{others}"
    known = names if kind in {"table", "relation"} else {c for each in names.values() for c in each}
    return _hint(
        did_you_mean(name, sorted(known)), "`curate query --schema` lists tables and columns"
    )


def _hint(suggestion: str, hint: str) -> str:
    return f"{suggestion} {hint}" if suggestion else f"; {hint}"


def may_read(action: int, _first: str | None, second: str | None, *_: str | None) -> int:
    """Return whether SQLite may take a step of a statement; only reading is allowed."""
    if action == sqlite3.SQLITE_FUNCTION and second in FORBIDDEN_FUNCTIONS:
        return sqlite3.SQLITE_DENY
    return sqlite3.SQLITE_OK if action in ALLOWED else sqlite3.SQLITE_DENY


def _run_on_server(
    url: URL, sql: str, seconds: float
) -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    """Return columns and rows from a PostgreSQL server, which sends some rows at a time.

    The query becomes DECLARE ... CURSOR FOR in a read-only transaction, in a protocol that accepts
    only one statement. Anything that is not a query is invalid SQL there.
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
        converted = _server_error_message(error, seconds, connection)
        connection.close()
        raise converted from error
    return list(result.keys()), _server_rows(reading, result, end, seconds)


def _server_rows(
    connection: Connection, result: CursorResult[Any], end: float, seconds: float
) -> Iterator[tuple[Any, ...]]:
    """Yield the rows as they arrive.

    The time limit of the server applies to each part, so the total time is checked here.
    """
    with connection, closing(result):
        try:
            for row in result:
                if time.monotonic() > end:
                    raise _timeout(seconds)
                if any(isinstance(v, str | bytes) and len(v) > LONGEST_VALUE for v in row):
                    raise ConfigError("query: string or blob too big")
                yield tuple(row)
        except DBAPIError as error:
            raise _server_error_message(error, seconds, connection) from error


def _server_error_message(error: DBAPIError, seconds: float, connection: Connection) -> ConfigError:
    if getattr(error.orig, "sqlstate", None) == _TIMED_OUT:
        return _timeout(seconds)
    message = joined_lines(error.orig)
    return ConfigError(_explain(message) + _suggestion(message, lambda: _server_names(connection)))


def _timeout(seconds: float) -> ConfigError:
    return ConfigError(
        f"query: stopped after {seconds:g} seconds; select less, or allow more with --seconds"
    )


def _explain(message: str) -> str:
    if "not authorized" in message or "readonly" in message or "prohibited" in message:
        return "query: only SELECT is allowed, the connection is read-only"
    if "one statement" in message or "multiple commands" in message:
        return "query: only one statement is allowed"
    if "unable to open database file" in message:
        return (
            f"query: {message}; SQLite must be able to write in its folder: copy the workspace, or "
            "query an exported file with --file"
        )
    return f"query: {message}"
