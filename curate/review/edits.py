"""What an edited frame says: its boxes set against those that were shown.

A box that came back as it was shown is unchanged, which by itself says nothing: it may not have
been looked at. Of the others, those that overlap are paired, the largest overlap first: moved. What
was shown and has gone is rejected, what is new is added. A box that was moved so far that it no
longer overlaps is rejected there and added here.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.errors import DataError
from curate.geometry.overlap import bev_iou
from curate.geometry.similarity import wrap_angle
from curate.review.human_labels import ACCEPTED, ADDED, MOVED, REJECTED, SAME_OBJECT_IOU
from curate.review.sheet import ShownFrame

# Editors round; KITTI's text here has four decimals.
_SAME_METRES, _SAME_RADIANS = 2e-3, 2e-3
_FURTHEST_METRES, _LONGEST_METRES = 500.0, 50.0


@dataclass(frozen=True)
class EditedBox:
    """A box of an answer.

    Attributes:
        category: as it was written.
        box: x, y, z, length, width, height, yaw in the LiDAR frame.
        place: file and line or number, for messages.
    """

    category: str
    box: tuple[float, ...]
    place: str


@dataclass(frozen=True)
class Decision:
    """What a person decided about one object.

    Attributes:
        number: of the shown box, from 1; None for an added one.
        decision: accepted, rejected, moved or added.
        category: of the object.
        box: (7,) of the object in the LiDAR frame; the refused one where it is rejected.
        seen: (7,) as it was shown; None for an added one.
    """

    number: int | None
    decision: str
    category: str
    box: tuple[float, ...]
    seen: tuple[float, ...] | None


@dataclass(frozen=True)
class Answer:
    """A frame that came back.

    Attributes:
        frame: its name.
        decisions: what was decided.
        untouched: how many shown boxes nothing was said about.
    """

    frame: str
    decisions: tuple[Decision, ...]
    untouched: int


def read_answer(
    shown: ShownFrame,
    edited: Sequence[EditedBox],
    said: "dict[int, str] | None" = None,
    *,
    accept_rest: bool = False,
) -> Answer:
    """What the person decided.

    Args:
        shown: the frame as it was exported.
        edited: its boxes as they came back.
        said: what was said outright of some boxes by number: accepted or rejected.
        accept_rest: unchanged boxes on which nothing else was said are accepted.

    Raises:
        DataError: a box was accepted outright and is gone, or was rejected and has been moved.
    """
    said = said or {}
    unchanged, moved = _pairs(shown, edited)
    decisions, untouched = [], 0
    for place, box in enumerate(shown.boxes):
        word = said.get(place + 1)
        if place in moved:
            now = edited[moved[place]]
            if word == REJECTED:
                raise DataError(
                    f"{now.place}: box {place + 1} of frame {shown.frame} has been moved and is "
                    "marked as rejected; do one of both"
                )
            found = Decision(place + 1, MOVED, now.category, now.box, box.box)
        elif word == REJECTED or (place not in unchanged and word is None):
            found = Decision(place + 1, REJECTED, box.category, box.box, box.box)
        elif place not in unchanged:
            raise DataError(
                f"frame {shown.frame}: box {place + 1} is marked as accepted and has been deleted; "
                "do one of both"
            )
        elif not box.human and (word == ACCEPTED or accept_rest):
            found = Decision(place + 1, ACCEPTED, box.category, box.box, box.box)
        else:
            untouched += 1
            continue
        decisions.append(found)
    known = {*unchanged.values(), *moved.values()}
    decisions += [
        Decision(None, ADDED, new.category, new.box, None)
        for place, new in enumerate(edited)
        if place not in known
    ]
    return Answer(shown.frame, tuple(decisions), untouched)


def check_boxes(edited: Sequence[EditedBox], categories: Sequence[str]) -> None:
    """Refuses boxes that cannot be.

    Raises:
        DataError: a number is not finite, a side is not positive or too long, a box is too far
            away, or its category is unknown.
    """
    for each in edited:
        if each.category not in categories:
            raise DataError(
                f"{each.place}: unknown category {each.category!r}; known here are "
                f"{', '.join(categories)}"
            )
        box = np.array(each.box)
        if box.shape != (7,) or not np.isfinite(box).all():
            raise DataError(f"{each.place}: a box has a number that is not finite; correct it")
        if box[3:6].min() <= 0 or box[3:6].max() > _LONGEST_METRES:
            sides = " x ".join(f"{side:g}" for side in box[3:6])
            raise DataError(
                f"{each.place}: sides of {sides} m; they must be above 0 and at most "
                f"{_LONGEST_METRES:g}"
            )
        if np.abs(box[:3]).max() > _FURTHEST_METRES:
            raise DataError(
                f"{each.place}: a box {np.abs(box[:3]).max():g} m away from the LiDAR; its "
                "coordinates are in another frame of reference"
            )


def _pairs(shown: ShownFrame, edited: Sequence[EditedBox]) -> tuple[dict[int, int], dict[int, int]]:
    """Places of shown boxes with those of edited ones: unchanged, and moved."""
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
    """Rows and columns one to one, the greatest gain first, none below the least."""
    gain = gain.copy()
    pairs: dict[int, int] = {}
    while gain.size and gain.max() >= least:
        row, column = np.unravel_index(int(gain.argmax()), gain.shape)
        pairs[int(row)] = int(column)
        gain[row], gain[:, column] = -np.inf, -np.inf
    return pairs
