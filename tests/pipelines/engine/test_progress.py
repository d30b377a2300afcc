"""Progress lines without a terminal, and the conversion from totals to steps."""

from collections.abc import Callable

import pytest

from pipelines.engine import progress
from pipelines.engine.progress import as_total


def test_totals_become_steps() -> None:
    """A bar needs increments; the caller reports totals."""
    moves: list[tuple[int, str]] = []
    reach = as_total(lambda step, note: moves.append((step, note)))
    reach(3, 10)
    reach(3, 10, "waits")
    reach(10, 10, "done")
    assert moves == [(3, ""), (0, "waits"), (7, "done")]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Return a function that sets the time."""
    now = 0.0

    def at(seconds: float) -> None:
        nonlocal now
        now = seconds

    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    return at


def test_a_line_shows_throughput_time_left_and_failures(
    capsys: pytest.CaptureFixture, clock: Callable[[float], None]
) -> None:
    """One frame after 0 s, 41 after 20 s: 2 per second, 29.5 s left for the other 59."""
    with progress.Bar().track("predict", 100) as advance:
        advance(1, "")
        clock(20.0)
        advance(40, "3 failed")
        advance(1, "3 failed")
    assert capsys.readouterr().err == "  predict 41/100, 2/s, 30 s left, 3 failed\n"


def test_the_warm_up_of_the_first_frame_does_not_count(clock: Callable[[float], None]) -> None:
    """The first frame takes 30 s, then 2 per second; the second one gives the right time left."""
    pace = progress.Pace(101)
    assert pace.rate is None
    clock(30.0)
    pace.advance(1)
    assert pace.seconds_left is None
    for done in range(2, 101):
        clock(30.0 + (done - 1) / 2)
        pace.advance(1)
        assert pace.rate == pytest.approx(2.0)
        assert pace.seconds_left == pytest.approx((101 - done) / 2)


def test_steps_of_an_earlier_run_do_not_count(clock: Callable[[float], None]) -> None:
    """A training resumes at step 500 of 1000 and takes 10 s for 100 steps."""
    pace = progress.Pace(1000)
    pace.advance(500)
    clock(10.0)
    pace.advance(100)
    assert pace.seconds_left == pytest.approx(40.0)


@pytest.mark.parametrize(("done", "words"), [(1, "1/s"), (17_300, "17300/s")])
def test_a_high_rate_is_a_plain_number(
    clock: Callable[[float], None], done: int, words: str
) -> None:
    """A rate is never shown with an exponent."""
    pace = progress.Pace(done + 1)
    pace.advance(1)
    clock(1.0)
    pace.advance(done)
    assert str(pace) == f"{words}, 0.0 s left"


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.0, "0.0 s"),
        (0.23, "0.2 s"),
        (42.4, "42 s"),
        (59.7, "1 min 0 s"),
        (200.0, "3 min 20 s"),
        (7500, "2 h 5 min"),
    ],
)
def test_a_duration_is_rounded_to_what_matters(seconds: float, words: str) -> None:
    assert progress.duration(seconds) == words
