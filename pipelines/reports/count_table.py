"""The table of what counts in an evaluation or audit, and why the rest does not."""

from collections.abc import Iterator, Mapping
from typing import Any

from curate.evaluation.counts import CategoryCounts, Counts, describe_others
from pipelines.reports.terminal import print_line, print_table


def print_counts(sides: Mapping[str, Counts]) -> None:
    """Print how many objects, results or labels count per category, and why others do not.

    Args:
        sides: the counts by what is counted, such as "objects" and "results".
    """
    levels = next(iter(sides.values())).levels
    names = [short_level(level) for level in levels] if len(levels) > 1 else ["count"]
    by_level = f" ({' / '.join(names)})" if len(levels) > 1 else ""
    print_table(
        ("category", "", "in all", *names, f"do not count{by_level}"),
        _rows(sides),
        title="what counts",
    )
    for side, counts in sides.items():
        others = ", ".join(describe_others(counts))
        if others:
            print_line(f"{side} of other categories: {others}", indent=2)


def short_level(level: str) -> str:
    """Return the name of a level for the head of a column."""
    return "mod." if level == "moderate" else level


def _rows(sides: Mapping[str, Counts]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of each category, one per side."""
    for of_sides in zip(*(counts.categories for counts in sides.values()), strict=True):
        for side, found in zip(sides, of_sides, strict=True):
            yield (found.category, side, found.total, *found.counted, _ignored(found))


def _ignored(found: CategoryCounts) -> str:
    """Return the reasons with their numbers by level, such as "occluded 3/1/0"."""
    return ", ".join(
        f"{reason} {'/'.join(map(str, numbers))}" for reason, numbers in found.ignored.items()
    )
