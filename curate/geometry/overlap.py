"""Intersection over union of rotated boxes: of their footprints (BEV) and of their volumes (3D).

The results are exact up to rounding. A box and its copy give exactly 1, even if the copy is turned
by 180 degrees. The order of the two arguments does not matter. A box with a side that is zero,
negative or not finite overlaps nothing, not even itself.
"""

import numpy as np

from curate.geometry.boxes import as_boxes
from curate.shapes import Float, Int, Num


def bev_iou(
    boxes_a: Num[np.ndarray, "n 7"], boxes_b: Num[np.ndarray, "m 7"]
) -> Float[np.ndarray, "n m"]:
    """Return the bird's eye view IoU of every pair of boxes, in [0, 1].

    Args:
        boxes_a: (n, 7) in metres and radians; both in the same frame of reference.
        boxes_b: (m, 7).

    Raises:
        ValueError: if boxes are not rows of seven numbers.
    """
    return _iou(boxes_a, boxes_b, with_height=False)


def iou_3d(
    boxes_a: Num[np.ndarray, "n 7"], boxes_b: Num[np.ndarray, "m 7"]
) -> Float[np.ndarray, "n m"]:
    """Return the volume IoU of every pair of boxes, in [0, 1].

    Args:
        boxes_a: (n, 7) in metres and radians; both in the same frame of reference.
        boxes_b: (m, 7).

    Raises:
        ValueError: if boxes are not rows of seven numbers.
    """
    return _iou(boxes_a, boxes_b, with_height=True)


def paired_iou_3d(
    boxes_a: Num[np.ndarray, "n 7"], boxes_b: Num[np.ndarray, "n 7"]
) -> Float[np.ndarray, " n"]:
    """Return (n,) volume IoU in [0, 1] of the boxes in the same row.

    Args:
        boxes_a: (n, 7) in metres and radians; both in the same frame of reference.
        boxes_b: (n, 7).

    Raises:
        ValueError: if boxes are not rows of seven numbers.
    """
    from curate.geometry.kernels import paired_iou

    return paired_iou(_table(boxes_a), _table(boxes_b))


def overlapping_pairs(
    boxes_a: Num[np.ndarray, "n 7"],
    starts_a: Int[np.ndarray, " groups_plus_1"],
    boxes_b: Num[np.ndarray, "m 7"],
    starts_b: Int[np.ndarray, " groups_plus_1"],
) -> tuple[
    Int[np.ndarray, " pairs"],
    Int[np.ndarray, " pairs"],
    Float[np.ndarray, " pairs"],
    Float[np.ndarray, " pairs"],
]:
    """Return all pairs with a BEV IoU above 0 within groups of boxes, such as frames of a split.

    Args:
        boxes_a: (n, 7); group g is the rows starts_a[g] to starts_a[g + 1].
        starts_a: (groups + 1,) integers, from 0 to n.
        boxes_b: (m, 7); group g is the rows starts_b[g] to starts_b[g + 1].
        starts_b: (groups + 1,) integers, from 0 to m.

    Returns:
        Row in a, row in b, BEV IoU and 3D IoU of each pair, ascending by (row in a, row in b).
    """
    from curate.geometry.kernels import grouped_iou

    groups_a = np.ascontiguousarray(starts_a, dtype=np.int64)
    groups_b = np.ascontiguousarray(starts_b, dtype=np.int64)
    return grouped_iou(_table(boxes_a), groups_a, _table(boxes_b), groups_b)


def _iou(boxes_a: np.ndarray, boxes_b: np.ndarray, *, with_height: bool) -> np.ndarray:
    from curate.geometry.kernels import iou_matrix

    table_b = _table(boxes_b)
    order = np.argsort(table_b[:, 0])
    return iou_matrix(_table(boxes_a), table_b[order], order, with_height)


def _table(boxes: np.ndarray) -> np.ndarray:
    from curate.geometry.kernels import rectangle_table

    return rectangle_table(as_boxes(boxes))
