"""Which predictions are covered by human decisions."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from curate.detections import as_categories
from curate.review.human_labels import (
    REJECTED_IOU,
    SAME_OBJECT_IOU,
    HumanLabels,
    match_human_labels,
    overlapping_objects,
    superseded,
)

BOX = np.array([20.0, 1.0, -0.5, 4.0, 2.0, 1.6, 0.0])


def labels(*rows: tuple[str, str, np.ndarray]) -> HumanLabels:
    """Return labels from decision, category and box; none was moved."""
    boxes = np.array([box for _, _, box in rows]).reshape(-1, 7)
    decisions, categories = ([row[i] for row in rows] for i in (0, 1))
    return HumanLabels(as_categories(decisions), as_categories(categories), boxes, boxes)


def along(share: float) -> np.ndarray:
    """Return the box moved along itself until its IoU with the old position is `share`."""
    moved = BOX.copy()
    moved[0] += BOX[3] * (1 - share) / (1 + share)
    return moved


def test_an_object_covers_all_overlapping_predictions() -> None:
    """Of any category, from an IoU of 0.1 on; the one that overlaps most leads."""
    boxes = np.stack([along(SAME_OBJECT_IOU + 0.02), along(0.8), along(SAME_OBJECT_IOU - 0.02)])
    covered = match_human_labels(
        boxes, as_categories(["Car", "Van", "Car"]), labels(("added", "Car", BOX))
    )
    assert covered.label.tolist() == [0, 0, -1]
    assert covered.leads.tolist() == [False, True, False]
    np.testing.assert_allclose(covered.iou, [SAME_OBJECT_IOU + 0.02, 0.8, 0], atol=1e-9)


def test_a_rejection_covers_its_category_and_position() -> None:
    """From an IoU of 0.3 on; another category at the same position is not covered."""
    boxes = np.stack([along(REJECTED_IOU + 0.02), along(REJECTED_IOU - 0.02), BOX])
    names = as_categories(["Car", "Car", "Pedestrian"])
    covered = match_human_labels(boxes, names, labels(("rejected", "Car", BOX)))
    assert covered.label.tolist() == [0, -1, -1]
    assert not covered.leads.any()


def test_objects_come_before_rejections() -> None:
    """If both could cover a prediction, the object does."""
    both = labels(("rejected", "Car", BOX), ("accepted", "Car", along(0.4)))
    assert match_human_labels(BOX[None], as_categories(["Car"]), both).label.tolist() == [1]


def test_without_boxes_nothing_is_covered() -> None:
    """Empty on either side."""
    assert (
        len(
            match_human_labels(
                np.zeros((0, 7)), as_categories([]), labels(("added", "Car", BOX))
            ).label
        )
        == 0
    )
    assert match_human_labels(BOX[None], as_categories(["Car"]), labels()).label.tolist() == [-1]


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(0, 60), st.floats(-20, 20)), min_size=1, max_size=8))
def test_every_object_leads_at_most_one_prediction(places: list[tuple[float, float]]) -> None:
    """And only one that it covers."""
    boxes = np.tile(BOX, (len(places), 1))
    boxes[:, :2] = places
    human = labels(*(("accepted", "Car", box) for box in boxes[::2]))
    covered = match_human_labels(boxes, as_categories(["Car"] * len(boxes)), human)
    assert (covered.label[::2] >= 0).all()
    led = covered.label[covered.leads]
    assert len(led) == len(set(led.tolist()))
    assert (led >= 0).all()


def test_a_later_decision_replaces_an_earlier_one() -> None:
    """About the same object; a rejection only one of its own category."""
    former = labels(("accepted", "Car", BOX))
    assert superseded(former, labels(("moved", "Van", along(0.7)))).tolist() == [True]
    assert superseded(former, labels(("rejected", "Car", BOX))).tolist() == [True]
    assert superseded(former, labels(("rejected", "Pedestrian", BOX))).tolist() == [False]
    assert superseded(former, labels(("added", "Car", along(0.2)))).tolist() == [False]


def test_overlapping_objects_are_found() -> None:
    """A rejected box may lie in an object."""
    assert overlapping_objects(
        labels(("accepted", "Car", BOX), ("accepted", "Van", along(0.9)))
    ) == [(0, 1)]
    assert overlapping_objects(labels(("accepted", "Car", BOX), ("rejected", "Van", BOX))) == []
