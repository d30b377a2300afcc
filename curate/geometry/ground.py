"""Height of the ground in a sweep, accurate to a few centimetres."""

from dataclasses import dataclass
from functools import cached_property
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
        from curate.geometry.ground_kernels import ground_heights

        # In one type, so that the kernels are compiled only once.
        coordinates = np.ascontiguousarray(points[:, :3], dtype=np.float64)
        return cls(*ground_heights(coordinates, _REACH_METRES, _SQUARE_METRES))

    def at(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return (n,) height of the ground at (n, 2) places x, y; NaN if it is not known there."""
        return self._heights(places)

    def lowered(self, rows: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """Return a copy of (n, >=3) points or boxes with z measured from the ground below them.

        If the height of the ground is not known at a place, the median height of the map is used.
        """
        return self._shift(rows, -1)

    def raised(self, rows: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """Return a copy with z in the sensor's frame again; the inverse of `lowered`."""
        return self._shift(rows, 1)

    def _shift(self, rows: np.ndarray, sign: int) -> np.ndarray:
        heights = self._heights(rows)
        shifted = rows.copy()
        shifted[:, 2] += sign * np.where(np.isnan(heights), self._median, heights)
        return shifted

    def _heights(self, rows: np.ndarray) -> np.ndarray:
        from curate.geometry.ground_kernels import heights_at

        places = np.ascontiguousarray(rows[:, :2], dtype=np.float64)
        found: np.ndarray = heights_at(places, self.low, self.heights, _SQUARE_METRES)
        return found

    @cached_property
    def _median(self) -> float:
        """Median height of the map; 0 if no height is known."""
        valid = self.heights[~np.isnan(self.heights)]
        return float(np.median(valid)) if len(valid) else 0.0
