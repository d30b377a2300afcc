"""Opening a database: connection settings, migrations, and errors with a remedy."""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, Select, create_engine, event, inspect, text
from sqlalchemy.exc import DBAPIError, NoSuchModuleError

from curate.errors import ConfigError, DatabaseError, LeakageError, joined_lines
from db import bulk
from db.addresses import parse_url
from db.backups import back_up
from db.claims import Check, Resource, claimed, round_resources, wait_for_transactions
from db.lock_holders import find_writers
from db.models import Base
from db.read_only import is_read_only, read_only_uri
from db.views import create_views, drop_views, refresh_views, views_are_current

# A writer waits this long for another one before it fails.
BUSY_TIMEOUT_MS = 30_000
_MIGRATIONS = Path(__file__).parent / "migrations"
# From the file names: opening a database with the current schema does not need alembic, which takes
# as long to import as SQLAlchemy.
REVISIONS = sorted(path.stem.partition("_")[0] for path in _MIGRATIONS.glob("versions/*.py"))
# Two processes may find an old schema on a server at the same time; this lock lets one migrate it.
_MIGRATION_LOCK = 0x637572617465  # "curate" in ASCII


class Database:
    """A database with the current schema. Opening one with an older schema migrates it.

    Args:
        url: an SQLAlchemy URL, e.g. "sqlite:////data/run/curate.db" or
            "postgresql://user@host/curate" (with psycopg 3).
        backups: folder for a dump of a PostgreSQL database before its schema is migrated.

    Raises:
        ConfigError: if the URL is invalid, or its driver is not installed.
        DatabaseError: if the database cannot be opened, is damaged, or was written by a newer
            curate.
    """

    def __init__(self, url: str | URL, backups: Path | None = None) -> None:
        self.url = parse_url(url) if isinstance(url, str) else url
        self._read_only = self.url.get_backend_name() == "sqlite" and is_read_only(
            Path(str(self.url.database))
        )
        self.engine = _engine(self.url, read_only=self._read_only)
        self._claims: list[Check] = []
        with ExitStack() as failed:
            failed.callback(self.close)
            with self._translate_errors():
                self._migrate(backups)
            failed.pop_all()

    @property
    def name(self) -> str:
        """The name of the database in messages: a path, or a URL without its password."""
        if self.engine.dialect.name == "sqlite":
            return str(self.url.database)
        return self.url.set(drivername=self.url.get_backend_name()).render_as_string()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Yield a connection for queries."""
        with self._translate_errors(), self.engine.connect() as connection:
            yield connection

    def rows(self, query: Select[Any]) -> Sequence[bulk.Row]:
        """Return all rows of a query, see `db.bulk.select`."""
        with self.reading() as connection:
            return bulk.select(connection, query)

    @contextmanager
    def writing(self, *, keys_known: bool = False) -> Iterator[Connection]:
        """Yield a connection in one transaction, which is committed as a whole or not at all.

        Args:
            keys_known: whether the rows that new rows refer to were read under a claim. SQLite then
                skips its foreign keys: it looks up no key, and deletes no rows that refer to
                deleted ones.

        Raises:
            DatabaseError: if a claim was lost, so that another process may write the same rows;
                nothing is written.
        """
        writer = self.engine.execution_options(
            sqlite_begin="IMMEDIATE", sqlite_foreign_keys=not keys_known
        )
        with self._translate_errors():
            for check in self._claims:
                check()
            with writer.begin() as connection:
                yield connection

    @contextmanager
    def claiming_round(self, number: int, policy: str | None, purpose: str) -> Iterator[None]:
        """Claim a round, or the round of one policy, until the block ends; see `db.claims`.

        Raises:
            DatabaseError: if another process works on it; the message says which one.
        """
        with self.claiming(round_resources(number, policy), purpose):
            yield

    @contextmanager
    def claiming(self, resources: Sequence[Resource], purpose: str) -> Iterator[None]:
        """Claim resources until the block ends; see `db.claims`.

        Raises:
            DatabaseError: if another process holds one of them; the message says which one.
        """
        with ExitStack() as stack:
            with self._translate_errors():
                check = stack.enter_context(claimed(self.engine, resources, purpose))
            self._claims.append(check)
            stack.callback(self._claims.remove, check)
            yield

    def close(self) -> None:
        """Close all connections of the pool."""
        self.engine.dispose()

    def _migrate(self, backups: Path | None) -> None:
        head = REVISIONS[-1]
        with self.engine.connect() as connection:
            current = self._revision(connection)
            if current is None:
                self._check_tables(connection)
            elif current == head:
                self._require_tables(connection)
            views_current = current == head and views_are_current(connection)
        if self._read_only:
            if not views_current:
                raise DatabaseError(
                    f"{self.name}: an older curate wrote it, and it cannot be migrated without "
                    "write permission: copy the workspace into a folder of your own"
                )
            return
        self._write_ahead()
        if views_current:
            return
        # A migration may copy a table that others refer to.
        with self.writing(keys_known=True) as connection:
            wait_for_transactions(connection, _MIGRATION_LOCK)
            # Another process may have migrated the database while this one waited. It has also
            # made a backup of the older schema, which a backup made now would replace.
            current = self._revision(connection)
            if current == head:
                refresh_views(connection)
                return
            if current is not None:
                back_up(self.url, current, backups)
            drop_views(connection)
            _upgrade(connection)
            create_views(connection)

    def _write_ahead(self) -> None:
        """Switch an SQLite file to write-ahead logging, so that readers do not wait for a writer.

        The setting is stored in the file.
        """
        if self.engine.dialect.name == "sqlite":
            with closing(self.engine.raw_connection()) as connection:
                connection.cursor().execute("PRAGMA journal_mode = WAL")

    def _require_tables(self, connection: Connection) -> None:
        """Raise DatabaseError if a table of this schema is missing."""
        missing = sorted(set(Base.metadata.tables) - set(inspect(connection).get_table_names()))
        if missing:
            raise DatabaseError(
                f"{self.name}: table {', '.join(missing)} is missing; restore a backup"
            )

    def _check_tables(self, connection: Connection) -> None:
        """Raise DatabaseError if a database without curate's schema has tables.

        A PostgreSQL database may also hold tables of other programs. An SQLite file may not.
        """
        found = set(inspect(connection).get_table_names()) - {"alembic_version"}
        if self.engine.dialect.name != "sqlite":
            found &= set(Base.metadata.tables)
        if found:
            raise DatabaseError(
                f"{self.name}: has a table {min(found)}, but table alembic_version has no schema "
                "of curate; if the database belongs to another program, move it away or choose "
                "another one, else restore a backup"
            )

    def _revision(self, connection: Connection) -> str | None:
        """Return the revision of the schema, None for an empty database.

        Raises:
            DatabaseError: if this version of curate does not have the revision.
        """
        if not inspect(connection).has_table("alembic_version"):
            return None
        found = connection.execute(text("SELECT version_num FROM alembic_version")).scalars().all()
        if len(found) > 1:  # no version of curate writes more than one
            raise DatabaseError(
                f"{self.name}: table alembic_version lists several schemas; restore a backup"
            )
        if found and found[0] not in REVISIONS:
            raise DatabaseError(
                f"{self.name}: written by a newer curate (schema {found[0]}); update curate"
            )
        return str(found[0]) if found else None

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        """Turn the driver's errors into a DatabaseError with the database and a remedy."""
        try:
            yield
        except DBAPIError as error:
            raise self._translated(error.orig or error) from error
        except self.engine.dialect.loaded_dbapi.Error as error:
            # db.bulk uses the driver directly, so SQLAlchemy does not wrap its errors.
            raise self._translated(error) from error

    def _translated(self, error: BaseException) -> DatabaseError | LeakageError:
        message = joined_lines(error)
        if "ground truth of an unlabeled frame" in message:
            return LeakageError(f"{self.name}: {message} must not be stored")
        return DatabaseError(f"{self.name}: {message}{self._remedy(message)}")

    def _remedy(self, message: str) -> str:
        backend = self.engine.dialect.name
        if backend == "sqlite" and "locked" in message:
            writers = find_writers(Path(str(self.url.database)))
            if writers:
                return (
                    f"; waited {BUSY_TIMEOUT_MS / 1000:g} s for {', '.join(writers)}, which is "
                    "writing: wait for it or stop it, then rerun the command"
                )
        return next((each for sign, each in _REMEDIES[backend].items() if sign in message), "")


