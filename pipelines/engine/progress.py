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
        """Yield a function that takes how much more is done and a word on how it goes."""
        ...


class TotalProgress(Protocol):
    """Takes how much is done in all, and of how much."""

    def __call__(self, done: int, total: int, note: str = "", /) -> None:
        """Show it, with a word on how it goes."""
        ...


def as_total(advance: Advance) -> TotalProgress:
    """Move `advance` for work that tells how much is done in all, not how much more."""
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
        """Yield a function that moves the bar."""
        with _bar(what, total) if sys.stderr.isatty() else _lines(what, total) as advance:
            yield advance


class Pace:
    """How fast work is done, and when it will be finished.

    The first step is not counted: it loads models and compiles kernels, or counts what an earlier
    run had done, so it says nothing about those that follow. Until the second step ends, rate and
    time left are unknown.
    """

    def __init__(self, total: int) -> None:
        self.done = 0
        self._total = total
        self._warm_up = 0
        self._start = 0.0

    def advance(self, step: int) -> None:
        """Count finished work."""
        if step > 0 and self._warm_up == 0:
            self._warm_up, self._start = step, time.monotonic()
        self.done += step

    @property
    def rate(self) -> float | None:
        """How much is done in a second; None as long as nothing can be said."""
        measured, seconds = self.done - self._warm_up, time.monotonic() - self._start
        return measured / seconds if measured > 0 and seconds > 0 else None

    @property
    def seconds_left(self) -> float | None:
        """How long the rest takes; None as long as nothing can be said."""
        rate = self.rate
        return None if rate is None else (self._total - self.done) / rate

    def __str__(self) -> str:
        rate, left = self.rate, self.seconds_left
        if rate is None or left is None:
            return ""
        shown = f"{rate:.3g}" if rate < 100 else f"{rate:.0f}"  # 17300, not 1.73e+04
        return f"{shown}/s, {duration(left)} left"


def duration(seconds: float) -> str:
    """Return a duration in words: "0.2 s", "42 s", "3 min 20 s", "2 h 5 min"."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if not minutes:
        return f"{rest} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


@contextmanager
def _bar(what: str, total: int) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as RichProgress

    with RichProgress(
        TextColumn("  {task.description:<12}"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        task, pace = bar.add_task(what, total=total, note=""), Pace(total)

        def advance(step: int, note: str) -> None:
            pace.advance(step)
            bar.update(task, advance=step, note=" ".join(filter(None, (str(pace), note))))

        yield advance


@contextmanager
def _lines(what: str, total: int) -> Iterator[Advance]:
    start = last = time.monotonic()
    pace = Pace(total)

    def advance(step: int, note: str) -> None:
        nonlocal last
        pace.advance(step)
        now = time.monotonic()
        if now - start > QUIET_S and now - last > LINE_EVERY_S:
            last = now
            words = ", ".join(filter(None, (f"{what} {pace.done}/{total}", str(pace), note)))
            sys.stderr.write(f"  {words}\n")
            sys.stderr.flush()

    yield advance
