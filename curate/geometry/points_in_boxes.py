"""Which LiDAR points lie in which boxes; a box contains its boundary.

The footprints are entered into a bird's eye view grid once, then each point tests only the boxes of
its cell: one pass over the points, whatever the number of boxes.
"""

from typing import TYPE_CHECKING

import numpy as np

from curate.geometry.boxes import as_boxes
from curate.shapes import Bool, Int, Num

if TYPE_CHECKING:
    from curate.geometry.point_kernels import Axes

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
    from curate.geometry.point_kernels import count_points

    placed = _placed(as_boxes(boxes))
    return count_points(_as_points(points), placed, *_grid(placed))


def box_of_points(
    points: Num[np.ndarray, "p _"], boxes: Num[np.ndarray, "n 7"]
) -> Int[np.ndarray, " p"]:
    """Return the index of the first box that contains each point, -1 where none does.

    Args:
        points: (p, >=3) x, y, z in metres in the frame of the boxes; NaN is in no box.
        boxes: (n, 7) in metres and radians.
    """
    from curate.geometry.point_kernels import first_box

    placed = _placed(as_boxes(boxes))
    return first_box(_as_points(points), placed, *_grid(placed))


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


def _as_points(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points must be (n, 3) or wider, not {points.shape}")
    dtype = np.float32 if points.dtype == np.float32 else np.float64
    return np.ascontiguousarray(points, dtype=dtype)


def _placed(boxes: np.ndarray) -> np.ndarray:
    """Return (n, 8) centre, half sides, cosine and sine of the yaw; NaN where one is not finite."""
    placed = np.empty((len(boxes), 8))
    placed[:, :3], placed[:, 3:6] = boxes[:, :3], boxes[:, 3:6] / 2
    finite = np.isfinite(boxes).all(axis=1)
    yaw = np.where(finite, boxes[:, 6], 0)
    placed[:, 6], placed[:, 7] = np.cos(yaw), np.sin(yaw)
    placed[~finite] = np.nan
    return placed


def _grid(placed: np.ndarray) -> tuple["Axes", np.ndarray, np.ndarray]:
    """Return the grid around all boxes, and what `enter_boxes` returns."""
    from curate.geometry.point_kernels import Axes, enter_boxes

    indices = np.flatnonzero(np.isfinite(placed[:, 0]))
    if len(indices) == 0:
        return Axes(0.0, 0.0, -1.0, -1.0, 1.0, 1), np.zeros(2, np.int32), indices
    centres, halves = placed[indices, :2], np.abs(placed[indices, 3:5])
    cos, sin = np.abs(placed[indices, 6:7]), np.abs(placed[indices, 7:8])
    reach = cos * halves + sin * halves[:, ::-1] + _MARGIN_METRES
    lows, highs = centres - reach, centres + reach
    (low_x, low_y), (high_x, high_y) = lows.min(axis=0).tolist(), highs.max(axis=0).tolist()
    widest = max(high_x - low_x, high_y - low_y)
    cells_per_metre = 1 / max(_CELL_METRES, widest / _MOST_CELLS)
    rows = int((high_y - low_y) * cells_per_metre) + 1
    axes = Axes(low_x, low_y, high_x, high_y, cells_per_metre, rows)
    return axes, *enter_boxes(lows, highs, indices, axes)