def _upgrade(connection: Connection) -> None:
    """Run the migrations that the database does not have yet."""
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(_MIGRATIONS))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


def _engine(url: URL, *, read_only: bool = False) -> Engine:
    options: dict[str, Any] = {}
    if read_only:
        uri = read_only_uri(Path(str(url.database)))
        options["creator"] = partial(sqlite3.connect, uri, uri=True, check_same_thread=False)
    try:
        engine = create_engine(url, **options)
    except NoSuchModuleError as error:
        raise ConfigError(f"database {url!r}: {error}") from error
    except ImportError as error:
        raise ConfigError(
            f"database {url!r}: {error}; for PostgreSQL, "
            "pip install 'curate-pseudo-labels[postgres]'"
        ) from error
    if engine.dialect.name not in _REMEDIES:
        supported = " and ".join(_REMEDIES)
        raise ConfigError(f"database {url!r}: curate supports {supported} only")
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _set_pragmas)
        event.listen(engine, "begin", _begin)
    else:
        event.listen(engine, "connect", _disable_jit)
    return engine


def _disable_jit(connection: Any, _record: Any) -> None:
    # Compiling a query takes the server longer than running most of them.
    connection.execute("SET jit = off")
    connection.commit()


def _set_pragmas(connection: Any, _record: Any) -> None:
    # The driver's own transactions are off, so that DDL is transactional too; see _begin.
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")
    cursor.execute("PRAGMA synchronous = NORMAL")
    cursor.close()


