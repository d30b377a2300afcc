"""Find detections that are copies of ground truth boxes."""

import numpy as np

from curate.detections import Annotations

# No detector is this close in position, size and heading at once without having seen the label.
_TOLERANCE = 1e-3  # metres and radians


def copied_boxes(boxes: np.ndarray, truth: Annotations) -> np.ndarray:
    """Return (n,) bool: which of (n, 7) boxes equal a ground truth box, both in the LiDAR frame.

    A yaw that differs by half a turn still counts as the same box.
    """
    objects = truth.boxes[np.isfinite(truth.boxes).all(axis=1)]
    if len(boxes) == 0 or len(objects) == 0:
        return np.zeros(len(boxes), dtype=bool)
    apart = np.abs(boxes[:, None, :6] - objects[None, :, :6]).max(axis=2)
    turned = np.abs(np.sin(boxes[:, None, 6] - objects[None, :, 6]))
    return np.asarray(((apart < _TOLERANCE) & (turned < _TOLERANCE)).any(axis=1))
