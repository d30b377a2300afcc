"""How many objects or detections count in an evaluation, and why the others do not."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from curate.datasets.kitti.labels import DONT_CARE
from curate.evaluation.difficulties import REASONS
from curate.shapes import Shaped


@dataclass(frozen=True)
class CategoryCounts:
    """The objects or detections of one evaluated category.

    Attributes:
        category: the category.
        total: number of all; for each level it equals counted plus all ignored.
        counted: how many count, by level.
        ignored: how many do not count, by level, for each reason that occurs.
    """

    category: str
    total: int
    counted: tuple[int, ...]
    ignored: Mapping[str, tuple[int, ...]]


@dataclass(frozen=True)
class Counts:
    """All objects of the ground truth, or all detections; each is in exactly one attribute.

    Attributes:
        levels: names of the levels.
        categories: the evaluated categories.
        neighbours: number by neighbour category (Van for Car), which is ignored.
        not_evaluated: number by category that is not evaluated.
        dont_care: number of DontCare regions.
    """

    levels: tuple[str, ...]
    categories: tuple[CategoryCounts, ...]
    neighbours: Mapping[str, int]
    not_evaluated: Mapping[str, int]
    dont_care: int

    @property
    def total(self) -> int:
        """Number of all objects or detections, without DontCare regions."""
        others = (*self.neighbours.values(), *self.not_evaluated.values())
        return sum(each.total for each in self.categories) + sum(others)

    @property
    def counted(self) -> int:
        """Number that counts at a level, summed over all levels and categories."""
        return sum(sum(each.counted) for each in self.categories)

    def reasons(self) -> dict[str, int]:
        """Return how often each reason applies at the level where the fewest are left out."""
        found: dict[str, int] = {}
        for each in self.categories:
            most = int(np.argmax(each.counted))
            for reason, numbers in each.ignored.items():
                if numbers[most]:
                    found[reason] = found.get(reason, 0) + numbers[most]
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {
            "total": self.total,
            "categories": {
                each.category: {
                    "total": each.total,
                    "counted": list(each.counted),
                    "ignored": {reason: list(numbers) for reason, numbers in each.ignored.items()},
                }
                for each in self.categories
            },
            "neighbours": dict(self.neighbours),
            "not_evaluated": dict(self.not_evaluated),
            DONT_CARE: self.dont_care,
        }


def tally(
    levels: Sequence[str],
    categories: Shaped[np.ndarray, " n"],
    reasons: Sequence[Shaped[np.ndarray, " n"]],
    evaluated: Sequence[str],
    neighbours: Sequence[str] = (),
) -> Counts:
    """Return the counts of n objects or detections.

    Args:
        levels: names of the levels.
        categories: (n,) category of each.
        reasons: for each level, (n,) why each does not count: one of `REASONS`, or another text.
        evaluated: the evaluated categories.
        neighbours: categories that are ignored because they look like an evaluated one.
    """
    names, numbers = np.unique(categories, return_counts=True)
    totals = dict(zip(names.tolist(), numbers.tolist(), strict=True))
    dont_care = totals.pop(DONT_CARE, 0)
    others = {name: number for name, number in totals.items() if name not in evaluated}
    return Counts(
        tuple(levels),
        tuple(
            _of_category(category, [each[categories == category] for each in reasons])
            for category in evaluated
        ),
        {name: number for name, number in others.items() if name in neighbours},
        {name: number for name, number in others.items() if name not in neighbours},
        dont_care,
    )


def describe_others(counts: Counts) -> Iterator[str]:
    """Yield what is counted in no table row: "4 Van (neighbour)", "3 Tram (not evaluated)"."""
    for name, number in counts.neighbours.items():
        yield f"{number} {name} (neighbour)"
    for name, number in counts.not_evaluated.items():
        yield f"{number} {name} (not evaluated)"
    if counts.dont_care:
        yield f"{counts.dont_care} {DONT_CARE}"


def _of_category(category: str, reasons: Sequence[np.ndarray]) -> CategoryCounts:
    """Return the counts of a category from the reasons at each level."""
    by_level = [
        dict(zip(*(each.tolist() for each in np.unique(level, return_counts=True)), strict=True))
        for level in reasons
    ]
    found = {reason for level in by_level for reason in level}
    ordered = [reason for reason in REASONS[1:] if reason in found]
    ordered += sorted(found - set(REASONS))
    return CategoryCounts(
        category,
        len(reasons[0]),
        tuple(level.get(REASONS[0], 0) for level in by_level),
        {reason: tuple(level.get(reason, 0) for level in by_level) for reason in ordered},
    )
