"""What a long sweep shows of itself where no terminal is, and how totals become steps."""

import pytest

from pipelines.engine import progress
from pipelines.engine.progress import as_total


def test_totals_become_steps() -> None:
    """Whoever tells how much is done in all moves a bar that takes how much more is done."""
    moves: list[tuple[int, str]] = []
    reach = as_total(lambda step, note: moves.append((step, note)))
    reach(3, 10)
    reach(3, 10, "waits")
    reach(10, 10, "done")
    assert moves == [(3, ""), (0, "waits"), (7, "done")]


def test_a_line_shows_throughput_time_left_and_failures(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """40 of 100 after 20 s: 2 a second, 30 s left."""
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with progress.Bar().track("predict", 100) as advance:
        advance(1, "")
        now = 20.0
        advance(39, "3 failed")
        advance(1, "3 failed")
    assert capsys.readouterr().err == "  predict 40/100, 2/s, 30 s left 3 failed\n"
