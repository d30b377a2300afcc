"""Commands forked from a process that has loaded everything, so that a kill hits their work."""

import contextlib
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path

from support.rounds import run_workspace


class CommandForks:
    """A process that forks a child for every command; it never opens a database under test."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, child_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(child_end,))
        self._process.start()
        child_end.close()
        self._connection.recv()

    def start(self, arguments: Sequence[object], environment: Mapping[str, str]) -> int:
        """Start `curate ARGUMENTS` and return the key of its process."""
        self._connection.send((list(map(str, arguments)), dict(environment)))
        return self._connection.recv()

    def end(self, pid: int) -> int:
        """Wait for a command and return its exit code, -9 if it was killed."""
        self._connection.send(pid)
        return self._connection.recv()

    def close(self) -> None:
        """End the process."""
        self._connection.close()
        self._process.join()


def _serve(connection: Connection) -> None:
    _warm_up()
    connection.send("ready")
    with contextlib.suppress(EOFError):
        while True:
            message = connection.recv()
            if isinstance(message, int):
                connection.send(os.waitstatus_to_exitcode(os.waitpid(message, 0)[1]))
            elif pid := os.fork():
                connection.send(pid)
            else:
                _run_command(*message)


def _warm_up() -> None:
    """Run all stages once, so that modules are loaded and kernels compiled."""
    from pipelines.workspace.config import make_config
    from pipelines.workspace.setup import initialise
    from support.toys import toy_document, write_toy_kitti

    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        write_toy_kitti(home / "kitti", frames=3, val=1)
        (home / "detector.txt").write_text("")
        document = toy_document(home / "kitti", home / "detector.txt")
        workspace = initialise(home / "work", make_config(document, "test"), "0.5", "")
        run_workspace(workspace)
        workspace.database.close()


def _run_command(arguments: Sequence[str], environment: Mapping[str, str]) -> None:
    """Turn this process into the command, without a parent that listens."""
    from pipelines.cli import main

    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    os.environ.update(environment)
    sys.argv = ["curate", *arguments]
    code = 1
    try:
        main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    finally:
        os._exit(code)
