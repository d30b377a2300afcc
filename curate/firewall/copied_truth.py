"""Ground truth that passes for a detection: a box that repeats an annotator's to the millimetre."""

import numpy as np

from curate.detections import Annotations

# A detector that is this near in position, size and heading at once has seen the label.
_TOLERANCE = 1e-3  # metres and radians


def copied_boxes(boxes: np.ndarray, truth: Annotations) -> np.ndarray:
    """(n,) bool, which of (n, 7) boxes repeat a box of the ground truth; both in the LiDAR frame.

    A heading turned by half a turn still counts as the same box.
    """
    known = truth.boxes[np.isfinite(truth.boxes).all(axis=1)]
    if len(boxes) == 0 or len(known) == 0:
        return np.zeros(len(boxes), dtype=bool)
    apart = np.abs(boxes[:, None, :6] - known[None, :, :6]).max(axis=2)
    turned = np.abs(np.sin(boxes[:, None, 6] - known[None, :, 6]))
    return np.asarray(((apart < _TOLERANCE) & (turned < _TOLERANCE)).any(axis=1))
