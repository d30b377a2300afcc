"""Height of the ground in a sweep, accurate to a few centimetres."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from curate.shapes import Float

# Side of a square of the map.
_SQUARE_METRES = 3.0
# Points farther away along x or y are not used: they are not ground, and would enlarge the map.
_REACH_METRES = 150.0


@dataclass(frozen=True)
class GroundMap:
    """Map of the ground height on a grid of squares.

    Attributes:
        low: (2,) lowest x and y of the map, in metres.
        heights: (columns, rows) z of the ground in each square, in metres; NaN if there is no point
            in the square or its neighbours.
    """

    low: Float[np.ndarray, " 2"]
    heights: Float[np.ndarray, "columns rows"]

    @classmethod
    def of(cls, points: Float[np.ndarray, "n _"]) -> Self:
        """Return the ground map of (n, >=3) points.

        The height of a square is the second lowest of nine numbers: the lowest z in the square and
        in each of its eight neighbours. If only one of them has points, it is their lowest z. Walls
        and cars that cover the other squares therefore do not raise the height, and a single
        outlier does not lower it.
        """
        near = points[(np.abs(points[:, :2]) <= _REACH_METRES).all(axis=1), :3]
        if len(near) == 0:
            return cls(np.zeros(2), np.full((1, 1), np.nan))
        low = near[:, :2].min(axis=0).astype(np.float64) - _SQUARE_METRES
        square = ((near[:, :2] - low) / _SQUARE_METRES).astype(np.int64)
        columns, rows = square.max(axis=0) + 2
        lowest = np.full(columns * rows, np.inf)
        np.minimum.at(lowest, square[:, 0] * rows + square[:, 1], near[:, 2])
        padded = np.pad(lowest.reshape(columns, rows), 1, constant_values=np.inf)
        around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(columns, rows, 9)
        first, second = np.moveaxis(np.partition(around, 1, axis=-1)[..., :2], -1, 0)
        heights = np.where(np.isinf(second), first, second)
        return cls(low, np.where(np.isinf(heights), np.nan, heights))

    def at(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return (n,) height of the ground at (n, 2) places x, y; NaN if it is not known there."""
        reach = 2 * _REACH_METRES
        offset = np.clip(places, -reach, reach) - self.low
        square = np.floor(offset / _SQUARE_METRES).astype(np.int64)
        on_map = ((square >= 0) & (square < self.heights.shape)).all(axis=1)
        column, row = np.where(on_map[:, None], square, 0).T
        return np.where(on_map, self.heights[column, row], np.nan)

    def lowered(self, rows: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """Return a copy of (n, >=3) points or boxes with z measured from the ground below them.

        If the height of the ground is not known at a place, the median height of the map is used.
        """
        return self._shift(rows, -1)

    def raised(self, rows: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """Return a copy with z in the sensor's frame again; the inverse of `lowered`."""
        return self._shift(rows, 1)

    def _shift(self, rows: np.ndarray, sign: int) -> np.ndarray:
        heights = self.at(rows[:, :2])
        valid = self.heights[~np.isnan(self.heights)]
        median = np.median(valid) if len(valid) else 0.0
        shifted = rows.copy()
        shifted[:, 2] += sign * np.where(np.isnan(heights), median, heights)
        return shifted
