"""Progress of long work: a bar on a terminal, a line every few seconds in a log."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

Advance = Callable[[int, str], None]

QUIET_S = 2.0
LINE_EVERY_S = 15.0


class Progress(Protocol):
    """Shows the progress of long work."""

    @contextmanager
    def track(self, what: str, total: int) -> Iterator[Advance]:
        """Yield a function that takes the number of newly finished steps and a short note."""
        ...


class TotalProgress(Protocol):
    """A callback that takes the number of all finished steps."""

    def __call__(self, done: int, total: int, note: str = "", /) -> None:
        """Show that `done` of `total` steps are finished, with a short note."""
        ...


def as_total(advance: Advance) -> TotalProgress:
    """Return a callback for work that reports all finished steps, not the new ones."""
    before = 0

    def reach(done: int, _total: int, note: str = "") -> None:
        nonlocal before
        advance(done - before, note)
        before = done

    return reach


class Bar:
    """Progress on standard error: a bar with rate and time left on a terminal, else lines."""

    @contextmanager
    def track(self, what: str, total: int) -> Iterator[Advance]:
        """Yield a function that moves the bar."""
        with _bar(what, total) if sys.stderr.isatty() else _lines(what, total) as advance:
            yield advance


class Pace:
    """Rate and remaining time of work.

    The first step is not part of the rate: it includes loading models and compiling kernels, or it
    reports what an earlier run had done. Rate and remaining time are unknown until the second step.
    """

    def __init__(self, total: int) -> None:
        self.done = 0
        self._total = total
        self._warm_up = 0
        self._start = 0.0

    def advance(self, step: int) -> None:
        """Add newly finished steps."""
        if step > 0 and self._warm_up == 0:
            self._warm_up, self._start = step, time.monotonic()
        self.done += step

    @property
    def rate(self) -> float | None:
        """Steps per second; None if unknown."""
        measured, seconds = self.done - self._warm_up, time.monotonic() - self._start
        return measured / seconds if measured > 0 and seconds > 0 else None

    @property
    def seconds_left(self) -> float | None:
        """Estimated time until all steps are finished; None if unknown."""
        rate = self.rate
        return None if rate is None else (self._total - self.done) / rate

    def __str__(self) -> str:
        rate, left = self.rate, self.seconds_left
        if rate is None or left is None:
            return ""
        shown = f"{rate:.3g}" if rate < 100 else f"{rate:.0f}"  # 17300, not 1.73e+04
        return f"{shown}/s, {duration(left)} left"


def duration(seconds: float) -> str:
    """Return a duration as text: "0.2 s", "42 s", "3 min 20 s", "2 h 5 min"."""
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
