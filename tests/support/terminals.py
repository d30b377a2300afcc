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
    """What a program printed in a terminal, complete once the terminal is closed."""

    text: str = ""

    @property
    def lines(self) -> list[str]:
        """The lines as they stand on the screen."""
        return self.text.replace("\r\n", "\n").splitlines()


@contextmanager
def terminal(
    monkeypatch: pytest.MonkeyPatch, columns: int, lines: int = TALL
) -> Iterator[Terminal]:
    """Make sys.stdin and sys.stdout a pseudo-terminal of this size until the end of the block."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
    for name in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    found, parts = Terminal(), []

    def drain() -> None:
        while True:
            try:
                part = os.read(master, 65536)
            except OSError:  # Linux reports the closed other end so
                return
            if not part:
                return
            parts.append(part)

    reader = threading.Thread(target=drain)
    reader.start()
    with (
        open(slave, "w", encoding="utf-8", closefd=False) as output,
        open(slave, encoding="utf-8", closefd=False) as given,
        monkeypatch.context() as patched,
    ):
        patched.setattr(sys, "stdout", output)
        patched.setattr(sys, "stdin", given)
        try:
            yield found
        finally:
            output.flush()
            os.close(slave)
            reader.join()
            os.close(master)
            found.text = b"".join(parts).decode()
