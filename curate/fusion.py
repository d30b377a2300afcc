"""Fusion of a prediction with its repredictions: one box from several sights of an object.

Several predictions of the same object scatter around it, and their mean scatters less. The weights
are the squared scores. A heading may be off by half a turn between two copies, so it is averaged
modulo half a turn, and the label keeps the direction of its prediction:

    prediction    yaw  0.10, score 0.9     doubled   0.20
    reprediction  yaw -3.00, score 0.6     doubled  -6.00 = 0.28 (a full turn added)
    mean of the doubled angles on the circle with weights 0.81 and 0.36: 0.226, so yaw = 0.113
"""

import numpy as np

from curate.detections import Detections
from curate.shapes import Float, Int

# Headings have no mean if their sum is shorter than this share of their weights, such as two of
# equal weight at a right angle.
_NO_MEAN = 1e-9


def fuse_boxes(
    predictions: Detections,
    repredictions: Detections,
    matched: Int[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, "n 7"], Int[np.ndarray, " n"]]:
    """Return the mean of each prediction and its matched repredictions, weighted by s^2.

    Centre and size are weighted means. The yaw is the circular mean modulo half a turn that is
    nearest to the yaw of the prediction.

    Args:
        predictions: n detections of a frame.
        repredictions: m detections of all views, mapped back by A^-1.
        matched: (m,) number of the prediction that each is matched with, -1 for none.

    Returns:
        (n, 7) boxes in the LiDAR frame, and (n,) number of boxes in each mean, at least 1.
    """
    n, used = len(predictions), matched >= 0
    label = np.concatenate([np.arange(n), matched[used]]).astype(np.int64)
    boxes = np.concatenate([predictions.boxes, repredictions.boxes[used]])
    weights = np.concatenate([predictions.scores, repredictions.scores[used]]) ** 2
    # If all scores are 0, the prediction alone counts.
    weights[:n] = np.maximum(weights[:n], np.finfo(np.float64).tiny)

    def total(values: np.ndarray) -> np.ndarray:
        """Return the weighted sum over the boxes of each label."""
        return np.bincount(label, weights * values, minlength=n)

    whole, count = total(np.ones(len(label))), np.bincount(label, minlength=n)
    # Means of the differences from the prediction: a box without a match stays exactly as it is.
    difference = boxes - predictions.boxes[label]
    fused = predictions.boxes.copy()
    for column in range(6):
        fused[:, column] += total(difference[:, column]) / whole
    sine, cosine = total(np.sin(2 * difference[:, 6])), total(np.cos(2 * difference[:, 6]))
    turned = (count > 1) & (np.hypot(sine, cosine) > _NO_MEAN * whole)
    yaw = fused[turned, 6] + np.arctan2(sine, cosine)[turned] / 2
    fused[turned, 6] = np.arctan2(np.sin(yaw), np.cos(yaw))
    return fused, count
