"""Program that runs a command for curate, and ends it with all its children when curate is gone.

It is started as `python supervisor.py PROGRAM ARGUMENT...` with a pipe as standard input. When the
pipe closes, because curate has closed it or was killed, the command gets SIGTERM and, if it is
still there after a while, SIGKILL. Processes that the command leaves behind are killed as well.
Only the standard library is imported, so that it starts in a few milliseconds.
"""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from threading import Thread

GRACE_S = 5.0


def main() -> None:
    """Run the command, and end as it ended."""
    try:
        command = subprocess.Popen(  # noqa: S603 - the user's own command, without a shell
            sys.argv[1:], stdin=subprocess.DEVNULL, start_new_session=True
        )
    except OSError as error:
        sys.exit(f"{sys.argv[1]} cannot be started: {error.strerror}")
    Thread(target=_end_with_the_pipe, args=(command,), daemon=True).start()
    code = command.wait()
    _send(signal.SIGKILL, command)
    if code < 0:
        with suppress(OSError):  # SIGKILL has its effect without it
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    sys.exit(code)


def _end_with_the_pipe(command: "subprocess.Popen[bytes]") -> None:
    while os.read(0, 1):
        pass
    _send(signal.SIGTERM, command)
    try:
        command.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        _send(signal.SIGKILL, command)


def _send(number: signal.Signals, command: "subprocess.Popen[bytes]") -> None:
    """Send a signal to the command and its children, which form a process group."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(command.pid, number)


if __name__ == "__main__":
    main()
