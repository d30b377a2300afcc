"""Labels as the plots show them."""

import numpy as np

from curate.viewing.tags import ShownLabels


def labels(boxes, weights) -> ShownLabels:
    """Return cars with weights."""
    boxes = np.array(boxes, dtype=np.float64).reshape(-1, 7)
    count = len(boxes)
    return ShownLabels(boxes, np.array(["Car"] * count, dtype=np.str_), np.full(count, 0.9),
                       np.array(weights, dtype=np.float64))  # fmt: skip
