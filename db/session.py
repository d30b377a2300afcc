"""Opening a database: pragmas, migrations, and errors in our own words."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, Select, create_engine, event, inspect, text
from sqlalchemy.exc import DBAPIError, NoSuchModuleError

from curate.errors import ConfigError, DatabaseError, LeakageError, joined_lines
from db import bulk
from db.addresses import parse_url
from db.backups import back_up
from db.claims import Check, claimed, one_at_a_time, round_resources
from db.lock_holders import holders
from db.models import Base
from db.views import create_views, drop_views, refresh_views, views_are_current

# A writer that finds another one waits this long before it gives up.
BUSY_TIMEOUT_MS = 30_000
_MIGRATIONS = Path(__file__).parent / "migrations"
# By the names of their files: to open a database of this schema does not need alembic, which takes
# as long to import as SQLAlchemy.
REVISIONS = sorted(path.stem.partition("_")[0] for path in _MIGRATIONS.glob("versions/*.py"))
# On a server two processes may find an old schema at once; this number of theirs is one lock.
_MIGRATION_LOCK = 0x637572617465  # "curate" in ASCII


class Database:
    """A migrated database behind one engine.

    Args:
        url: an SQLAlchemy URL, e.g. "sqlite:////data/run/curate.db", or
            "postgresql://user@host/curate", which psycopg 3 answers.
        backups: folder for a copy of a server's database before its schema is migrated.

    Raises:
        ConfigError: the URL is none, or its driver is not installed.
        DatabaseError: it cannot be opened, is damaged, or a newer curate has written it.
    """

    def __init__(self, url: str | URL, backups: Path | None = None) -> None:
        self.url = parse_url(url) if isinstance(url, str) else url
        self.engine = _engine(self.url)
        self._claims: list[Check] = []
        with ExitStack() as failed:
            failed.callback(self.close)
            with self._translate_errors():
                self._migrate(backups)
            failed.pop_all()

    @property
    def name(self) -> str:
        """The database as messages call it: a path, or a URL without its password."""
        if self.engine.dialect.name == "sqlite":
            return str(self.url.database)
        return self.url.set(drivername=self.url.get_backend_name()).render_as_string()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection for queries."""
        with self._translate_errors(), self.engine.connect() as connection:
            yield connection

    def rows(self, query: Select[Any]) -> Sequence[bulk.Row]:
        """Return all rows of a query, see `db.bulk.select`."""
        with self.reading() as connection:
            return bulk.select(connection, query)

    @contextmanager
    def writing(self, *, keys_known: bool = False) -> Iterator[Connection]:
        """One transaction: all of it is kept, or nothing.

        Args:
            keys_known: that the rows which others refer to were read under a claim, so SQLite need
                not look each of them up, nor delete what refers to deleted rows.

        Raises:
            DatabaseError: a claim was lost, so that others may write the same; nothing is written.
        """
        writer = self.engine.execution_options(
            sqlite_begin="IMMEDIATE", sqlite_foreign_keys=not keys_known
        )
        with self._translate_errors():
            for still_held in self._claims:
                still_held()
            with writer.begin() as connection:
                yield connection

    @contextmanager
    def claiming_round(self, number: int, policy: str | None, purpose: str) -> Iterator[None]:
        """Keep every other process off a round, or off what a policy makes of it.

        Raises:
            DatabaseError: if another process works on it; the message says who.
        """
        resources = round_resources(number, policy)
        with ExitStack() as held:
            with self._translate_errors():
                still_held = held.enter_context(claimed(self.engine, resources, purpose))
            self._claims.append(still_held)
            held.callback(self._claims.remove, still_held)
            yield

    def close(self) -> None:
        """Return every connection back."""
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
        self._write_ahead()
        if views_current:
            return
        with self.writing() as connection:
            one_at_a_time(connection, _MIGRATION_LOCK)
            # Whoever had the lock before may have migrated it: its copy is of the older schema,
            # and one that is made now would take its place.
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
        """Let readers of an SQLite file go on beside a writer; the file remembers it."""
        if self.engine.dialect.name == "sqlite":
            with closing(self.engine.raw_connection()) as connection:
                connection.cursor().execute("PRAGMA journal_mode = WAL")

    def _require_tables(self, connection: Connection) -> None:
        """Raise DatabaseError if somebody has dropped a table of this schema."""
        missing = sorted(set(Base.metadata.tables) - set(inspect(connection).get_table_names()))
        if missing:
            raise DatabaseError(
                f"{self.name}: has no table {', '.join(missing)}; restore a backup of it"
            )

    def _check_tables(self, connection: Connection) -> None:
        """Raise DatabaseError if a database without a schema of ours has tables.

        A server's database may hold others beside ours, a file is for curate alone.
        """
        found = set(inspect(connection).get_table_names()) - {"alembic_version"}
        if self.engine.dialect.name != "sqlite":
            found &= set(Base.metadata.tables)
        if found:
            raise DatabaseError(
                f"{self.name}: has a table {min(found)} but no schema of curate in table "
                "alembic_version: move it away if it is another program's, restore a backup if not"
            )

    def _revision(self, connection: Connection) -> str | None:
        """Of the schema; None for an empty database, DatabaseError where it is unknown here."""
        if not inspect(connection).has_table("alembic_version"):
            return None
        found = connection.execute(text("SELECT version_num FROM alembic_version")).scalars().all()
        if len(found) > 1:  # which no curate writes
            raise DatabaseError(
                f"{self.name}: table alembic_version names several schemas; restore a backup"
            )
        if found and found[0] not in REVISIONS:
            raise DatabaseError(
                f"{self.name}: written by a newer curate (schema {found[0]}); update curate"
            )
        return str(found[0]) if found else None

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        """Turn the driver's errors into one line that names the database and the remedy."""
        try:
            yield
        except DBAPIError as error:
            raise self._translated(error.orig or error) from error
        except self.engine.dialect.loaded_dbapi.Error as error:
            # The bulk paths speak to the driver itself.
            raise self._translated(error) from error

    def _translated(self, error: BaseException) -> DatabaseError | LeakageError:
        message = joined_lines(error)
        if "ground truth of an unlabeled frame" in message:
            return LeakageError(f"{self.name}: {message} must not be stored")
        return DatabaseError(f"{self.name}: {message}{self._remedy(message)}")

    def _remedy(self, message: str) -> str:
        backend = self.engine.dialect.name
        if backend == "sqlite" and "locked" in message:
            writing = holders(Path(str(self.url.database)))
            if writing:
                return (
                    f"; waited {BUSY_TIMEOUT_MS / 1000:g} s for {', '.join(writing)}, which is "
                    "writing: wait for it or end it, then run the command again"
                )
        return next((each for sign, each in _REMEDIES[backend].items() if sign in message), "")


