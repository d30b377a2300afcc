"""Turn an edited frame into decisions by comparing its boxes with the boxes that were shown.

- A box that comes back unchanged is not a decision: nobody may have looked at it.
- Other boxes that overlap a shown box are paired with it, largest overlap first: moved.
- A shown box without a partner is rejected, a new box without a partner is added.
- A box that was moved so far that it no longer overlaps is therefore rejected and added.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.errors import DataError
from curate.geometry.overlap import bev_iou
from curate.geometry.similarity import wrap_angle
from curate.review.human_labels import ACCEPTED, ADDED, MOVED, REJECTED, SAME_OBJECT_IOU
from curate.review.sheet import ShownFrame

# Editors round numbers; the KITTI files of a review have four decimals.
_SAME_METRES, _SAME_RADIANS = 2e-3, 2e-3
_FURTHEST_METRES, _LONGEST_METRES = 500.0, 50.0


@dataclass(frozen=True)
class EditedBox:
    """A box that a person has edited.

    Attributes:
        category: as written in the file.
        box: x, y, z, length, width, height, yaw in the LiDAR frame.
        place: file and line or object number, for messages.
    """

    category: str
    box: tuple[float, ...]
    place: str


@dataclass(frozen=True)
class Decision:
    """A person's decision about one object.

    Attributes:
        k: number of the shown label; None for an added box.
        decision: accepted, rejected, moved or added.
        category: of the object.
        box: (7,) in the LiDAR frame; the shown box if it was rejected.
        seen: (7,) the box as shown; None for an added box.
    """

    k: int | None
    decision: str
    category: str
    box: tuple[float, ...]
    seen: tuple[float, ...] | None


@dataclass(frozen=True)
class FrameEdits:
    """The decisions about one frame.

    Attributes:
        frame: its name.
        decisions: one per object that a person decided about.
        untouched: number of shown boxes without a decision.
    """

    frame: str
    decisions: tuple[Decision, ...]
    untouched: int


def compare_frame(
    shown: ShownFrame,
    edited: Sequence[EditedBox],
    explicit: "dict[int, str] | None" = None,
    *,
    accept_rest: bool = False,
) -> FrameEdits:
    """Return the decisions that an edited frame contains.

    Args:
        shown: the frame as exported.
        edited: its boxes after editing.
        explicit: decisions from the review table by k: accepted or rejected.
        accept_rest: accept unchanged boxes without an explicit decision.

    Raises:
        DataError: if a box is marked as accepted but deleted, or marked as rejected but moved.
    """
    explicit = explicit or {}
    unchanged, moved = _pairs(shown, edited)
    decisions, untouched = [], 0
    for place, box in enumerate(shown.boxes):
        decision = explicit.get(box.k)
        if place in moved:
            now = edited[moved[place]]
            if decision == REJECTED:
                raise DataError(
                    f"{now.place}: label {box.k} of frame {shown.frame} is moved and also marked "
                    "as rejected; undo one of the two"
                )
            found = Decision(box.k, MOVED, now.category, now.box, box.box)
        elif decision == REJECTED or (place not in unchanged and decision is None):
            found = Decision(box.k, REJECTED, box.category, box.box, box.box)
        elif place not in unchanged:
            raise DataError(
                f"frame {shown.frame}: label {box.k} is marked as accepted but deleted; undo one "
                "of the two"
            )
        elif not box.human and (decision == ACCEPTED or accept_rest):
            found = Decision(box.k, ACCEPTED, box.category, box.box, box.box)
        else:
            untouched += 1
            continue
        decisions.append(found)
    paired = {*unchanged.values(), *moved.values()}
    decisions += [
        Decision(None, ADDED, new.category, new.box, None)
        for place, new in enumerate(edited)
        if place not in paired
    ]
    return FrameEdits(shown.frame, tuple(decisions), untouched)


def check_boxes(edited: Sequence[EditedBox], categories: Sequence[str]) -> None:
    """Check that edited boxes are possible.

    Raises:
        DataError: if a number is not finite, a side is not positive or too long, a box is too far
            from the LiDAR, or a category is unknown.
    """
    for each in edited:
        if each.category not in categories:
            raise DataError(
                f"{each.place}: unknown category {each.category!r}; the categories of this review "
                f"are {', '.join(categories)}"
            )
        box = np.array(each.box)
        if box.shape != (7,) or not np.isfinite(box).all():
            raise DataError(f"{each.place}: the box has a value that is not finite; correct it")
        if box[3:6].min() <= 0 or box[3:6].max() > _LONGEST_METRES:
            sides = " x ".join(f"{side:g}" for side in box[3:6])
            raise DataError(
                f"{each.place}: the sides are {sides} m; each must be above 0 and at most "
                f"{_LONGEST_METRES:g} m"
            )
        if np.abs(box[:3]).max() > _FURTHEST_METRES:
            raise DataError(
                f"{each.place}: the box is {np.abs(box[:3]).max():g} m away from the LiDAR; its "
                "coordinates are probably in another frame of reference"
            )


def _pairs(shown: ShownFrame, edited: Sequence[EditedBox]) -> tuple[dict[int, int], dict[int, int]]:
    """Return indices of shown boxes with those of edited boxes: the unchanged, and the moved."""
    before = shown.array
    after = np.array([each.box for each in edited], dtype=np.float64).reshape(-1, 7)
    same_name = np.array([[box.category == new.category for new in edited] for box in shown.boxes])
    same_name = same_name.reshape(len(before), len(after))
    apart = np.abs(before[:, None] - after[None])
    apart[..., 6] = np.abs(wrap_angle(before[:, None, 6] - after[None, :, 6]))
    largest = np.maximum(apart[..., :6].max(axis=2) / _SAME_METRES, apart[..., 6] / _SAME_RADIANS)
    unchanged = _greedy(-np.where(same_name, largest, np.inf), -1.0)
    gain = bev_iou(before, after) + 1e-3 * same_name
    gain[list(unchanged)] = 0.0
    gain[:, list(unchanged.values())] = 0.0
    return unchanged, _greedy(gain, SAME_OBJECT_IOU + 2e-3)


def _greedy(gain: np.ndarray, least: float) -> dict[int, int]:
    """Pair rows with columns one to one, largest gain first; no pair gains less than `least`."""
    gain = gain.copy()
    pairs: dict[int, int] = {}
    while gain.size and gain.max() >= least:
        row, column = np.unravel_index(int(gain.argmax()), gain.shape)
        pairs[int(row)] = int(column)
        gain[row], gain[:, column] = -np.inf, -np.inf
    return pairs
