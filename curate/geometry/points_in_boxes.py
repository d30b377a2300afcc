"""Which LiDAR points lie in which boxes; a box contains its boundary.

The footprints are entered into a bird's eye view grid once, then each point tests only the boxes of
its cell: one pass over the points, whatever the number of boxes.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from curate.geometry.boxes import as_boxes
from curate.shapes import Bool, Int, Num

_CELL_METRES = 1.0
_MOST_CELLS = 256
# The grid must never lose a point that the exact test would accept: boxes are entered wider.
_MARGIN_METRES = 1e-3


def count_points_in_boxes(
    points: Num[np.ndarray, "p _"], boxes: Num[np.ndarray, "n 7"]
) -> Int[np.ndarray, " n"]:
    """Return the number of points in each box.

    Args:
        points: (p, >=3) x, y, z in metres in the frame of the boxes; NaN is in no box.
        boxes: (n, 7) in metres and radians; a point in several boxes counts in each; NaN contains
            nothing.
    """
    placed = _placed(as_boxes(boxes))
    return _count(_as_points(points), placed, *_grid(placed))


def box_of_points(
    points: Num[np.ndarray, "p _"], boxes: Num[np.ndarray, "n 7"]
) -> Int[np.ndarray, " p"]:
    """Return the index of the first box that contains each point, -1 where none does.

    Args:
        points: (p, >=3) x, y, z in metres in the frame of the boxes; NaN is in no box.
        boxes: (n, 7) in metres and radians.
    """
    placed = _placed(as_boxes(boxes))
    return _first_box(_as_points(points), placed, *_grid(placed))


def points_in_box_mask(
    points: Num[np.ndarray, "p _"], box: Num[np.ndarray, " 7"]
) -> Bool[np.ndarray, " p"]:
    """Return whether each point lies in one box.

    Args:
        points: (p, >=3) x, y, z in metres in the frame of the box.
        box: (7,) in metres and radians.
    """
    inside: np.ndarray = box_of_points(points, np.reshape(box, (1, 7))) == 0
    return inside


class _Axes(NamedTuple):
    """Where the grid lies: bounds in metres, cells per metre, and the number of cells along y."""

    low_x: float
    low_y: float
    high_x: float
    high_y: float
    cells_per_metre: float
    rows: int


def _as_points(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points must be (n, 3) or wider, not {points.shape}")
    dtype = np.float32 if points.dtype == np.float32 else np.float64
    return np.ascontiguousarray(points, dtype=dtype)


def _placed(boxes: np.ndarray) -> np.ndarray:
    """(n, 8) centre, half sides, cosine and sine of the yaw; NaN where one is not finite."""
    placed = np.empty((len(boxes), 8))
    placed[:, :3], placed[:, 3:6] = boxes[:, :3], boxes[:, 3:6] / 2
    finite = np.isfinite(boxes).all(axis=1)
    yaw = np.where(finite, boxes[:, 6], 0)
    placed[:, 6], placed[:, 7] = np.cos(yaw), np.sin(yaw)
    placed[~finite] = np.nan
    return placed


def _grid(placed: np.ndarray) -> tuple[_Axes, np.ndarray, np.ndarray]:
    """The grid around all boxes, and what `_enter` returns."""
    indices = np.flatnonzero(np.isfinite(placed[:, 0]))
    if len(indices) == 0:
        return _Axes(0.0, 0.0, -1.0, -1.0, 1.0, 1), np.zeros(2, np.int32), indices
    centres, halves = placed[indices, :2], np.abs(placed[indices, 3:5])
    cos, sin = np.abs(placed[indices, 6:7]), np.abs(placed[indices, 7:8])
    reach = cos * halves + sin * halves[:, ::-1] + _MARGIN_METRES
    lows, highs = centres - reach, centres + reach
    (low_x, low_y), (high_x, high_y) = lows.min(axis=0).tolist(), highs.max(axis=0).tolist()
    widest = max(high_x - low_x, high_y - low_y)
    cells_per_metre = 1 / max(_CELL_METRES, widest / _MOST_CELLS)
    rows = int((high_y - low_y) * cells_per_metre) + 1
    axes = _Axes(low_x, low_y, high_x, high_y, cells_per_metre, rows)
    return axes, *_enter(lows, highs, indices, axes)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _contains(placed: np.ndarray, i: int, x: float, y: float, z: float) -> bool:
    """Whether box i of `_placed` contains the point."""
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
def _cell_of_point(x: float, y: float, axes: _Axes) -> int:
    """The cell of a point, -1 outside the grid."""
    if not (axes.low_x <= x <= axes.high_x and axes.low_y <= y <= axes.high_y):
        return -1
    column = _cell(x, axes.low_x, axes.cells_per_metre)
    return column * axes.rows + _cell(y, axes.low_y, axes.cells_per_metre)


@njit(cache=True, nogil=True, error_model="numpy")
def _enter(
    lows: np.ndarray, highs: np.ndarray, indices: np.ndarray, axes: _Axes
) -> tuple[np.ndarray, np.ndarray]:
    """The boxes of every grid cell.

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
def _count(
    points: np.ndarray, placed: np.ndarray, axes: _Axes, starts: np.ndarray, entered: np.ndarray
) -> np.ndarray:
    """The kernel of `count_points_in_boxes`."""
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
def _first_box(
    points: np.ndarray, placed: np.ndarray, axes: _Axes, starts: np.ndarray, entered: np.ndarray
) -> np.ndarray:
    """The kernel of `box_of_points`."""
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
