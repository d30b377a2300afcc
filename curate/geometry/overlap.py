"""Intersection over union of rotated boxes: of their footprints (BEV) and of their volumes (3D).

The results are exact up to rounding. A box and its copy give exactly 1, even if the copy is turned
by 180 degrees. The order of the two arguments does not matter. A box with a side that is zero,
negative or not finite overlaps nothing, not even itself.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np

from curate.geometry.boxes import as_boxes
from curate.shapes import Float, Int, Num

_BLOCK: Final = 1 << 20  # pairs that are tested at a time: bounds the memory


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
    rows = np.arange(len(boxes_a))
    volumes: np.ndarray = _pair_ious(
        rectangle_table(boxes_a), rows, rectangle_table(boxes_b), rows
    )[1]
    return volumes


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
    table_a, table_b = rectangle_table(boxes_a), rectangle_table(boxes_b)
    parts: list[tuple[np.ndarray, ...]] = []
    for rows_a, rows_b in pairs_within_groups(starts_a, starts_b):
        bev, volumes = _pair_ious(table_a, rows_a, table_b, rows_b)
        overlapping = np.flatnonzero(bev)
        found = (rows_a, rows_b, bev, volumes)
        parts.append(tuple(values[overlapping] for values in found))
    rows_a, rows_b, bev, volumes = (np.concatenate(column) for column in zip(*parts, strict=True))
    return rows_a, rows_b, bev, volumes


def pairs_within_groups(
    starts_a: Int[np.ndarray, " groups_plus_1"], starts_b: Int[np.ndarray, " groups_plus_1"]
) -> Iterator[tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]]:
    """Yield the row in a and the row in b of all pairs within groups, in one block or more.

    The pairs are ascending by (row in a, row in b). The arguments are those of `overlapping_pairs`.
    """
    sizes_a, sizes_b = np.diff(starts_a), np.diff(starts_b)
    partners, first = np.repeat(sizes_b, sizes_a), np.repeat(starts_b[:-1], sizes_a)
    ends = np.cumsum(partners)
    total = int(ends[-1]) if len(ends) else 0
    limits = np.searchsorted(ends, np.arange(0, max(total, 1), _BLOCK), side="right")
    for low, high in pairwise([*limits.tolist(), len(ends)]):
        rows_a = np.repeat(np.arange(low, high), partners[low:high])
        before = np.repeat(ends[low:high] - partners[low:high], partners[low:high])
        position = np.arange(len(rows_a)) + (ends[low] - partners[low] if low < high else 0)
        yield rows_a, first[rows_a] + position - before


def rectangle_table(boxes: Num[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 10"]:
    """Return the table of boxes with the values that the kernels use."""
    from curate.geometry.kernels import fill_rectangle_table

    boxes = as_boxes(boxes)
    table = np.zeros((len(boxes), 10))
    fill_rectangle_table(boxes, table)
    return table


def _iou(boxes_a: np.ndarray, boxes_b: np.ndarray, *, with_height: bool) -> np.ndarray:
    from curate.geometry.kernels import iou_matrix

    table_b = rectangle_table(boxes_b)
    order = np.argsort(table_b[:, 0])
    return iou_matrix(rectangle_table(boxes_a), table_b[order], order, with_height)


def _pair_ious(
    table_a: np.ndarray, rows_a: np.ndarray, table_b: np.ndarray, rows_b: np.ndarray
) -> np.ndarray:
    """Return (2, pairs) BEV IoU and 3D IoU of pairs of rows of two rectangle tables."""
    from curate.geometry.kernels import fill_pair_ious

    ious = np.zeros((2, len(rows_a)))
    fill_pair_ious(table_a, rows_a, table_b, rows_b, ious)
    return ious
