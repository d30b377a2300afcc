"""Backups of a database, made before its schema is migrated."""

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
    """Copy a database that has an older schema.

    An SQLite file is copied into its own folder. A PostgreSQL database is dumped into `folder` if
    pg_dump is installed. Otherwise a warning says that there is no copy: the migration is a single
    transaction, and servers usually have backups of their own.

    Args:
        url: URL of the database.
        revision: revision of its schema before the migration.
        folder: folder for dumps; None if there is none.

    Raises:
        DatabaseError: if the disk is full, the folder is not writable, or pg_dump fails.
    """
    if url.get_backend_name() == "sqlite":
        path = Path(str(url.database))
        copy = path.with_name(f"{path.name}.schema-{revision}.backup")
        _copy_file(path, copy)
        _log.warning(
            "%s: migrating schema %s; a copy of the old database is kept as %s",
            path,
            revision,
            copy,
        )
        return
    name = url.set(drivername="postgresql").render_as_string()
    if folder is None or shutil.which("pg_dump") is None:
        _log.warning(
            "%s: migrating schema %s without a backup, because pg_dump is not installed here", name,
            revision,
        )  # fmt: skip
        return
    copy = folder / f"curate.schema-{revision}.dump"
    _dump(url, name, copy)
    _log.warning(
        "%s: migrating schema %s; a copy of the old database for pg_restore is kept as %s", name,
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
    # The password is passed in the environment: other users can read a command line.
    secret = {"PGPASSWORD": url.password} if url.password else {}
    address = url.set(drivername="postgresql", password=None).render_as_string()
    command = ["pg_dump", "--format=custom", f"--file={partial}", f"--dbname={address}"]
    try:
        result = subprocess.run(  # noqa: S603 - a fixed program, the URL is one argument
            command, env=os.environ | secret, capture_output=True, text=True, check=False
        )
        if result.returncode:
            raise _pg_dump_failure(name, " ".join(result.stderr.split()))
        partial.replace(backup)
    except OSError as error:
        raise _failure_message(name, str(error), backup) from error
    finally:
        partial.unlink(missing_ok=True)


def _failure_message(name: str, reason: str, backup: Path) -> DatabaseError:
    return DatabaseError(
        f"{name}: cannot be copied before its schema is migrated: {reason}; free disk space for "
        f"{backup.name}, give yourself write permission on its folder, and rerun the command"
    )


def _pg_dump_failure(name: str, reason: str) -> DatabaseError:
    remedy = next((each for sign, each in _REMEDIES.items() if sign in reason), "fix that")
    return DatabaseError(
        f"{name}: cannot be copied before its schema is migrated: {reason}; {remedy}, and rerun "
        "the command"
    )


_REMEDIES = {
    "version mismatch": "install the pg_dump of the server's version and put it first in PATH",
    "permission denied": "have the owner of the database run a curate command once",
    "No space left": "free disk space in the workspace",
}
