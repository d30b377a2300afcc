"""Claims, which keep two processes from working on the same round.

A claim is a lock of the kernel on a file beside an SQLite database, or an advisory lock of a
PostgreSQL session. Either ends with its process, even if that crashes, so a claim is never stale.

A stage of frames (predict, repredict, score) claims its round alone. A stage that works for one
policy (solve, export, train-round) shares the round with the stages of other policies, and claims
the round of its policy alone. Example with the policies pspsl and st3d of round 1:

    command                     "round 1"   "round 1 of pspsl"   "round 1 of st3d"
    curate solve (pspsl)        shared      exclusive
    curate export (st3d)        shared                           exclusive      runs beside it
    curate solve (pspsl) again  shared      taken                               rejected
    curate predict              taken                                           rejected

The last command needs "round 1" exclusively, so it has to wait until both policies are done. A
rejected process reports who holds the claim and since when. A shared lock file holds no owner's
name, as several processes share it; `_file_owner` finds one in the files of the policies.
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

# PostgreSQL identifies an advisory lock by two numbers; curate's first one is "cura" in ASCII.
_POSTGRES_CLASS = 0x63757261
_POSTGRES_OWNER = text("""
    SELECT coalesce(nullif(a.application_name, ''), 'database user ' || a.usename), a.backend_start
    FROM pg_locks AS l JOIN pg_stat_activity AS a ON a.pid = l.pid
    WHERE l.locktype = 'advisory' AND l.granted AND l.objsubid = 2 AND l.classid = :class
          AND l.objid = :key AND l.pid <> pg_backend_pid()
          AND l.database = (SELECT oid FROM pg_database WHERE datname = current_database())
    ORDER BY a.backend_start LIMIT 1
""")
# A process that looks up the owner of a claim holds its lock for a moment, and so does one that
# gets the first of its two claims but not the second. A few tries outlast such moments.
_TRIES, _PAUSE_S = 5, 0.01
LONGEST_NAME = 63  # bytes: PostgreSQL cuts a longer application name

Check = Callable[[], object]
"""A function that raises an error if a claim was lost."""


@dataclass(frozen=True)
class Resource:
    """Something that a process can claim.

    Attributes:
        name: its name in messages, e.g. "round 1".
        shared: whether other processes may hold shared claims on it at the same time.
    """

    name: str
    shared: bool = False


def round_resources(number: int, policy: str | None = None) -> tuple[Resource, ...]:
    """Return what a stage claims: the whole round, or the round of one policy.

    Stages of different policies may run at the same time. They share the round, so that no stage
    can change its predictions and evidence meanwhile.
    """
    if policy is None:
        return (Resource(f"round {number}"),)
    return (Resource(f"round {number}", shared=True), Resource(f"round {number} of {policy}"))


@contextmanager
def claimed(engine: Engine, resources: Sequence[Resource], purpose: str) -> Iterator[Check]:
    """Claim resources until the block ends.

    Yields:
        A function that raises DatabaseError if a claim was lost meanwhile, e.g. because its file
        was deleted. Another process may then work on the same resource.

    Raises:
        DatabaseError: if another process holds one of them; the message says which process, and
            since when.
    """
    owner = f"{purpose}, process {os.getpid()} on {socket.gethostname()}"
    checks: list[Check] = []
    with ExitStack() as stack:
        if engine.dialect.name == "postgresql":
            connection = stack.enter_context(_session(engine, owner))
            for resource in resources:
                _claim_session(connection, resource)
            checks = [partial(connection.execute, text("SELECT 1"))]
        elif engine.url.database:
            # A process may open the same file by a link.
            folder = Path(f"{os.path.realpath(engine.url.database)}-locks")
            checks = [stack.enter_context(_claimed_file(folder, each, owner)) for each in resources]
        yield lambda: [check() for check in checks]


def wait_for_transactions(connection: Connection, lock: int) -> None:
    """Wait until other transactions with this lock have ended.

    On SQLite this does nothing: a writing transaction waits for all others anyway.
    """
    if connection.dialect.name == "postgresql":
        connection.execute(text(f"SELECT pg_advisory_xact_lock({lock})"))


@contextmanager
def _session(engine: Engine, owner: str) -> Iterator[Connection]:
    """Yield a connection outside the pool; closing it ends its claims."""
    connection = engine.connect().execution_options(isolation_level="AUTOCOMMIT")
    connection.detach()
    with connection:
        name = owner.encode()[:LONGEST_NAME].decode(errors="ignore")
        set_name = text("SELECT set_config('application_name', :name, false)")
        connection.execute(set_name, {"name": name})
        try:
            yield connection
        finally:
            # Unlock explicitly: a server notices the end of a connection a little later. A lost
            # connection has lost its claims already, and the caller's check reports it.
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
    """Raise DatabaseError if the locked file is no longer the one that other processes open."""
    try:
        same = os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        same = False
    if not same:
        raise DatabaseError(
            f"{path}: was moved or deleted while this command held a lock on it, so another "
            "process may work on the same data; rerun the command, finished frames are kept"
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
    """Return the owner of a lock file as its text describes it; "" if none is found.

    A shared file has several owners. Each of them also holds the file of its policy exclusively,
    and that one has the owner's name.
    """
    import fcntl

    for other in (path, *sorted(path.parent.glob(f"{path.name}-*"))):
        with other.open(encoding="utf-8") as file:
            if not _try_lock(file, fcntl.LOCK_SH):
                return file.read()
    return ""


def _conflict_message(resource: Resource, owner: str) -> DatabaseError:
    return DatabaseError(
        f"{resource.name} is being worked on by {owner or 'another process'}; "
        "wait until it has ended, or stop it"
    )
