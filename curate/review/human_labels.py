"""What people decided about the objects of a frame, and which predictions that speaks for.

Human labels are bound to places, not to predictions: label k of one round is not label k of the
next, but an object stays where it is in its frame. Two real objects cannot lie in each other, so
whatever overlaps an object that a person has confirmed is that object, or wrong.
"""

from dataclasses import dataclass

import numpy as np

from curate.detections import Columns
from curate.geometry.overlap import bev_iou

ACCEPTED, REJECTED, MOVED, ADDED = DECISIONS = ("accepted", "rejected", "moved", "added")

SAME_OBJECT_IOU = 0.1
"""A prediction, of any category, whose BEV IoU with a human label's box is above this means the
same object and gives way to it: the bound of the consistency match and of `curate diff`."""
REFUSED_IOU = 0.3
"""A prediction of the same category whose BEV IoU with a refused box is above this is refused as
well. One that overlaps less, or says something else of the place, is a claim that nobody has
judged: detectors answer the same box with two categories, and a person refuses the wrong one."""
SAME_DECISION_IOU = 0.5
"""A later decision about a box that overlaps an earlier one by more than this takes its place."""


@dataclass(frozen=True)
class HumanLabels(Columns):
    """The n human labels of one frame.

    Attributes:
        decisions: (n,) str, of `DECISIONS`.
        categories: (n,) str.
        boxes: (n, 7) in the LiDAR frame, of the object; of a rejected label the refused box.
        seen: (n, 7) the box as it was shown to the person; NaN for an added one.
    """

    decisions: np.ndarray
    categories: np.ndarray
    boxes: np.ndarray
    seen: np.ndarray


@dataclass(frozen=True)
class CoveredPredictions:
    """Which human label speaks for each of m predictions.

    Attributes:
        label: (m,) int64 row of the human label, -1 for none.
        iou: (m,) BEV IoU with its box or with the box as it was seen, the greater; 0 for none.
        leads: (m,) bool, true for the one prediction per object that overlaps it most: the human
            label stands under its number.
    """

    label: np.ndarray
    iou: np.ndarray
    leads: np.ndarray


def match_human_labels(
    boxes: np.ndarray, categories: np.ndarray, labels: HumanLabels
) -> CoveredPredictions:
    """Which predictions of a frame the human labels speak for; objects come before refusals.

    Args:
        boxes: (m, 7) of the predictions, in the LiDAR frame.
        categories: (m,) str of the predictions.
        labels: of the same frame.
    """
    label = np.full(len(boxes), -1, dtype=np.int64)
    iou, leads = np.zeros(len(boxes)), np.zeros(len(boxes), dtype=bool)
    if len(labels) == 0 or len(boxes) == 0:
        return CoveredPredictions(label, iou, leads)
    with_box, with_seen = bev_iou(boxes, labels.boxes), bev_iou(boxes, _known(labels.seen))
    overlap = np.maximum(with_box, with_seen)
    refused = labels.decisions == REJECTED
    alike_named = categories[:, None] == labels.categories[None]
    same = ~refused & (with_box > SAME_OBJECT_IOU)
    alike = refused & alike_named & (with_box > REFUSED_IOU)
    for near in (same, alike):
        gain = np.where(near, overlap, 0.0)
        free = (label < 0) & (gain.max(axis=1) > 0)
        label[free], iou[free] = gain[free].argmax(axis=1), gain[free].max(axis=1)
    for row in np.flatnonzero(~refused):
        mine = np.flatnonzero(label == row)
        if len(mine):
            leads[mine[np.argmax(iou[mine])]] = True
    return CoveredPredictions(label, iou, leads)


def superseded(former: HumanLabels, later: HumanLabels) -> np.ndarray:
    """(n,) bool, which earlier decisions about a frame later ones take the place of."""
    if len(former) == 0 or len(later) == 0:
        return np.zeros(len(former), dtype=bool)
    overlap = np.maximum(
        bev_iou(former.boxes, later.boxes), bev_iou(former.boxes, _known(later.seen))
    )
    # A refusal says nothing of an object of another category at its place.
    counts = (later.decisions != REJECTED) | (former.categories[:, None] == later.categories[None])
    result: np.ndarray = (counts & (overlap > SAME_DECISION_IOU)).any(axis=1)
    return result


def overlapping_objects(labels: HumanLabels) -> list[tuple[int, int]]:
    """Pairs of rows of objects that lie in each other, which no two objects do."""
    objects = np.flatnonzero(labels.decisions != REJECTED)
    overlap = np.triu(bev_iou(labels.boxes[objects], labels.boxes[objects]), 1)
    rows, columns = np.nonzero(overlap > SAME_DECISION_IOU)
    return list(zip(objects[rows].tolist(), objects[columns].tolist(), strict=True))


def _known(boxes: np.ndarray) -> np.ndarray:
    """Boxes with those that are not known as boxes without size, which overlap nothing."""
    return np.where(np.isnan(boxes).any(axis=1)[:, None], 0.0, boxes)
