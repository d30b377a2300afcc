"""The states of all objects and detections in an evaluation: counted, ignored or absent."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.evaluation.counts import Counts, tally
from curate.evaluation.difficulties import NO_BOX, REASONS, Difficulty
from curate.evaluation.kitti_rules import ABSENT, COUNTED, IGNORED, neighbours_of
from curate.shapes import Bool, Int


@dataclass(frozen=True)
class Rules:
    """The rules of an evaluation, applied to n labeled objects and m detections.

    Attributes:
        difficulty: the levels of difficulty; there are d.
        categories: the evaluated categories.
        labels: the objects.
        results: the detections.
        label_reasons: d arrays (n,), index into `REASONS` of each object.
        result_reasons: d arrays (m,), the same for the detections.
    """

    difficulty: Difficulty
    categories: tuple[str, ...]
    labels: KittiObjects
    results: KittiObjects
    label_reasons: tuple[Int[np.ndarray, " n"], ...]
    result_reasons: tuple[Int[np.ndarray, " m"], ...]

    @classmethod
    def of(
        cls,
        difficulty: Difficulty,
        categories: Collection[str],
        labels: KittiObjects,
        results: KittiObjects,
        points: Sequence[Int[np.ndarray, " _"]] | None = None,
    ) -> Self:
        """Apply the rules.

        Args:
            difficulty: the levels of difficulty.
            categories: the evaluated categories.
            labels: n objects.
            results: m detections.
            points: the LiDAR points in each object, frame by frame; only levels by points need it.

        Raises:
            ConfigError: if the levels need points, and there are none.
        """
        levels = range(len(difficulty.levels))
        counted = None if points is None else np.concatenate([np.zeros(0, np.int64), *points])
        return cls(
            difficulty,
            tuple(categories),
            labels,
            results,
            tuple(difficulty.object_reasons(labels, level, counted) for level in levels),
            tuple(difficulty.result_reasons(results, level) for level in levels),
        )

    def states(
        self, category: str, level: int
    ) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
        """Return the states of the objects and detections for a category and level.

        With KITTI's levels, a detection with a 2D box that is too low is ignored, whatever its
        category. It can therefore match an object of another category, which is then not counted.
        KITTI's program does the same.

        Returns:
            (n,) int8 states of the objects, (m,) int8 states of the detections, and (m,) bool, True
            for detections that are no false positives if they match nothing.
        """
        of_labels = np.full(len(self.labels), ABSENT, dtype=np.int8)
        neighbour = neighbours_of(self.categories).get(category)
        of_labels[self.labels.categories == neighbour] = IGNORED
        own = self.labels.categories == category
        counts = self.label_reasons[level] == 0
        of_labels[own] = np.where(counts, COUNTED, IGNORED)[own]
        same = self.results.categories == category
        of_results = np.where(same, COUNTED, ABSENT).astype(np.int8)
        beyond = self.result_reasons[level] != 0
        if self.difficulty.beyond_is_ignored:
            of_results[beyond] = IGNORED
            return of_labels, of_results, np.zeros(len(self.results), dtype=bool)
        return of_labels, of_results, beyond

    def lacks_boxes(self, category: str, level: int) -> bool:
        """Return whether there are detections of a category, and none of them has a 2D box."""
        reasons = self.result_reasons[level][self.results.categories == category]
        return bool(len(reasons)) and bool((reasons == NO_BOX).all())

    def counts(self) -> tuple[Counts, Counts]:
        """Return the counts of the objects and those of the detections."""
        names = np.asarray(REASONS)
        neighbours = tuple(neighbours_of(self.categories).values())
        sides = (
            (self.labels, self.label_reasons, neighbours),
            (self.results, self.result_reasons, ()),
        )
        of_labels, of_results = (
            tally(
                self.difficulty.levels,
                objects.categories,
                [names[of_level] for of_level in reasons],
                self.categories,
                beside,
            )
            for objects, reasons, beside in sides
        )
        return of_labels, of_results
