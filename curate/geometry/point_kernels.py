"""Compiled kernels on points and boxes: the grid that boxes are entered into, and who is in them.

Their caller is `curate.geometry.points_in_boxes`, which imports them where it uses them: numba is
not loaded by a program that only reads a row. They stay in one file, see
`curate.geometry.kernels`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit


class Axes(NamedTuple):
    """Where the grid lies: bounds in metres, cells per metre, and the number of cells along y."""

    low_x: float
    low_y: float
    high_x: float
    high_y: float
    cells_per_metre: float
    rows: int


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _contains(placed: np.ndarray, i: int, x: float, y: float, z: float) -> bool:
    """Return whether box i of `_placed` contains the point."""
    if not abs(z - placed[i, 2]) <= placed[i, 5]:
        return False
    away_x, away_y = x - placed[i, 0], y - placed[i, 1]
    along = placed[i, 6] * away_x + placed[i, 7] * away_y
    across = placed[i, 6] * away_y - placed[i, 7] * away_x
    return bool(abs(along) <= placed[i, 3] and abs(across) <= placed[i, 4])


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cell(value: float, low: float, cells_per_metre: float) -> int:
    """Index along one axis of the grid cell of a coordinate that is not below `low`."""
    return int((value - low) * cells_per_metre)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cell_of_point(x: float, y: float, axes: Axes) -> int:
    """Return the cell of a point, -1 outside the grid."""
    if not (axes.low_x <= x <= axes.high_x and axes.low_y <= y <= axes.high_y):
        return -1
    column = _cell(x, axes.low_x, axes.cells_per_metre)
    return column * axes.rows + _cell(y, axes.low_y, axes.cells_per_metre)


@njit(cache=True, nogil=True, error_model="numpy")
def enter_boxes(
    lows: np.ndarray, highs: np.ndarray, indices: np.ndarray, axes: Axes
) -> tuple[np.ndarray, np.ndarray]:
    """Return the boxes of every grid cell.

    Args:
        lows: (k, 2) lowest x and y of each footprint.
        highs: (k, 2) highest x and y.
        indices: (k,) int64 the boxes' own numbers, ascending.
        axes: of a grid that holds all of them.

    Returns:
        starts (cells + 1,) and boxes: cell c holds boxes[starts[c]:starts[c + 1]], ascending.
    """
    cells, boxes = [0 for _ in range(0)], [0 for _ in range(0)]  # typed by their elements
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
    entered = np.empty(len(cells), np.int64)
    for position in range(len(cells)):
        cell = cells[position]
        entered[free[cell]] = boxes[position]
        free[cell] += 1
    return starts, entered


@njit(cache=True, nogil=True, error_model="numpy")
def count_points(
    points: np.ndarray, placed: np.ndarray, axes: Axes, starts: np.ndarray, entered: np.ndarray
) -> np.ndarray:
    """Return the kernel of `count_points_in_boxes`."""
    counts = np.zeros(len(placed), np.int64)
    for p in range(len(points)):
        x, y = np.float64(points[p, 0]), np.float64(points[p, 1])
        cell = _cell_of_point(x, y, axes)
        if cell >= 0:
            for position in range(starts[cell], starts[cell + 1]):
                i = entered[position]
                if _contains(placed, i, x, y, np.float64(points[p, 2])):
                    counts[i] += 1
    return counts


@njit(cache=True, nogil=True, error_model="numpy")
def first_box(
    points: np.ndarray, placed: np.ndarray, axes: Axes, starts: np.ndarray, entered: np.ndarray
) -> np.ndarray:
    """Return the kernel of `box_of_points`."""
    owners = np.full(len(points), -1)
    for p in range(len(points)):
        x, y = np.float64(points[p, 0]), np.float64(points[p, 1])
        cell = _cell_of_point(x, y, axes)
        if cell >= 0:
            for position in range(starts[cell], starts[cell + 1]):
                if _contains(placed, entered[position], x, y, np.float64(points[p, 2])):
                    owners[p] = entered[position]
                    break
    return owners
