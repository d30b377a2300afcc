"""The decisions in an edited frame."""

from dataclasses import replace

import pytest
from support.reviews import CAR, CATEGORIES, WALKER, small_sheet

from curate.errors import DataError
from curate.review.edits import EditedBox, FrameEdits, check_boxes, compare_frame

FRAME = small_sheet().frames[0]


def back(**changes: tuple[float, ...] | None) -> list[EditedBox]:
    """Return the frame's boxes as exported, except some by number; None for deleted."""
    boxes = []
    for number, box in enumerate(FRAME.boxes, start=1):
        place = changes.get(f"box{number}", box.box)
        if place is not None:
            boxes.append(EditedBox(box.category, place, f"file:{number}"))
    return boxes


def decisions_of(edits: FrameEdits) -> list[tuple[int | None, str]]:
    """Return k and decisions."""
    return [(each.k, each.decision) for each in edits.decisions]


def test_an_unchanged_box_has_not_been_reviewed() -> None:
    """Importing it does not make it a human label."""
    edits = compare_frame(FRAME, back())
    assert (decisions_of(edits), edits.untouched) == ([], 3)


def test_rounding_is_not_a_change() -> None:
    """A millimetre, and yaw by a whole turn."""
    rounded = (*(round(value, 3) for value in CAR[:6]), CAR[6] + 6.28319)
    assert decisions_of(compare_frame(FRAME, back(box1=rounded)[::-1])) == []


def test_moved_deleted_and_new_boxes_are_decisions() -> None:
    """Overlapping boxes are the same object; the others are deleted or new."""
    moved = (CAR[0] + 0.4, *CAR[1:])
    new = EditedBox("Cyclist", (12.0, 9.0, -0.6, 1.8, 0.6, 1.7, 0.0), "file:9")
    edits = compare_frame(FRAME, [*back(box1=moved, box2=None), new])
    assert decisions_of(edits) == [(0, "moved"), (1, "rejected"), (None, "added")]
    first, second, third = edits.decisions
    assert (first.box, first.seen) == (moved, CAR)
    assert (second.box, third.seen, edits.untouched) == (WALKER, None, 1)


def test_a_box_moved_without_overlap_is_rejected_and_added() -> None:
    """Without overlap it cannot be identified as the same object."""
    far = (CAR[0] + 9, *CAR[1:])
    assert decisions_of(compare_frame(FRAME, back(box1=far))) == [(0, "rejected"), (None, "added")]


def test_another_category_is_a_correction() -> None:
    """The box stays."""
    edited = back()
    edited[1] = replace(edited[1], category="Cyclist")
    edits = compare_frame(FRAME, edited)
    assert decisions_of(edits) == [(1, "moved")]
    assert (edits.decisions[0].category, edits.decisions[0].box) == ("Cyclist", WALKER)


def test_decisions_in_the_table_accept_and_reject() -> None:
    """The accepted box is the exported one, to the last digit."""
    rounded = tuple(round(value, 3) for value in CAR)
    edits = compare_frame(FRAME, back(box1=rounded), {0: "accepted", 1: "rejected"})
    assert decisions_of(edits) == [(0, "accepted"), (1, "rejected")]
    assert edits.decisions[0].box == CAR


def test_accepting_the_rest_does_not_change_human_labels() -> None:
    """They are decided already."""
    edits = compare_frame(FRAME, back(), accept_rest=True)
    assert (decisions_of(edits), edits.untouched) == ([(0, "accepted"), (1, "accepted")], 1)


def test_a_human_label_can_be_corrected() -> None:
    """Like any other box."""
    assert decisions_of(compare_frame(FRAME, back(box3=None))) == [(1_000_000, "rejected")]


@pytest.mark.parametrize(
    ("edited", "words", "message"),
    [
        (back(box1=None), {0: "accepted"}, "label 0 is marked as accepted but deleted"),
        (
            back(box1=(CAR[0] + 0.4, *CAR[1:])),
            {0: "rejected"},
            "file:1: label 0 of .*marked as rejected",
        ),
    ],
)
def test_contradictions_between_table_and_boxes_are_rejected(
    edited: list[EditedBox], words: dict[int, str], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        compare_frame(FRAME, edited, words)


@pytest.mark.parametrize(
    ("category", "box", "message"),
    [
        ("Tram", CAR, "unknown category 'Tram'; the categories of this review are Car"),
        ("car", CAR, "unknown category 'car'; the categories of this review are Car.*'Car'?"),
        ("Car", (float("nan"), *CAR[1:]), "not finite"),
        ("Car", (*CAR[:3], 0.0, *CAR[4:]), "the sides are 0 x 1.8 x 1.6"),
        ("Car", (*CAR[:3], 400.0, *CAR[4:]), "at most 50"),
        ("Car", (481_000.0, *CAR[1:]), "another frame of reference"),
    ],
)
def test_invalid_boxes_are_rejected(category: str, box: tuple[float, ...], message: str) -> None:
    """With their position."""
    with pytest.raises(DataError, match=f"^here: .*{message}"):
        check_boxes([EditedBox(category, box, "here")], CATEGORIES)
