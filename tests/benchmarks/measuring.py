"""How a benchmark is measured: the best of several rounds, with what the report needs to know."""

import time
from collections.abc import Callable
from typing import Any

from pytest_benchmark.fixture import BenchmarkFixture

BUDGET_S = 1.0
"""Rounds of a benchmark go on for about this long."""

FEWEST_ROUNDS, MOST_ROUNDS = 3, 200
OURS = "curate"


def measure(
    benchmark: BenchmarkFixture,
    function: Callable[..., Any],
    *,
    group: str,
    name: str = OURS,
    amount: int,
    unit: str,
    setup: Callable[[], tuple[tuple, dict] | None] | None = None,
    rounds: int | None = None,
    target_s: float | None = None,
    figure: str = "ratio",
) -> Any:
    """Runs a function once to warm up, then in rounds; the report shows the best of them.

    Args:
        benchmark: the fixture of pytest-benchmark.
        function: the work.
        group: the table in which it stands.
        name: the line in that table; `OURS` is what the others are compared with.
        amount: how much work one call does.
        unit: of that amount, in the plural.
        setup: called before every call, outside the measured time; may return its arguments.
        rounds: how many; None derives them from the first call. 1 leaves out the warm-up.
        target_s: what issue or design ask of it.
        figure: "ratio" where the lines of a group do the same work, "rate" where they do not.

    Returns:
        The result of the function.
    """
    if rounds is None:
        args, kwargs = (setup() if setup else None) or ((), {})
        start = time.perf_counter()
        function(*args, **kwargs)
        seconds = time.perf_counter() - start
        # The first call pays for compilation; one more tells how long a round is.
        if seconds > BUDGET_S / MOST_ROUNDS and setup is None:
            start = time.perf_counter()
            function()
            seconds = time.perf_counter() - start
        rounds = round(min(max(BUDGET_S / max(seconds, 1e-9), FEWEST_ROUNDS), MOST_ROUNDS))
    benchmark.group = group
    benchmark.extra_info.update(
        name=name, amount=amount, unit=unit, target_s=target_s, figure=figure
    )
    return benchmark.pedantic(function, setup=setup, rounds=rounds)
