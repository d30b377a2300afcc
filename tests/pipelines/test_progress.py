"""How progress is told."""

from pipelines.progress import reaching


def test_totals_become_steps() -> None:
    """Whoever tells how much is done in all moves a bar that takes how much more is done."""
    moves: list[tuple[int, str]] = []
    reach = reaching(lambda step, note: moves.append((step, note)))
    reach(3, 10)
    reach(3, 10, "waits")
    reach(10, 10, "done")
    assert moves == [(3, ""), (0, "waits"), (7, "done")]
