"""Which LiDAR points lie in which boxes; a box contains its boundary.

The footprints are entered into a bird's eye view grid once, then each point tests only the boxes of
its cell: one pass over the points, whatever the number of boxes.
"""

import numpy as np
from numba import njit

from curate.geometry.boxes import as_boxes

_CELL_METRES = 1.0
_MOST_CELLS = 256
# The grid must never lose a point that the exact test would accept: boxes are entered wider.
_MARGIN_METRES = 1e-3

# Lowest x and y, highest x and y of the grid.
_Bounds = tuple[float, float, float, float]


def count_points_in_boxes(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(n,) int64 number of points in each of (n, 7) boxes.

    Args:
        points: (p, >=3) x, y, z in metres in the frame of the boxes; NaN is in no box.
        boxes: (n, 7); a point in several boxes counts in each; NaN contains nothing.
    """
    return _count(_as_points(points), _placed(as_boxes(boxes)))


def box_of_points(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(p,) int64 index of the first of (n, 7) boxes that contains each point, -1 where none."""
    return _first_box(_as_points(points), _placed(as_boxes(boxes)))


def points_in_box_mask(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(p,) bool, whether each point lies in the (7,) box."""
    inside: np.ndarray = box_of_points(points, np.reshape(box, (1, 7))) == 0
    return inside


def _as_points(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points must be (n, 3) or wider, not {points.shape}")
    dtype = np.float32 if points.dtype == np.float32 else np.float64
    return np.ascontiguousarray(points, dtype=dtype)


def _placed(boxes: np.ndarray) -> np.ndarray:
    """(n, 8) centre, half sides, cosine and sine of the yaw."""
    turns = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])], axis=1)
    return np.concatenate([boxes[:, :3], boxes[:, 3:6] / 2, turns], axis=1)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _contains(placed: np.ndarray, i: int, x: float, y: float, z: float) -> bool:
    """Whether box i of `_placed` contains the point."""
    if not abs(z - placed[i, 2]) <= placed[i, 5]:
        return False
    away_x, away_y = x - placed[i, 0], y - placed[i, 1]
    along = placed[i, 6] * away_x + placed[i, 7] * away_y
    across = placed[i, 6] * away_y - placed[i, 7] * away_x
    return bool(abs(along) <= placed[i, 3] and abs(across) <= placed[i, 4])


@njit(cache=True, nogil=True, error_model="numpy")
def _extents(placed: np.ndarray) -> np.ndarray:
    """(k, 5) lowest x and y, highest x and y of each finite footprint, with the margin; its box."""
    extents = np.empty((len(placed), 5))
    number = 0
    for i in range(len(placed)):
        if np.isfinite(placed[i]).all():
            cos, sin = abs(placed[i, 6]), abs(placed[i, 7])
            reach_x = cos * abs(placed[i, 3]) + sin * abs(placed[i, 4]) + _MARGIN_METRES
            reach_y = sin * abs(placed[i, 3]) + cos * abs(placed[i, 4]) + _MARGIN_METRES
            extents[number, 0], extents[number, 2] = placed[i, 0] - reach_x, placed[i, 0] + reach_x
            extents[number, 1], extents[number, 3] = placed[i, 1] - reach_y, placed[i, 1] + reach_y
            extents[number, 4] = i
            number += 1
    return extents[:number]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cell(value: float, low: float, cells_per_metre: float) -> int:
    """Index along one axis of the grid cell of a coordinate that is not below `low`."""
    return int((value - low) * cells_per_metre)


@njit(cache=True, nogil=True, error_model="numpy")
def _enter(
    extents: np.ndarray, bounds: _Bounds, cells_per_metre: float
) -> tuple[int, np.ndarray, np.ndarray]:
    """The boxes of every grid cell.

    Returns:
        The number of cells along y, starts (cells + 1,) and boxes: cell c = column * number + row
        holds boxes[starts[c]:starts[c + 1]], ascending.
    """
    columns = _cell(bounds[2], bounds[0], cells_per_metre) + 1
    rows = _cell(bounds[3], bounds[1], cells_per_metre) + 1
    ranges = np.empty((len(extents), 4), np.int64)
    starts = np.zeros(columns * rows + 1, np.int32)  # half the cache of int64
    for i in range(len(extents)):
        for side in range(4):
            low = bounds[1] if side % 2 else bounds[0]
            ranges[i, side] = _cell(extents[i, side], low, cells_per_metre)
        for column in range(ranges[i, 0], ranges[i, 2] + 1):
            for index in range(column * rows + ranges[i, 1], column * rows + ranges[i, 3] + 1):
                starts[index + 1] += 1
    starts = np.cumsum(starts).astype(np.int32)
    fill = starts[:-1].copy()
    entered = np.empty(starts[-1], np.int64)
    for i in range(len(extents)):
        for column in range(ranges[i, 0], ranges[i, 2] + 1):
            for index in range(column * rows + ranges[i, 1], column * rows + ranges[i, 3] + 1):
                entered[fill[index]] = int(extents[i, 4])
                fill[index] += 1
    return rows, starts, entered


@njit(cache=True, nogil=True, error_model="numpy")
def _grid(placed: np.ndarray) -> tuple[_Bounds, float, int, np.ndarray, np.ndarray]:
    """Bounds (low x, low y, high x, high y), cells per metre, and what `_enter` returns."""
    extents = _extents(placed)
    if len(extents) == 0:
        nowhere = (0.0, 0.0, -1.0, -1.0)
        return nowhere, 1.0, 1, np.zeros(2, np.int32), np.empty(0, np.int64)
    bounds = (extents[:, 0].min(), extents[:, 1].min(), extents[:, 2].max(), extents[:, 3].max())
    widest = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    cells_per_metre = 1 / max(_CELL_METRES, widest / _MOST_CELLS)
    rows, starts, entered = _enter(extents, bounds, cells_per_metre)
    return bounds, cells_per_metre, rows, starts, entered


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cell_of_point(x: float, y: float, bounds: _Bounds, cells_per_metre: float, rows: int) -> int:
    """The cell of a point, -1 outside the grid."""
    if not (bounds[0] <= x <= bounds[2] and bounds[1] <= y <= bounds[3]):
        return -1
    column = _cell(x, bounds[0], cells_per_metre)
    return column * rows + _cell(y, bounds[1], cells_per_metre)


@njit(cache=True, nogil=True, error_model="numpy")
def _count(points: np.ndarray, placed: np.ndarray) -> np.ndarray:
    """The kernel of `count_points_in_boxes`."""
    bounds, cells_per_metre, rows, starts, entered = _grid(placed)
    counts = np.zeros(len(placed), np.int64)
    for p in range(len(points)):
        x, y = np.float64(points[p, 0]), np.float64(points[p, 1])
        cell = _cell_of_point(x, y, bounds, cells_per_metre, rows)
        if cell >= 0:
            for position in range(starts[cell], starts[cell + 1]):
                i = entered[position]
                if _contains(placed, i, x, y, np.float64(points[p, 2])):
                    counts[i] += 1
    return counts


@njit(cache=True, nogil=True, error_model="numpy")
def _first_box(points: np.ndarray, placed: np.ndarray) -> np.ndarray:
    """The kernel of `box_of_points`."""
    bounds, cells_per_metre, rows, starts, entered = _grid(placed)
    owners = np.full(len(points), -1)
    for p in range(len(points)):
        x, y = np.float64(points[p, 0]), np.float64(points[p, 1])
        cell = _cell_of_point(x, y, bounds, cells_per_metre, rows)
        if cell >= 0:
            for position in range(starts[cell], starts[cell + 1]):
                if _contains(placed, entered[position], x, y, np.float64(points[p, 2])):
                    owners[p] = entered[position]
                    break
    return owners
