"""Tests of which LiDAR points are inside which boxes; the boundary belongs to the box.

The footprints are sorted into a bird's eye view grid once. Each point then tests only the boxes of
its cell: one pass over the points, independent of the number of boxes.
"""

from typing import TYPE_CHECKING

import numpy as np

from curate.geometry.boxes import as_boxes
from curate.shapes import Bool, Int, Num

if TYPE_CHECKING:
    from curate.geometry.point_kernels import Axes

_CELL_METRES = 1.0
_MAX_CELLS_PER_AXIS = 256
# Footprints are enlarged by this margin in the grid, so that rounding does not lose a point that
# the exact test would accept.
_MARGIN_METRES = 1e-3


def count_points_in_boxes(
    points: Num[np.ndarray, "p _"], boxes: Num[np.ndarray, "n 7"]
) -> Int[np.ndarray, " n"]:
    """Return the number of points in each box.

    Args:
        points: (p, >=3) x, y, z in metres in the frame of the boxes; a point with NaN is in no box.
        boxes: (n, 7) in metres and radians. A point in several boxes counts in each of them. A box
            with NaN contains nothing.
    """
    from curate.geometry.point_kernels import count_points

    table = _table(as_boxes(boxes))
    return count_points(_as_points(points), table, *_grid(table))


def box_of_points(
    points: Num[np.ndarray, "p _"], boxes: Num[np.ndarray, "n 7"]
) -> Int[np.ndarray, " p"]:
    """Return the index of the first box that contains each point, -1 if no box does.

    Args:
        points: (p, >=3) x, y, z in metres in the frame of the boxes; a point with NaN is in no box.
        boxes: (n, 7) in metres and radians.
    """
    from curate.geometry.point_kernels import first_box

    table = _table(as_boxes(boxes))
    return first_box(_as_points(points), table, *_grid(table))


def points_in_box_mask(
    points: Num[np.ndarray, "p _"], box: Num[np.ndarray, " 7"]
) -> Bool[np.ndarray, " p"]:
    """Return whether each point is inside one box.

    Args:
        points: (p, >=3) x, y, z in metres in the frame of the box.
        box: (7,) in metres and radians.
    """
    inside: np.ndarray = box_of_points(points, np.reshape(box, (1, 7))) == 0
    return inside


def _as_points(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points must be (n, 3) or wider, not {points.shape}")
    dtype = np.float32 if points.dtype == np.float32 else np.float64
    return np.ascontiguousarray(points, dtype=dtype)


def _table(boxes: np.ndarray) -> np.ndarray:
    """Return (n, 8) centre, half sides, cosine and sine of the yaw; NaN for non-finite boxes."""
    table = np.empty((len(boxes), 8))
    table[:, :3], table[:, 3:6] = boxes[:, :3], boxes[:, 3:6] / 2
    finite = np.isfinite(boxes).all(axis=1)
    yaw = np.where(finite, boxes[:, 6], 0)
    table[:, 6], table[:, 7] = np.cos(yaw), np.sin(yaw)
    table[~finite] = np.nan
    return table


def _grid(table: np.ndarray) -> tuple["Axes", np.ndarray, np.ndarray]:
    """Return the axes of the grid around all boxes, and the two arrays of `boxes_by_cell`."""
    from curate.geometry.point_kernels import Axes, boxes_by_cell

    indices = np.flatnonzero(np.isfinite(table[:, 0]))
    if len(indices) == 0:
        return Axes(0.0, 0.0, -1.0, -1.0, 1.0, 1), np.zeros(2, np.int32), indices
    centres, halves = table[indices, :2], np.abs(table[indices, 3:5])
    cos, sin = np.abs(table[indices, 6:7]), np.abs(table[indices, 7:8])
    reach = cos * halves + sin * halves[:, ::-1] + _MARGIN_METRES
    lows, highs = centres - reach, centres + reach
    (low_x, low_y), (high_x, high_y) = lows.min(axis=0).tolist(), highs.max(axis=0).tolist()
    widest = max(high_x - low_x, high_y - low_y)
    cells_per_metre = 1 / max(_CELL_METRES, widest / _MAX_CELLS_PER_AXIS)
    rows = int((high_y - low_y) * cells_per_metre) + 1
    axes = Axes(low_x, low_y, high_x, high_y, cells_per_metre, rows)
    return axes, *boxes_by_cell(lows, highs, indices, axes)
