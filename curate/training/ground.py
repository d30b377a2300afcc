"""The height of the ground in a sweep, as far as pasting objects needs it."""

from dataclasses import dataclass
from typing import Self

import numpy as np

_CELL_METRES = 3.0


@dataclass(frozen=True)
class GroundMap:
    """The lowest point of every square of ground.

    Attributes:
        low: (2,) x and y in metres of the map's corner.
        heights: (columns, rows) z in metres, NaN in squares without points; a ring of empty squares
            surrounds them.
    """

    low: np.ndarray
    heights: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> Self:
        """The map of (n, >=3) points, n > 0."""
        low = points[:, :2].min(axis=0) - _CELL_METRES
        square = ((points[:, :2] - low) / _CELL_METRES).astype(np.int64)
        heights = np.full(square.max(axis=0) + 2, np.inf)
        np.minimum.at(heights, (square[:, 0], square[:, 1]), points[:, 2])
        heights[np.isinf(heights)] = np.nan
        return cls(low, heights)

    def at(self, places: np.ndarray) -> np.ndarray:
        """(n,) height of the ground around (n, 2) places, NaN where no point tells.

        The second lowest of the nine squares around a place, or the lowest where there is but one:
        walls and cars that cover the others do not raise it, nor does one stray point lower it.
        """
        last = np.array(self.heights.shape) - 1
        square = ((places - self.low) / _CELL_METRES).astype(np.int64)
        around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(1, 9, 2)
        squares = np.clip(square[:, None] + around, 0, last)
        lowest = np.sort(self.heights[squares[..., 0], squares[..., 1]], axis=1)
        return np.asarray(np.where(np.isnan(lowest[:, 1]), lowest[:, 0], lowest[:, 1]))
