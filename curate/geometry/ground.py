"""The height of the ground in a sweep, to a few centimetres: what objects stand on."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from curate.shapes import Float

_SQUARE_METRES = 3.0
# Points farther from the sensor tell nothing of the ground, and would make the map large.
_REACH_METRES = 150.0


@dataclass(frozen=True)
class GroundMap:
    """The ground around every square.

    Attributes:
        low: (2,) x and y in metres of the map's corner.
        heights: (columns, rows) z in metres of the ground around a square, NaN where no point
            tells.
    """

    low: Float[np.ndarray, " 2"]
    heights: Float[np.ndarray, "columns rows"]

    @classmethod
    def of(cls, points: Float[np.ndarray, "n _"]) -> Self:
        """Return the map of (n, >=3) points.

        A square has the second lowest of its own and its eight neighbours' lowest points, or the
        lowest where there is but one: walls and cars that cover the others do not raise it, nor
        does one stray point lower it.
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
        """Return (n,) height of the ground at (n, 2) places, NaN where no point tells."""
        reach = 2 * _REACH_METRES
        off = np.clip(places, -reach, reach) - self.low
        square = np.floor(off / _SQUARE_METRES).astype(np.int64)
        on_map = ((square >= 0) & (square < self.heights.shape)).all(axis=1)
        column, row = np.where(on_map[:, None], square, 0).T
        return np.where(on_map, self.heights[column, row], np.nan)

    def lowered(self, rows: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """Return a copy of (n, >=3) points or boxes whose z is measured from the ground below them.

        Where no point tells how high it is, the ground has the median height of the rest.
        """
        return self._shifted(rows, -1)

    def raised(self, rows: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """Return the inverse of `lowered`: a copy whose z is again that of the sensor's frame."""
        return self._shifted(rows, 1)

    def _shifted(self, rows: np.ndarray, sign: int) -> np.ndarray:
        heights = self.at(rows[:, :2])
        known = self.heights[~np.isnan(self.heights)]
        usual = np.median(known) if len(known) else 0.0
        shifted = rows.copy()
        shifted[:, 2] += sign * np.where(np.isnan(heights), usual, heights)
        return shifted
