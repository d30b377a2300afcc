"""A pseudo-terminal of a given size as the standard input and output of this process."""

import fcntl
import os
import pty
import struct
import sys
import termios
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

TALL = 10_000
"""Lines of a terminal in which nothing needs a pager."""


@dataclass
class Terminal:
    """The output of a program in a terminal, complete once the terminal is closed."""

    text: str = ""

    @property
    def lines(self) -> list[str]:
        """Return the lines as they appear on the screen."""
        return self.text.replace("\r\n", "\n").splitlines()


@contextmanager
def open_terminal(columns: int, lines: int) -> Iterator[tuple[Terminal, int]]:
    """Open a terminal of this size; return its output and the file descriptor for a program."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
    found, parts = Terminal(), []

    def drain() -> None:
        while True:
            try:
                part = os.read(master, 65536)
            except OSError:  # Linux reports the closed other end as this error
                return
            if not part:
                return
            parts.append(part)

    reader = threading.Thread(target=drain)
    reader.start()
    try:
        yield found, slave
    finally:
        os.close(slave)
        reader.join()
        os.close(master)
        found.text = b"".join(parts).decode()


@contextmanager
def terminal(
    monkeypatch: pytest.MonkeyPatch, columns: int, lines: int = TALL
) -> Iterator[Terminal]:
    """Make sys.stdin and sys.stdout a pseudo-terminal of this size until the end of the block."""
    with open_terminal(columns, lines) as (found, slave), monkeypatch.context() as patched:
        for name in ("COLUMNS", "LINES", "FORCE_COLOR"):
            patched.delenv(name, raising=False)
        with (
            open(slave, "w", encoding="utf-8", closefd=False) as output,
            open(slave, encoding="utf-8", closefd=False) as given,
        ):
            patched.setattr(sys, "stdout", output)
            patched.setattr(sys, "stdin", given)
            yield found
