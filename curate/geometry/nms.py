"""Non-maximum suppression of rotated boxes in bird's eye view."""

import numpy as np

from curate.geometry.boxes import as_boxes
from curate.shapes import Int, Num


def nms_bev(
    boxes: Num[np.ndarray, "n 7"], scores: Num[np.ndarray, " n"], iou_threshold: float
) -> Int[np.ndarray, " k"]:
    """Return the boxes that non-maximum suppression in bird's eye view keeps.

    A box is dropped where a kept box with a higher score has a BEV IoU above the threshold with it.

    Args:
        boxes: (n, 7) in metres and radians; of one category, or of all where categories shall
            suppress each other.
        scores: (n,) higher is better; equal scores are ranked by index.
        iou_threshold: in [0, 1].

    Returns:
        (k,) int64 indices of the kept boxes, by descending score.
    """
    from curate.geometry.kernels import greedy_nms, rectangle_table

    order = np.argsort(-np.asarray(scores, dtype=np.float64), kind="stable")
    return greedy_nms(rectangle_table(as_boxes(boxes)), order, float(iou_threshold))
