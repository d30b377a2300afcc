"""Which LiDAR points lie in which boxes; a box contains its boundary.

The footprints are entered into a bird's eye view grid once, then each point tests only the boxes of
its cell: one pass over the points, whatever the number of boxes.
"""

import numpy as np
from numba import njit

from curate.geometry.boxes import as_boxes

_CELL_METRES = 1.0
_MOST_CELLS = 1024
# The grid must never lose a point that the exact test would accept: boxes are entered wider.
_MARGIN_METRES = 1e-3


def count_points_in_boxes(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(n,) int64 number of points in each of (n, 7) boxes.

    Args:
        points: (p, >=3) x, y, z in metres in the frame of the boxes; NaN is in no box.
        boxes: (n, 7); a point in several boxes counts in each.
    """
    counts, _ = _visit_points(_as_points(points), *_placed(boxes))
    return counts


def box_of_points(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(p,) int64 index of the first of (n, 7) boxes that contains each point, -1 where none."""
    _, owners = _visit_points(_as_points(points), *_placed(boxes))
    return owners


def points_in_box_mask(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(p,) bool, whether each point lies in the (7,) box."""
    return box_of_points(points, np.reshape(box, (1, 7))) == 0


def _as_points(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points must be (n, 3) or wider, not {points.shape}")
    dtype = np.float32 if points.dtype == np.float32 else np.float64
    return np.ascontiguousarray(points, dtype=dtype)
