"""Non-maximum suppression of rotated boxes in bird's eye view."""

import numpy as np
from jaxtyping import Int, Num

from curate.geometry.boxes import as_boxes
from curate.geometry.kernels import greedy_nms, rectangle_table


def nms_bev(
    boxes: Num[np.ndarray, "n 7"], scores: Num[np.ndarray, " n"], iou_threshold: float
) -> Int[np.ndarray, " k"]:
    """Keeps each box unless a better kept box overlaps it with a BEV IoU above the threshold.

    Args:
        boxes: (n, 7); one category, or all where categories shall suppress each other.
        scores: (n,) higher is better; equal scores are ranked by index.
        iou_threshold: in [0, 1].

    Returns:
        (k,) int64 indices of the kept boxes, by descending score.
    """
    order = np.argsort(-np.asarray(scores, dtype=np.float64), kind="stable")
    return greedy_nms(rectangle_table(as_boxes(boxes)), order, float(iou_threshold))
