"""Non-maximum suppression of rotated boxes in bird's eye view."""

import numpy as np

from curate.geometry.overlap import rectangle_table
from curate.shapes import Int, Num


def nms_bev(
    boxes: Num[np.ndarray, "n 7"], scores: Num[np.ndarray, " n"], iou_threshold: float
) -> Int[np.ndarray, " k"]:
    """Return the indices of the boxes that greedy non-maximum suppression keeps.

    A box is dropped if its BEV IoU with a kept box of higher score is above the threshold.

    Args:
        boxes: (n, 7) in metres and radians. All boxes can suppress each other: call once per
            category to prevent this across categories.
        scores: (n,) higher is better; equal scores are ranked by index.
        iou_threshold: BEV IoU in [0, 1] above which a box is dropped.

    Returns:
        (k,) int64 indices of the kept boxes, by descending score.
    """
    from curate.geometry.kernels import greedy_nms

    order = np.argsort(-np.asarray(scores, dtype=np.float64), kind="stable")
    return greedy_nms(rectangle_table(boxes), order, float(iou_threshold))
