"""How a command shows that it is alive: a bar on a terminal, a line now and then in a log."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

Advance = Callable[[int, str], None]

QUIET_S = 2.0
LINE_EVERY_S = 15.0


class Progress(Protocol):
    """Shows the state of something long."""

    @contextmanager
    def track(self, what: str, total: int) -> Iterator[Advance]:
        """Yields a function that takes how much more is done and a word on how it goes."""
        ...


class TotalProgress(Protocol):
    """Takes how much is done in all, and of how much."""

    def __call__(self, done: int, total: int, note: str = "", /) -> None:
        """Shows it, with a word on how it goes."""
        ...


def as_total(advance: Advance) -> TotalProgress:
    """Moves `advance` for work that tells how much is done in all, not how much more."""
    before = 0

    def reach(done: int, _total: int, note: str = "") -> None:
        nonlocal before
        advance(done - before, note)
        before = done

    return reach


class Bar:
    """A bar with rate and time left on a terminal; lines on anything else, to standard error."""

    @contextmanager
    def track(self, what: str, total: int) -> Iterator[Advance]:
        """Yields a function that moves the bar."""
        with _bar(what, total) if sys.stderr.isatty() else _lines(what, total) as advance:
            yield advance


@contextmanager
def _bar(what: str, total: int) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as RichProgress

    with RichProgress(
        TextColumn("  {task.description:<12}"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        task = bar.add_task(what, total=total, note="")
        start, done = time.monotonic(), 0

        def advance(step: int, note: str) -> None:
            nonlocal done
            done += step
            bar.update(task, advance=step, note=f"{_rate(done, start)} {note}")

        yield advance


def _rate(done: int, start: float) -> str:
    """How many are done in a second."""
    return f"{done / max(time.monotonic() - start, 1e-9):.3g}/s"


@contextmanager
def _lines(what: str, total: int) -> Iterator[Advance]:
    start = last = time.monotonic()
    done = 0

    def advance(step: int, note: str) -> None:
        nonlocal last, done
        done += step
        now = time.monotonic()
        if now - start > QUIET_S and now - last > LINE_EVERY_S:
            last = now
            left = (now - start) * (total - done) / max(done, 1)
            rate = _rate(done, start)
            sys.stderr.write(f"  {what} {done}/{total}, {rate}, {left:.0f} s left {note}\n")
            sys.stderr.flush()

    yield advance
