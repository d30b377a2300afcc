"""Non-maximum suppression by its definition, one pair at a time."""

from oracles.clipping import bev_iou


def nms(boxes, scores, threshold):
    """Return kept indices, best first; equal scores by index."""
    kept = []
    for candidate in sorted(range(len(boxes)), key=lambda index: (-scores[index], index)):
        if all(bev_iou(boxes[candidate], boxes[other]) <= threshold for other in kept):
            kept.append(candidate)
    return kept
