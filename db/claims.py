"""Claims: what one process works on, no other one touches, and who asks is told who has it.

A claim is held by the kernel (a lock on a file beside an SQLite database) or by the server (an
advisory lock of a PostgreSQL session). It thus ends with its process, however that ends, and
nothing stale is ever left behind.
"""

import os
import socket
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import Connection, Engine, text
from sqlalchemy.exc import DBAPIError

from curate.errors import DatabaseError

if TYPE_CHECKING:
    from io import TextIOWrapper

# The first of the two numbers of every advisory lock of curate: "cura" in ASCII.
_POSTGRES_CLASS = 0x63757261
_POSTGRES_OWNER = text("""
    SELECT coalesce(nullif(a.application_name, ''), 'database user ' || a.usename), a.backend_start
    FROM pg_locks AS l JOIN pg_stat_activity AS a ON a.pid = l.pid
    WHERE l.locktype = 'advisory' AND l.granted AND l.objsubid = 2 AND l.classid = :class
          AND l.objid = :key AND l.pid <> pg_backend_pid()
          AND l.database = (SELECT oid FROM pg_database WHERE datname = current_database())
    ORDER BY a.backend_start LIMIT 1
""")
# Who asks whose a claim is, or finds half of its own taken, holds it for a moment; that moment is
# waited out.
_TRIES, _PAUSE_S = 5, 0.01
LONGEST_NAME = 63  # bytes of an application's name that PostgreSQL keeps

Check = Callable[[], object]
"""Raises where a claim was lost."""


@dataclass(frozen=True)
class Resource:
    """Something that is claimed.

    Attributes:
        name: as the message calls it, e.g. "round 1".
        shared: whether others may hold a shared claim of it at the same time.
    """

    name: str
    shared: bool = False


def round_resources(number: int, policy: str | None = None) -> tuple[Resource, ...]:
    """What a stage claims: the whole round, or only what a policy makes of it.

    The policies of a round stand side by side, so their stages share the round, which no stage can
    then change under them.
    """
    if policy is None:
        return (Resource(f"round {number}"),)
    return (Resource(f"round {number}", shared=True), Resource(f"round {number} of {policy}"))


@contextmanager
def claimed(engine: Engine, resources: Sequence[Resource], purpose: str) -> Iterator[Check]:
    """Hold resources against every other process until the block ends.

    Yields:
        What raises where the claim was lost in the meantime, so that others may work on the same.

    Raises:
        DatabaseError: if another process has one of them; the message says which and since when.
    """
    owner = f"{purpose}, process {os.getpid()} on {socket.gethostname()}"
    checks: list[Check] = []
    with ExitStack() as held:
        if engine.dialect.name == "postgresql":
            connection = held.enter_context(_session(engine, owner))
            for resource in resources:
                _claim_session(connection, resource)
            checks = [partial(connection.execute, text("SELECT 1"))]
        elif engine.url.database:
            # Who opens the file by a link works on the same one.
            folder = Path(f"{os.path.realpath(engine.url.database)}-locks")
            checks = [held.enter_context(_claimed_file(folder, one, owner)) for one in resources]
        yield lambda: [check() for check in checks]


def one_at_a_time(connection: Connection, lock: int) -> None:
    """Wait for other transactions with this lock to end; SQLite's writers always do."""
    if connection.dialect.name == "postgresql":
        connection.execute(text(f"SELECT pg_advisory_xact_lock({lock})"))


@contextmanager
def _session(engine: Engine, owner: str) -> Iterator[Connection]:
    """A connection of its own, which ends with its claims."""
    connection = engine.connect().execution_options(isolation_level="AUTOCOMMIT")
    connection.detach()
    with connection:
        name = owner.encode()[:LONGEST_NAME].decode(errors="ignore")
        set_name = text("SELECT set_config('application_name', :name, false)")
        connection.execute(set_name, {"name": name})
        try:
            yield connection
        finally:
            # A server notices the end of a connection a little later. One that is lost has lost
            # its claims, too, and what was lost with it is told by whoever worked.
            with suppress(DBAPIError):
                if not connection.invalidated:
                    connection.execute(text("SELECT pg_advisory_unlock_all()"))


def _claim_session(connection: Connection, resource: Resource) -> None:
    place = {"class": _POSTGRES_CLASS, "key": zlib.crc32(resource.name.encode()) & 0x7FFFFFFF}
    function = f"pg_try_advisory_lock{'_shared' if resource.shared else ''}"
    take = text(f"SELECT {function}(:class, :key)")
    for _ in range(_TRIES):
        if connection.execute(take, place).scalar_one():
            return
        time.sleep(_PAUSE_S)
    found = connection.execute(_POSTGRES_OWNER, place).first()
    raise _conflict_message(
        resource, f"{found[0]}, since {found[1]:%Y-%m-%d %H:%M:%S}" if found else ""
    )


@contextmanager
def _claimed_file(folder: Path, resource: Resource, owner: str) -> Iterator[Check]:
    import fcntl

    path = folder / "".join(c if c.isalnum() else "-" for c in resource.name)
    mode = fcntl.LOCK_SH if resource.shared else fcntl.LOCK_EX
    with _opened(path) as file:
        if not _try_lock(file, mode):
            raise _conflict_message(resource, _file_owner(path))
        if not resource.shared:
            file.truncate(0)
            file.write(f"{owner}, since {datetime.now().astimezone():%Y-%m-%d %H:%M:%S}")
            file.flush()
        yield partial(_check_lock_file, path, file)


def _check_lock_file(path: Path, file: "TextIOWrapper") -> None:
    """Raise DatabaseError if the file that is locked is not the one that others would try."""
    try:
        same = os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        same = False
    if not same:
        raise DatabaseError(
            f"{path}: was moved or deleted while this command held it, so another one may work on "
            "the same; run the command again, finished frames are kept"
        )


def _opened(path: Path) -> "TextIOWrapper":
    try:
        path.parent.mkdir(exist_ok=True)
        return path.open("a+", encoding="utf-8")
    except OSError as error:
        raise DatabaseError(
            f"{path}: {error.strerror}; give yourself write permission on the database's folder"
        ) from error


def _try_lock(file: "TextIOWrapper", mode: int) -> bool:
    import fcntl

    for _ in range(_TRIES):
        try:
            fcntl.flock(file, mode | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_PAUSE_S)
        else:
            return True
    return False


def _file_owner(path: Path) -> str:
    """Who holds a file, or one of those that share it: each of them holds another one alone."""
    import fcntl

    for other in (path, *sorted(path.parent.glob(f"{path.name}-*"))):
        with other.open(encoding="utf-8") as file:
            if not _try_lock(file, fcntl.LOCK_SH):
                return file.read()
    return ""


def _conflict_message(resource: Resource, owner: str) -> DatabaseError:
    return DatabaseError(
        f"{resource.name} is being worked on by {owner or 'another process'}; "
        "wait until it has ended, or end it"
    )
