"""Compiled kernels on points and boxes: a grid of the boxes, and the points inside each box.

`curate.geometry.points_in_boxes` calls them and imports them only when needed, so that programs
which do not count points do not load numba. They are in one file, see `curate.geometry.kernels`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit


class Axes(NamedTuple):
    """Position of the grid: bounds in metres, cells per metre, and the number of cells along y."""

    low_x: float
    low_y: float
    high_x: float
    high_y: float
    cells_per_metre: float
    rows: int


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _contains(table: np.ndarray, i: int, x: float, y: float, z: float) -> bool:
    """Return whether row i of the box table contains the point.

    The table is that of `curate.geometry.points_in_boxes`: centre, half sides, cosine and sine of
    the yaw.
    """
    if not abs(z - table[i, 2]) <= table[i, 5]:
        return False
    away_x, away_y = x - table[i, 0], y - table[i, 1]
    along = table[i, 6] * away_x + table[i, 7] * away_y
    across = table[i, 6] * away_y - table[i, 7] * away_x
    return bool(abs(along) <= table[i, 3] and abs(across) <= table[i, 4])


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cell(value: float, low: float, cells_per_metre: float) -> int:
    """Return the index of a coordinate's cell along one axis; `value` must not be below `low`."""
    return int((value - low) * cells_per_metre)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cell_of_point(x: float, y: float, axes: Axes) -> int:
    """Return the flat index of a point's cell, -1 outside the grid."""
    if not (axes.low_x <= x <= axes.high_x and axes.low_y <= y <= axes.high_y):
        return -1
    column = _cell(x, axes.low_x, axes.cells_per_metre)
    return column * axes.rows + _cell(y, axes.low_y, axes.cells_per_metre)


@njit(cache=True, nogil=True, error_model="numpy")
def boxes_by_cell(
    lows: np.ndarray, highs: np.ndarray, indices: np.ndarray, axes: Axes
) -> tuple[np.ndarray, np.ndarray]:
    """Return the boxes of every grid cell.

    Args:
        lows: (k, 2) lowest x and y of each footprint.
        highs: (k, 2) highest x and y of each footprint.
        indices: (k,) int64 numbers of the boxes, ascending.
        axes: the grid; it contains all footprints.

    Returns:
        starts (cells + 1,) and boxes: cell c has boxes[starts[c]:starts[c + 1]], ascending.
    """
    # Empty lists; numba infers the type of a list from the element in the comprehension.
    cells, boxes = [0 for _ in range(0)], [0 for _ in range(0)]
    for i in range(len(indices)):
        first = _cell_of_point(lows[i, 0], lows[i, 1], axes)
        last_in_column = _cell_of_point(lows[i, 0], highs[i, 1], axes)
        first_of_last_column = _cell_of_point(highs[i, 0], lows[i, 1], axes)
        for shift in range(0, first_of_last_column - first + 1, axes.rows):
            for cell in range(first + shift, last_in_column + shift + 1):
                cells.append(cell)
                boxes.append(indices[i])
    columns = _cell(axes.high_x, axes.low_x, axes.cells_per_metre) + 1
    starts = np.zeros(columns * axes.rows + 1, np.int32)  # half the cache lines of int64
    for cell in cells:
        starts[cell + 1] += 1
    for cell in range(1, len(starts)):
        starts[cell] += starts[cell - 1]
    free = starts.copy()
    cell_boxes = np.empty(len(cells), np.int64)
    for position in range(len(cells)):
        cell = cells[position]
        cell_boxes[free[cell]] = boxes[position]
        free[cell] += 1
    return starts, cell_boxes


@njit(cache=True, nogil=True, error_model="numpy")
def count_points(
    points: np.ndarray, table: np.ndarray, axes: Axes, starts: np.ndarray, cell_boxes: np.ndarray
) -> np.ndarray:
    """Return (n,) number of points in each box; kernel of `count_points_in_boxes`."""
    counts = np.zeros(len(table), np.int64)
    for p in range(len(points)):
        x, y = np.float64(points[p, 0]), np.float64(points[p, 1])
        cell = _cell_of_point(x, y, axes)
        if cell >= 0:
            for position in range(starts[cell], starts[cell + 1]):
                i = cell_boxes[position]
                if _contains(table, i, x, y, np.float64(points[p, 2])):
                    counts[i] += 1
    return counts


@njit(cache=True, nogil=True, error_model="numpy")
def first_box(
    points: np.ndarray, table: np.ndarray, axes: Axes, starts: np.ndarray, cell_boxes: np.ndarray
) -> np.ndarray:
    """Return (p,) first box that contains each point, or -1; kernel of `box_of_points`."""
    owners = np.full(len(points), -1)
    for p in range(len(points)):
        x, y = np.float64(points[p, 0]), np.float64(points[p, 1])
        cell = _cell_of_point(x, y, axes)
        if cell >= 0:
            for position in range(starts[cell], starts[cell + 1]):
                if _contains(table, cell_boxes[position], x, y, np.float64(points[p, 2])):
                    owners[p] = cell_boxes[position]
                    break
    return owners
