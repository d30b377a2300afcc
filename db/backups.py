"""Backups: a database as it is, before its schema is migrated."""

import logging
import os
import shutil
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

from sqlalchemy import URL

from curate.errors import DatabaseError

_log = logging.getLogger(__name__)


def back_up(url: URL, revision: str, folder: Path | None) -> None:
    """Copy a database of an older schema.

    An SQLite file is copied beside itself. A PostgreSQL database is dumped into `folder` where
    pg_dump is installed; where it is not, a warning says that there is no copy: the migration is
    one transaction, and servers have backups of their own.

    Args:
        url: of the database.
        revision: of its schema.
        folder: for dumps; None where there is none.

    Raises:
        DatabaseError: if there is no room for it, its folder cannot be written, or pg_dump refuses.
    """
    if url.get_backend_name() == "sqlite":
        path = Path(str(url.database))
        copy = path.with_name(f"{path.name}.schema-{revision}.backup")
        _copy_file(path, copy)
        _log.warning(
            "%s: schema %s is migrated; the old database is kept as %s", path, revision, copy
        )
        return
    name = url.set(drivername="postgresql").render_as_string()
    if folder is None or shutil.which("pg_dump") is None:
        _log.warning(
            "%s: schema %s is migrated without a copy, for pg_dump is not installed here", name,
            revision,
        )  # fmt: skip
        return
    copy = folder / f"curate.schema-{revision}.dump"
    _dump(url, name, copy)
    _log.warning(
        "%s: schema %s is migrated; the old database is kept as %s, for pg_restore", name,
        revision, copy,
    )  # fmt: skip


def _copy_file(path: Path, backup: Path) -> None:
    partial = backup.with_suffix(".partial")
    try:
        with closing(sqlite3.connect(path)) as old, closing(sqlite3.connect(partial)) as copy:
            old.backup(copy)
        partial.replace(backup)
    except (sqlite3.Error, OSError) as error:
        partial.unlink(missing_ok=True)
        raise _failure_message(str(path), str(error), backup) from error


def _dump(url: URL, name: str, backup: Path) -> None:
    partial = backup.with_suffix(".partial")
    # A password stands in the environment, where other users do not see it.
    secret = {"PGPASSWORD": url.password} if url.password else {}
    address = url.set(drivername="postgresql", password=None).render_as_string()
    command = ["pg_dump", "--format=custom", f"--file={partial}", f"--dbname={address}"]
    try:
        ended = subprocess.run(  # noqa: S603 - a fixed program, the URL is one argument
            command, env=os.environ | secret, capture_output=True, text=True, check=False
        )
        if ended.returncode:
            raise _pg_dump_failure(name, " ".join(ended.stderr.split()))
        partial.replace(backup)
    except OSError as error:
        raise _failure_message(name, str(error), backup) from error
    finally:
        partial.unlink(missing_ok=True)


def _failure_message(name: str, reason: str, backup: Path) -> DatabaseError:
    return DatabaseError(
        f"{name}: cannot be copied before its schema is migrated: {reason}; make room for "
        f"{backup.name}, let yourself write into its folder, and run the command again"
    )


def _pg_dump_failure(name: str, reason: str) -> DatabaseError:
    remedy = next((each for sign, each in _REMEDIES.items() if sign in reason), "mend that")
    return DatabaseError(
        f"{name}: cannot be copied before its schema is migrated: {reason}; {remedy}, and run the "
        "command again"
    )


_REMEDIES = {
    "version mismatch": "install the pg_dump of the server's version, before others in PATH",
    "permission denied": "let the database's owner run a command once",
    "No space left": "make room in the workspace",
}
