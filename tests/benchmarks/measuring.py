"""How a benchmark is measured: the best of several rounds, and what the report needs.

Work within one process is measured in CPU seconds of that process. On an idle machine these equal
wall-clock seconds. On a busy one, the wall clock also counts the time of other processes, which
affects long calls more than short ones: ratios would favour the faster side.
"""

import resource
import time
from collections.abc import Callable
from typing import Any

from pytest_benchmark.fixture import BenchmarkFixture

BUDGET_S = 1.0
"""Rounds of a benchmark go on for about this long."""

FEWEST_ROUNDS, MOST_ROUNDS = 5, 200
OURS = "curate"


cpu_seconds = time.process_time
"""Timer of work within this process."""


def cpu_seconds_of_children() -> float:
    """Return the CPU time of processes that this one has started and waited for."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


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
    """Call a function once to warm up, then in rounds; the report shows the best of them.

    Args:
        benchmark: the fixture of pytest-benchmark.
        function: the work.
        group: the table of the report.
        name: the line in that table; the others are compared with `OURS`.
        amount: how much work one call does.
        unit: of that amount, in the plural.
        setup: called before every call, outside the measured time; may return its arguments.
        rounds: how many; None derives them from the first call. 1 leaves out the warm-up.
        target_s: the required time.
        figure: "ratio" if the lines of a group do the same work, "rate" if they do not.

    Returns:
        The result of the function.
    """
    if rounds is None:
        args, kwargs = (setup() if setup else None) or ((), {})
        start = time.perf_counter()
        function(*args, **kwargs)
        seconds = time.perf_counter() - start
        # The first call includes compilation; the second one shows how long a round is.
        if seconds > BUDGET_S / MOST_ROUNDS and setup is None:
            start = time.perf_counter()
            function()
            seconds = time.perf_counter() - start
        rounds = round(min(max(BUDGET_S / max(seconds, 1e-9), FEWEST_ROUNDS), MOST_ROUNDS))
    benchmark.group = group
    benchmark.extra_info.update(
        name=name, amount=amount, unit=unit, target_s=target_s, figure=figure
    )
    clock: list[float] = []

    def clocked(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        result = function(*args, **kwargs)
        clock.append(time.perf_counter() - start)
        return result

    result = benchmark.pedantic(clocked, setup=setup, rounds=rounds)  # type: ignore[no-untyped-call]
    benchmark.extra_info["clock_s"] = min(clock)
    return result
