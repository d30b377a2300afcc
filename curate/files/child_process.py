"""Attempts to read a file in a child process, because libraries in C++ may abort on damaged files.

An abort ends the whole process, whatever the caller catches. So a file is read once by a child
process before this process reads it. Files that the child survived are remembered in this process,
and for later commands as empty files in the user's cache folder, named by a hash of path, size,
modification time, reader and version of the library.

The child is started for the first file, imports only what the readers need, and is kept for further
files; after an abort or a fork, the next file gets a new one.
"""

import atexit
import hashlib
import json
import os
import pickle
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from threading import Lock
from typing import IO, Any

from curate.errors import CurateError, DataError

_MIN_SECONDS = 600.0
_MIN_BYTES_PER_SECOND = 1 << 20
_DONE = b"\0curate: survived\0"
_KEPT_OUTPUT_BYTES = 4096
_START = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
_SERVE = "from curate.files.child_process import serve; serve()"


def require_survival(
    path: Path,
    library: str,
    read: Callable[..., object],
    *arguments: Any,
    error: type[CurateError] = DataError,
) -> None:
    """Check in a child process that a library can read a file without ending the process.

    Exceptions of `read` are ignored here: this process gets them when it reads the file itself. So
    does a missing file.

    Args:
        path: the file.
        library: name of the distribution that reads it, for the message.
        read: a function at the top level of a module; called as `read(path, *arguments)`.
        *arguments: can be pickled. The file counts as checked for any arguments.
        error: class of the error.

    Raises:
        CurateError: `error`, if the child was killed by a signal or needs too long.
    """
    try:
        key, seconds = _fingerprint(path, library, read), _seconds(path)
    except OSError:
        return
    if key in _survived or _is_recorded(key):
        return
    problem = _child.attempt(partial(read, path, *arguments), seconds)
    if problem is not None:
        raise error(f"{path}: damaged: {library} {problem}; write the file again")
    _survived.add(key)
    _record(key)


def serve() -> None:
    """Read the files that the parent process requests, until it ends."""
    import faulthandler
    import resource

    faulthandler.disable()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError, ValueError):  # the system may not allow a limit
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        resource.setrlimit(resource.RLIMIT_AS, (memory, resource.RLIM_INFINITY))
    requests = sys.stdin.buffer
    while True:
        try:
            attempt = pickle.load(requests)  # noqa: S301 - from the parent process
        except EOFError:
            return
        with suppress(BaseException):  # the parent gets the same error when it reads the file
            attempt()
        del attempt
        os.write(1, _DONE)


class _Child:
    """A child process that is started for the first file and replaced after its end."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = Lock()

    def attempt(self, read: Callable[[], object], seconds: float) -> str | None:
        """Return None if the child survives reading a file, else what happened to it."""
        with self._lock:
            if self._process is None or self._process.poll() is not None:
                self._end()
                self._process = _start()
            try:
                output = _request(self._process, pickle.dumps(read), seconds)
            except BaseException:
                self._end()
                raise
            if output is not None and output.endswith(_DONE):
                return None
            code = self._end(wait=output is not None)
            if output is None:
                return f"has not read it within {seconds:.0f} s"
            return f"ends the process ({_cause(code, output)})"

    def close(self) -> None:
        """End the child."""
        self._end()

    def forget(self) -> None:
        """Leave the child to the process that this one was forked from."""
        self._process, self._lock = None, Lock()

    def _end(self, *, wait: bool = False) -> int:
        """Return the exit code of the child, which may be about to end by itself."""
        process, self._process = self._process, None
        if process is None:
            return 0
        if wait:
            with suppress(subprocess.TimeoutExpired):
                process.wait(5)
        process.kill()
        with suppress(BrokenPipeError):
            process.communicate()
        return process.returncode


def _start() -> "subprocess.Popen[bytes]":
    search_path = json.dumps([str(Path(entry).absolute()) for entry in sys.path])
    return subprocess.Popen(  # noqa: S603 - this program
        [sys.executable, "-c", _START + _SERVE, search_path],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )


def _request(process: "subprocess.Popen[bytes]", request: bytes, seconds: float) -> bytes | None:
    """Send a request and return what `_output` returns."""
    pipes = (process.stdin, process.stdout)
    if pipes[0] is None or pipes[1] is None:
        return b""
    try:
        pipes[0].write(request)
        pipes[0].flush()
    except BrokenPipeError:  # the child has just ended
        return b""
    return _output(pipes[1], seconds)


def _output(pipe: IO[bytes], seconds: float) -> bytes | None:
    """Return what the child wrote until it was done or ended; None if it takes too long."""
    output, deadline = b"", time.monotonic() + seconds
    while not output.endswith(_DONE):
        ready, _, _ = select.select([pipe], [], [], max(deadline - time.monotonic(), 0))
        if not ready:
            return None
        part = os.read(pipe.fileno(), 1 << 16)
        if not part:
            break
        output = (output + part)[-_KEPT_OUTPUT_BYTES:]
    return output


def _cause(code: int, output: bytes) -> str:
    """Return name of the signal that ended the child, and the last line that it wrote."""
    lines = [" ".join(line.split()) for line in output.decode(errors="replace").splitlines()]
    said = [line for line in lines if line.isprintable() and line]
    ended = signal.Signals(-code).name if -code in set(signal.Signals) else f"exit code {code}"
    return ": ".join([ended, *(line.removeprefix("what(): ")[:200] for line in said[-1:])])


def _fingerprint(path: Path, library: str, read: Callable[..., object]) -> str:
    """Return a hash of everything that decides whether reading a file ends the process."""
    state = path.stat()
    try:
        installed = version(library)
    except PackageNotFoundError:
        installed = ""
    identity = (
        str(path.absolute()), state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns,
        read.__module__, read.__qualname__, library, installed,
    )  # fmt: skip
    return hashlib.sha256(repr(identity).encode()).hexdigest()


def _seconds(path: Path) -> float:
    return _MIN_SECONDS + path.stat().st_size / _MIN_BYTES_PER_SECOND


def _is_recorded(key: str) -> bool:
    with suppress(OSError, RuntimeError):
        return (_records() / key).exists()
    return False


def _record(key: str) -> None:
    """Remember a file for later commands, if the cache folder can be written."""
    with suppress(OSError, RuntimeError):
        _records().mkdir(parents=True, exist_ok=True)
        (_records() / key).touch()


def _records() -> Path:
    cache = os.environ.get("XDG_CACHE_HOME")
    return (Path(cache) if cache else Path.home() / ".cache") / "curate" / "read-safely"


_child = _Child()
_survived: set[str] = set()
atexit.register(_child.close)
os.register_at_fork(after_in_child=_child.forget)