def _begin(connection: Connection) -> None:
    # A writer takes the lock at once (IMMEDIATE): a second writer then waits, while one that asks
    # for the lock later in its transaction fails.
    options = connection.get_execution_options()
    # This pragma has no effect within a transaction, so it comes before BEGIN.
    checked = "ON" if options.get("sqlite_foreign_keys", True) else "OFF"
    connection.exec_driver_sql(f"PRAGMA foreign_keys = {checked}")
    connection.exec_driver_sql(f"BEGIN {options.get('sqlite_begin', 'DEFERRED')}")


_REMEDIES = {
    "sqlite": {
        "malformed": "; restore a backup, or rebuild it with `sqlite3 OLD .recover | sqlite3 NEW`",
        "not a database": "; this file is damaged or not a database, move it away or restore it",
        "locked": "; another process is writing, wait for it or stop it",
        "readonly": "; give yourself write permission on the file and its folder",
        "unable to open": "; check that the folder exists and can be written, or copy the "
        "workspace into a folder of your own",
        "disk I/O error": "; check free space, disk and mount, finished frames are kept",
        "full": "; free space on the disk and rerun the command, finished frames are kept",
    },
    "postgresql": {
        "password": "; put the password into ~/.pgpass or PGPASSWORD",
        "role": "; check the user in run.database of curate.toml",
        "does not exist": "; create it with `createdb`, or fix run.database of curate.toml",
        "permission denied": "; ask its owner for the rights to create and write tables",
        "read-only": "; this server is read-only, use its primary",
        "No space left": "; free space on the server and rerun the command, finished frames are "
        "kept",
        "connection": "; check that the server runs, and run.database of curate.toml; then rerun "
        "the command, finished frames are kept",
    },
}