def _upgrade(connection: Connection) -> None:
    """Run the migrations that the connection's database has not seen yet."""
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(_MIGRATIONS))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


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
    if engine.dialect.name not in _REMEDIES:
        known = " and ".join(_REMEDIES)
        raise ConfigError(f"database {url!r}: curate keeps its tables in {known} only")
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _set_pragmas)
        event.listen(engine, "begin", _begin)
    else:
        event.listen(engine, "connect", _begin_immediate)
    return engine


def _begin_immediate(connection: Any, _record: Any) -> None:
    # A server that compiles a question first takes longer for it than for most answers.
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
    # Taking the write lock at once lets a second writer wait instead of failing half way.
    options = connection.get_execution_options()
    # Within a transaction this one has no effect.
    checked = "ON" if options.get("sqlite_foreign_keys", True) else "OFF"
    connection.exec_driver_sql(f"PRAGMA foreign_keys = {checked}")
    connection.exec_driver_sql(f"BEGIN {options.get('sqlite_begin', 'DEFERRED')}")


_REMEDIES = {
    "sqlite": {
        "malformed": "; restore a backup, or rebuild it with `sqlite3 OLD .recover | sqlite3 NEW`",
        "not a database": "; this file is damaged or of another kind, move it away or restore it",
        "locked": "; another process is writing, wait for it or end it",
        "readonly": "; give yourself write permission on the file and its folder",
        "unable to open": "; check that the folder exists and can be written",
        "disk I/O error": "; check the disk and its mount, finished frames are kept",
        "full": "; free space on the disk and run the command again, finished frames are kept",
    },
    "postgresql": {
        "password": "; put the password into ~/.pgpass or PGPASSWORD",
        "role": "; check the user in run.database of curate.toml",
        "does not exist": "; make it with `createdb`, or mend run.database of curate.toml",
        "permission denied": "; let its owner grant you the rights to create and write tables",
        "read-only": "; this server only answers, write to its primary",
        "No space left": "; free space on the server and run the command again, finished frames "
        "are kept",
        "connection": "; check that the server runs, and run.database of curate.toml; then run the "
        "command again, finished frames are kept",
    },
}
