"""Opening a database: pragmas, migrations, and errors in our own words."""

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError

from curate.errors import ConfigError, DatabaseError, LeakageError
from db.lock_holders import holders
from db.views import create_views

_log = logging.getLogger(__name__)

# A writer that finds another one waits this long before it gives up.
BUSY_TIMEOUT_MS = 30_000


class Database:
    """A migrated database behind one engine.

    Args:
        url: an SQLAlchemy URL, e.g. "sqlite:////data/run/curate.db".

    Raises:
        ConfigError: the URL is none, or its driver is not installed.
        DatabaseError: it cannot be opened, is damaged, or a newer curate has written it.
    """

    def __init__(self, url: str | URL) -> None:
        self.url = parse_url(url) if isinstance(url, str) else url
        self.engine = _engine(self.url)
        with _own_words(self.url.database):
            self._migrate()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection for queries."""
        with _own_words(self.url.database), self.engine.connect() as connection:
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """One transaction: all of it is kept, or nothing."""
        writer = self.engine.execution_options(sqlite_begin="IMMEDIATE")
        with _own_words(self.url.database), writer.begin() as connection:
            yield connection

    def close(self) -> None:
        """Gives every connection back."""
        self.engine.dispose()

    def _migrate(self) -> None:
        config = Config()
        config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
        script = ScriptDirectory.from_config(config)
        with self.engine.connect() as connection:
            current = MigrationContext.configure(connection).get_current_revision()
        if current == script.get_current_head():
            return
        if current is not None and current not in {r.revision for r in script.walk_revisions()}:
            raise DatabaseError(
                f"{self.url.database}: written by a newer curate (schema {current}); update curate"
            )
        if current is not None and self.engine.dialect.name == "sqlite":
            _back_up(Path(str(self.url.database)), current)
        with self.writing() as connection:
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
            create_views(connection)


def _back_up(path: Path, revision: str) -> None:
    """Copies a database as it is before it is migrated.

    Raises:
        DatabaseError: there is no room for it, or its folder cannot be written.
    """
    backup = path.with_name(f"{path.name}.schema-{revision}.backup")
    partial = backup.with_suffix(".partial")
    try:
        with closing(sqlite3.connect(path)) as old, closing(sqlite3.connect(partial)) as copy:
            old.backup(copy)
        partial.replace(backup)
    except (sqlite3.Error, OSError) as error:
        partial.unlink(missing_ok=True)
        raise DatabaseError(
            f"{path}: cannot be copied before its schema is migrated: {error}; make room for "
            f"{backup.name} and run the command again"
        ) from error
    _log.warning(
        "%s: schema %s is migrated; the old database is kept as %s", path, revision, backup
    )


def parse_url(text: str) -> URL:
    """An SQLAlchemy URL.

    Raises:
        ConfigError: it is none.
    """
    try:
        return make_url(text)
    except ArgumentError as error:
        raise ConfigError(
            f"database {text!r}: no SQLAlchemy URL; write postgresql+psycopg://USER@HOST/NAME, or "
            "leave it out for curate.db in the workspace"
        ) from error


def _engine(url: URL) -> Engine:
    try:
        engine = create_engine(url)
    except NoSuchModuleError as error:
        raise ConfigError(f"database {url!r}: {error}") from error
    except ImportError as error:
        raise ConfigError(
            f"database {url!r}: {error}; for PostgreSQL, "
            "pip install 'curate-pseudo-labels[postgres]'"
        ) from error
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _set_pragmas)
        event.listen(engine, "begin", _begin)
    return engine


def _set_pragmas(connection: Any, _record: Any) -> None:
    # The driver's own transactions are off, so that DDL is transactional too; see _begin.
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")
    cursor.execute("PRAGMA journal_mode = WAL")
    cursor.execute("PRAGMA synchronous = NORMAL")
    cursor.execute("PRAGMA foreign_keys = ON")
    cursor.close()


def _begin(connection: Connection) -> None:
    # Taking the write lock at once lets a second writer wait instead of failing half way.
    mode = connection.get_execution_options().get("sqlite_begin", "DEFERRED")
    connection.exec_driver_sql(f"BEGIN {mode}")


@contextmanager
def _own_words(name: str | None) -> Iterator[None]:
    """Turns the driver's errors into one line that names the database and the remedy."""
    try:
        yield
    except DBAPIError as error:
        if "ground truth of an unlabeled frame" in str(error.orig):
            raise LeakageError(f"{name}: {error.orig} must not be stored") from error
        raise DatabaseError(f"{name}: {error.orig}{_remedy(str(error.orig), name)}") from error


def _remedy(message: str, name: str | None) -> str:
    if "locked" in message and name is not None and (found := holders(Path(name))):
        return (
            f"; waited {BUSY_TIMEOUT_MS / 1000:g} s for {', '.join(found)}, which is writing: "
            "wait for it or end it, then run the command again"
        )
    remedies = {
        "malformed": "; restore a backup, or rebuild it with `sqlite3 OLD .recover | sqlite3 NEW`",
        "not a database": "; this file is damaged or of another kind, move it away or restore it",
        "locked": "; another process is writing, wait for it or end it",
        "readonly": "; give yourself write permission on the file and its folder",
        "unable to open": "; check that the folder exists and can be written",
        "disk I/O error": "; check the disk and its mount, finished frames are kept",
        "full": "; free space on the disk and run the command again, finished frames are kept",
    }
    return next((remedy for sign, remedy in remedies.items() if sign in message), "")
