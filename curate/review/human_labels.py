"""Human labels of a frame, and the predictions that they cover.

A human label belongs to a place in a frame, not to a prediction: prediction k of one round is not
prediction k of the next, but the object stays where it is. Two real objects cannot overlap, so a
prediction that overlaps a confirmed object is either that object or wrong.
"""

from dataclasses import dataclass

import numpy as np

from curate.detections import Columns
from curate.geometry.overlap import bev_iou

ACCEPTED, REJECTED, MOVED, ADDED = DECISIONS = ("accepted", "rejected", "moved", "added")

SAME_OBJECT_IOU = 0.1
"""A prediction of any category with a BEV IoU above this to the box of a human label is the same
object and is replaced by the label. The consistency match and `curate diff` use this value too."""
REJECTED_IOU = 0.3
"""A prediction of the same category with a BEV IoU above this to a rejected box is rejected as
well. Predictions that overlap less, or have another category, stay undecided: a detector may
predict the same box with two categories, and the person rejects only the wrong one."""
SAME_DECISION_IOU = 0.5
"""A later decision replaces an earlier one if their boxes overlap by more than this BEV IoU."""


@dataclass(frozen=True)
class HumanLabels(Columns):
    """The n human labels of one frame.

    Attributes:
        decisions: (n,) str, one of `DECISIONS` each.
        categories: (n,) str.
        boxes: (n, 7) of the object in the LiDAR frame; the rejected box of a rejected label.
        seen: (n, 7) the box as shown to the person; NaN for an added box.
    """

    decisions: np.ndarray
    categories: np.ndarray
    boxes: np.ndarray
    seen: np.ndarray


@dataclass(frozen=True)
class CoveredPredictions:
    """The human label that covers each of m predictions.

    Attributes:
        label: (m,) int64 row of the human label, -1 for none.
        iou: (m,) BEV IoU with its box or with the box as shown, whichever is larger; 0 for none.
        leads: (m,) bool, true for the prediction that overlaps its object most: the human label
            takes that prediction's number.
    """

    label: np.ndarray
    iou: np.ndarray
    leads: np.ndarray


def match_human_labels(
    boxes: np.ndarray, categories: np.ndarray, labels: HumanLabels
) -> CoveredPredictions:
    """Match the predictions of a frame to its human labels; confirmed objects come first.

    Args:
        boxes: (m, 7) of the predictions, in the LiDAR frame.
        categories: (m,) str of the predictions.
        labels: of the same frame.
    """
    label = np.full(len(boxes), -1, dtype=np.int64)
    iou, leads = np.zeros(len(boxes)), np.zeros(len(boxes), dtype=bool)
    if len(labels) == 0 or len(boxes) == 0:
        return CoveredPredictions(label, iou, leads)
    with_box, with_seen = bev_iou(boxes, labels.boxes), bev_iou(boxes, _without_nan(labels.seen))
    overlap = np.maximum(with_box, with_seen)
    rejected = labels.decisions == REJECTED
    same_category = categories[:, None] == labels.categories[None]
    is_object = ~rejected & (with_box > SAME_OBJECT_IOU)
    is_rejected = rejected & same_category & (with_box > REJECTED_IOU)
    for near in (is_object, is_rejected):
        gain = np.where(near, overlap, 0.0)
        free = (label < 0) & (gain.max(axis=1) > 0)
        label[free], iou[free] = gain[free].argmax(axis=1), gain[free].max(axis=1)
    for row in np.flatnonzero(~rejected):
        covered = np.flatnonzero(label == row)
        if len(covered):
            leads[covered[np.argmax(iou[covered])]] = True
    return CoveredPredictions(label, iou, leads)


def superseded(former: HumanLabels, later: HumanLabels) -> np.ndarray:
    """Return (n,) bool: the earlier decisions about a frame that later ones replace."""
    if len(former) == 0 or len(later) == 0:
        return np.zeros(len(former), dtype=bool)
    overlap = np.maximum(
        bev_iou(former.boxes, later.boxes), bev_iou(former.boxes, _without_nan(later.seen))
    )
    # Rejecting a box does not decide about an object of another category at the same place.
    counts = (later.decisions != REJECTED) | (former.categories[:, None] == later.categories[None])
    result: np.ndarray = (counts & (overlap > SAME_DECISION_IOU)).any(axis=1)
    return result


def overlapping_objects(labels: HumanLabels) -> list[tuple[int, int]]:
    """Return pairs of rows of objects that overlap, which real objects cannot do."""
    objects = np.flatnonzero(labels.decisions != REJECTED)
    overlap = np.triu(bev_iou(labels.boxes[objects], labels.boxes[objects]), 1)
    rows, columns = np.nonzero(overlap > SAME_DECISION_IOU)
    return list(zip(objects[rows].tolist(), objects[columns].tolist(), strict=True))


def _without_nan(boxes: np.ndarray) -> np.ndarray:
    """Replace NaN boxes by boxes without size, which overlap nothing."""
    return np.where(np.isnan(boxes).any(axis=1)[:, None], 0.0, boxes)
