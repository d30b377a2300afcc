"""Corners of boxes: eight of the cuboid, and four of its footprint in bird's eye view (BEV)."""

import numpy as np

from curate.shapes import Float, Num

# Front left, rear left, rear right, front right: counter-clockwise seen from above.
_FOOTPRINT_SIGNS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2


def as_boxes(boxes: Num[np.ndarray, " ..."]) -> Float[np.ndarray, "n 7"]:
    """Return (n, 7) boxes as C-contiguous float64, the only layout the kernels are compiled for.

    Raises:
        ValueError: if the array is not (n, 7).
    """
    boxes = np.ascontiguousarray(boxes, dtype=np.float64)
    if boxes.ndim != 2 or boxes.shape[1] != 7:
        raise ValueError(f"boxes must be (n, 7), not {boxes.shape}")
    return boxes


def bev_corners(boxes: Num[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 4 2"]:
    """Return the corners of the boxes' footprints, in the frame of the boxes.

    Returns:
        (n, 4, 2) x and y in metres, counter-clockwise from the front left corner.
    """
    boxes = as_boxes(boxes)
    offsets = boxes[:, None, 3:5] * _FOOTPRINT_SIGNS
    cos, sin = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
    x = cos * offsets[..., 0] - sin * offsets[..., 1]
    y = sin * offsets[..., 0] + cos * offsets[..., 1]
    corners: np.ndarray = np.stack([x, y], axis=2) + boxes[:, None, :2]
    return corners


def box_corners(boxes: Num[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 8 3"]:
    """Return the eight corners of each box, in the frame of the boxes.

    Returns:
        (n, 8, 3) in metres: the corners of `bev_corners` at the bottom, then those at the top.
    """
    boxes = as_boxes(boxes)
    footprint = np.tile(bev_corners(boxes), (1, 2, 1))
    half_heights = boxes[:, 5, None] / 2 * np.repeat([-1.0, 1.0], 4)
    heights = boxes[:, 2, None] + half_heights
    return np.concatenate([footprint, heights[..., None]], axis=2)
