"""Results of other clouds are told from those of the copies, with noise, misses and extra boxes."""

import numpy as np
import pytest

from curate.detections import Detections, as_categories
from curate.evaluation.copy_examination import (
    CopiedFrame,
    describe_few_matches,
    describe_headings,
    examine_copies,
    examine_rotation_y,
)
from curate.geometry.augmented_views import AugmentedViews
from curate.geometry.similarity import Similarity

VIEWS = AugmentedViews(views=2)


def detections(boxes: np.ndarray) -> Detections:
    """Return cars."""
    return Detections(boxes, np.full(len(boxes), 0.5), as_categories(["Car"] * len(boxes)))


def frames(found_in, count: int = 30, cars: int = 4) -> list[CopiedFrame]:
    """Return frames of cars; `found_in` returns the boxes in the copy from A's and the cars."""
    rng = np.random.default_rng(0)
    made = []
    for number in range(count):
        boxes = np.column_stack([
            rng.uniform(8, 50, cars), rng.uniform(-20, 20, cars), np.full(cars, -1.0),
            np.tile([4.2, 1.8, 1.6], (cars, 1)), rng.uniform(-3, 3, cars),
        ])  # fmt: skip
        similarities = VIEWS.draw(f"{number}")
        noise = np.concatenate([rng.normal(0, 0.1, (cars, 7)), np.zeros((1, 7))])
        clutter = [[rng.uniform(8, 50), rng.uniform(-20, 20), -1, 4, 1.8, 1.5, 0.0]]
        seen = np.concatenate([boxes, clutter]) + noise
        copy = found_in(similarities, seen)[1:]  # one car is missed
        made.append(CopiedFrame(detections(boxes), detections(copy), similarities))
    return made


def of_this_view(similarities: list[Similarity], boxes: np.ndarray) -> np.ndarray:
    """Return boxes as the detector finds them in view 1."""
    return similarities[0].apply_to_boxes(boxes)


def test_results_of_the_copies_are_accepted() -> None:
    """With errors as those of real detectors; nothing is said if there are only a few."""
    right = frames(of_this_view)
    assert examine_copies(0, right) == ""
    assert describe_few_matches(0, right) == describe_headings(0, right) == ""
    assert examine_rotation_y(0, right, lambda _: pytest.fail("not read again")) == ""
    wrong = frames(lambda _, boxes: boxes)
    assert examine_copies(0, wrong[:5]) == ""
    assert examine_copies(0, []) == describe_few_matches(0, []) == describe_headings(0, []) == ""


def test_copies_without_any_box_are_a_warning() -> None:
    nothing = frames(lambda _, boxes: boxes[:1])
    assert examine_copies(0, nothing) == ""
    assert "no boxes in 30 copies, but 120 in their frames" in describe_few_matches(0, nothing)
    assert describe_few_matches(0, nothing[:4]) == ""


@pytest.mark.parametrize(
    ("found_in", "message"),
    [
        (lambda _, boxes: boxes, "results of the original frames, or their boxes were mapped"),
        (
            lambda a, boxes: Similarity(False, a[0].rotation_rad).apply_to_boxes(boxes),
            "results of the original frames",  # KITTI's form, read by the calibration of the copy
        ),
        (lambda a, boxes: a[1].apply_to_boxes(boxes), "these are results of view-2: "),
        (
            lambda a, boxes: Similarity(a[1].flip_y, a[0].rotation_rad, a[1].scale).apply_to_boxes(
                boxes
            ),
            "these are results of view-2: ",
        ),
    ],
)
def test_results_of_other_clouds_are_found(found_in, message: str) -> None:
    """Whatever frame of reference their format has."""
    assert message in examine_copies(0, frames(found_in))


def turned_headings(similarities: list[Similarity], boxes: np.ndarray) -> np.ndarray:
    """Return boxes with headings that do not turn with the copy."""
    found = of_this_view(similarities, boxes)
    found[:, 6] -= similarities[0].rotation_rad
    return found


def test_the_meaning_of_rotation_y_that_fits_is_named() -> None:
    """If none fits, it is a warning: some detectors know no headings."""
    wrong = frames(turned_headings)
    message = examine_rotation_y(
        0, wrong, lambda name: frames(of_this_view) if name == "calibration" else wrong
    )
    assert 'set detector.options.rotation_y = "calibration"' in message
    assert examine_rotation_y(0, wrong, lambda _: wrong) == ""
    assert "were the boxes turned back in part?" in describe_headings(0, wrong)


def test_half_turns_are_no_error() -> None:
    """Many detectors take the front of a car for its rear."""

    def reversed_half(similarities: list[Similarity], boxes: np.ndarray) -> np.ndarray:
        found = of_this_view(similarities, boxes)
        found[::2, 6] += np.pi
        return found

    assert describe_headings(0, frames(reversed_half)) == ""


def test_results_of_other_frames_are_a_warning() -> None:
    """A weak detector may find few of its boxes again, too."""
    rng = np.random.default_rng(1)

    def elsewhere(similarities: list[Similarity], boxes: np.ndarray) -> np.ndarray:
        moved = boxes.copy()
        moved[:, :2] += rng.uniform(15, 30, (len(boxes), 2))
        return of_this_view(similarities, moved)

    found = frames(elsewhere)
    assert examine_copies(0, found) == ""
    assert "are the files named by the frames" in describe_few_matches(0, found)
