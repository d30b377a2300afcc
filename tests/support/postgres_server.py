"""A PostgreSQL server for the test run, with its own data folder and socket."""

import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

TEMPLATE = "curate_template"
_PROGRAMS = ("initdb", "postgres")
_LONGEST_START_S = 60
# The data is not needed after the test run, so nothing has to be flushed to disk.
_SETTINGS = ("fsync=off", "synchronous_commit=off", "full_page_writes=off", "listen_addresses=")


def unavailable() -> str | None:
    """Return why no server can be started here, or None if one can."""
    if find_spec("psycopg") is None:
        return "psycopg is not installed: pip install 'curate-pseudo-labels[postgres]'"
    if _binaries() is None:
        return "no PostgreSQL binaries (initdb, postgres) in PATH or /usr/lib/postgresql"
    if os.geteuid() == 0 and _account() is None:
        return "PostgreSQL does not run as root, and there is no account postgres or nobody"
    return None


class PostgresServer:
    """A running server that creates databases."""

    def __init__(self, socket_folder: Path) -> None:
        self._folder = socket_folder
        self._drawn = 0

    def url(self, name: str) -> str:
        """Return the URL of a database, whether it exists or not."""
        return f"postgresql+psycopg://curate@/{name}?host={self._folder}"

    def execute(self, statement: str, database: str = "postgres") -> None:
        """Run a statement outside any transaction."""
        import psycopg

        with psycopg.connect(
            host=str(self._folder), user="curate", dbname=database, autocommit=True
        ) as connection:
            connection.execute(statement)

    def new_database(self, template: str = "template1") -> str:
        """Return the URL of a new database, a copy of the template."""
        self._drawn += 1
        name = f"test_{self._drawn}"
        self.execute(f"CREATE DATABASE {name} TEMPLATE {template}")
        return self.url(name)


@contextmanager
def running_server() -> Iterator[PostgresServer]:
    """Start a server; at the end stop it and remove its files."""
    binaries, account = _binaries(), _account()
    assert binaries is not None
    # A socket path has about a hundred characters at most, and pytest's folders can exceed that.
    folder = Path(tempfile.mkdtemp(prefix="curate-pg-"))
    try:
        if account is not None:
            shutil.chown(folder, account)
        initialise = ["-D", folder / "data", "-U", "curate", "-A", "trust", "-E", "UTF8", "-N"]
        subprocess.run(
            [binaries / "initdb", *initialise, "--locale=C"],
            check=True, user=account, stdout=subprocess.DEVNULL, cwd=folder,
        )  # fmt: skip
        settings = [part for setting in _SETTINGS for part in ("-c", setting)]
        with (folder / "log").open("wb") as log:
            server = subprocess.Popen(
                [binaries / "postgres", "-D", folder / "data", "-k", folder, *settings],
                user=account, stdout=log, stderr=log, cwd=folder,
            )  # fmt: skip
        try:
            found = PostgresServer(folder)
            _wait_for(found, server, folder / "log")
            yield found
        finally:
            # Fast shutdown: do not wait for connections that tests left open.
            server.send_signal(signal.SIGINT)
            server.wait()
    finally:
        shutil.rmtree(folder)


def _wait_for(found: PostgresServer, server: subprocess.Popen, log: Path) -> None:
    import psycopg

    end = time.monotonic() + _LONGEST_START_S
    while True:
        try:
            found.execute("SELECT 1")
        except psycopg.OperationalError:
            if server.poll() is not None or time.monotonic() > end:
                raise RuntimeError(log.read_text()) from None
            time.sleep(0.05)
        else:
            return


def _binaries() -> Path | None:
    """Return the folder of the newest installed server."""
    on_path = shutil.which("initdb")
    folders = [Path(on_path).resolve().parent] if on_path else []
    installed = Path("/usr/lib/postgresql").glob("*/bin")
    folders += sorted(installed, key=lambda path: -int(path.parent.name.partition(".")[0]))
    complete = (path for path in folders if all((path / n).is_file() for n in _PROGRAMS))
    return next(complete, None)


def _account() -> str | None:
    """Return the account for the server if we are root, else None."""
    import pwd

    if os.geteuid() != 0:
        return None
    accounts = {entry.pw_name for entry in pwd.getpwall()}
    return next((name for name in ("postgres", "nobody") if name in accounts), None)
