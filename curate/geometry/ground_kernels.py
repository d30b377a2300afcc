"""Compiled kernels of `curate.geometry.ground`: the heights of a map, and their lookup."""

import numpy as np
from numba import njit


@njit(nogil=True, error_model="numpy")
def _second_lowest_around(lowest: np.ndarray) -> np.ndarray:
    """Return the second lowest of each square and its neighbours; inf marks a missing number.

    If there is only one number, it is returned, and NaN if there is none.
    """
    columns, rows = lowest.shape
    heights = np.full((columns, rows), np.nan)
    for column in range(columns):
        for row in range(rows):
            first, second = np.inf, np.inf
            for near_column in range(max(column - 1, 0), min(column + 2, columns)):
                for near_row in range(max(row - 1, 0), min(row + 2, rows)):
                    z = lowest[near_column, near_row]
                    first, second = min(first, z), min(second, max(first, z))
            if first < np.inf:
                heights[column, row] = second if second < np.inf else first
    return heights


@njit(cache=True, nogil=True, error_model="numpy")
def ground_heights(points: np.ndarray, reach: float, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (2,) lowest x and y, and (columns, rows) heights of the map of (n, 3) float64 points.

    See `GroundMap.of`.

    Args:
        points: x, y, z in metres.
        reach: points with a larger x or y, positive or negative, are left out.
        side: side of a square in metres.
    """
    low = np.full(2, np.inf)
    high = np.full(2, -np.inf)
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        if abs(x) <= reach and abs(y) <= reach:
            low[0], high[0] = min(low[0], x), max(high[0], x)
            low[1], high[1] = min(low[1], y), max(high[1], y)
    if low[0] > high[0]:
        return np.zeros(2), np.full((1, 1), np.nan)
    low -= side
    columns, rows = int((high[0] - low[0]) / side) + 2, int((high[1] - low[1]) / side) + 2
    lowest = np.full((columns, rows), np.inf)
    for i in range(len(points)):
        x, y, z = points[i]
        if abs(x) <= reach and abs(y) <= reach and not np.isnan(z):
            column, row = int((x - low[0]) / side), int((y - low[1]) / side)
            lowest[column, row] = min(lowest[column, row], z)
    return low, _second_lowest_around(lowest)


@njit(cache=True, nogil=True, error_model="numpy")
def heights_at(places: np.ndarray, low: np.ndarray, heights: np.ndarray, side: float) -> np.ndarray:
    """Return (n,) height of the map at (n, 2) float64 places x, y; NaN off the map."""
    found = np.full(len(places), np.nan)
    for i in range(len(places)):
        column = (places[i, 0] - low[0]) / side
        row = (places[i, 1] - low[1]) / side
        if 0 <= column < heights.shape[0] and 0 <= row < heights.shape[1]:
            found[i] = heights[int(column), int(row)]
    return found
