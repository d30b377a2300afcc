"""Changes of labels between rounds."""

import numpy as np
import pytest

from curate.errors import ConfigError
from curate.evaluation.label_changes import RoundLabels, compare_labels
from curate.geometry.overlap import bev_iou


def labels(rows):
    """Return labels from (frame, category, x, weight): cars of 4 x 2 m along x."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    boxes = np.tile([0.0, 0, 0, 4, 2, 1.5, 0], (len(table), 1))
    boxes[:, 0] = table[:, 2]
    return RoundLabels(table[:, 0].astype(int), table[:, 1].astype(int), boxes, table[:, 3])


def test_labels_are_matched_within_frame_and_category():
    """The nearer of two; another frame or category is not a match."""
    before = labels([(0, 0, 10, 0.5), (0, 0, 30, 0.2), (1, 0, 10, 0.9), (2, 1, 5, 0.3)])
    after = labels([(0, 0, 11, 0.4), (0, 0, 10.5, 0.7), (1, 1, 10, 1.0), (2, 1, 5, 0.3)])
    found = compare_labels(before, after)
    assert found.pairs.tolist() == [[0, 1], [3, 3]]
    assert found.iou == pytest.approx([3.5 / 4.5, 1.0])
    assert found.lost.tolist() == [1, 2]
    assert found.gained.tolist() == [0, 2]
    assert found.weight_change == pytest.approx([0.2, 0.0])


def test_the_largest_changes_come_first():
    """A lost label falls to 0, a gained one rises from it; unchanged ones are not listed."""
    before = labels([(0, 0, 10, 0.5), (1, 0, 10, 0.9), (2, 1, 5, 0.3)])
    after = labels([(0, 0, 10, 0.7), (1, 1, 10, 1.0), (2, 1, 5, 0.3)])
    rows, change = compare_labels(before, after).largest(10)
    assert rows.tolist() == [[-1, 1], [1, -1], [0, 0]]
    assert change == pytest.approx([1.0, -0.9, 0.2])
    assert len(compare_labels(before, after).largest(2)[1]) == 2


def test_no_labels():
    """In either round or both."""
    some, none = labels([(0, 0, 10, 0.5)]), labels([])
    assert compare_labels(some, none).lost.tolist() == [0]
    assert compare_labels(none, some).gained.tolist() == [0]
    assert len(compare_labels(none, none).largest(5)[0]) == 0


def test_greedy_matching_equals_a_plain_loop():
    """Crowded random boxes: one to one, and no unmatched pair overlaps more."""
    rng = np.random.default_rng(3)
    sides = [
        labels(np.column_stack([
            rng.integers(0, 4, 80), rng.integers(0, 2, 80), rng.uniform(0, 40, 80), rng.random(80)
        ]))
        for _ in range(2)
    ]  # fmt: skip
    found = compare_labels(*sides, minimum_iou=0.2)
    iou = bev_iou(sides[0].boxes, sides[1].boxes)
    same = sides[0].frames[:, None] == sides[1].frames
    same &= sides[0].categories[:, None] == sides[1].categories
    iou = np.where(same & (iou > 0.2), iou, 0)
    expected = set()
    while iou.max() > 0:
        row, column = np.unravel_index(iou.argmax(), iou.shape)
        expected.add((int(row), int(column)))
        iou[row], iou[:, column] = 0, 0
    assert set(map(tuple, found.pairs.tolist())) == expected
    assert len(expected) > 20


def test_an_invalid_overlap_is_rejected():
    """At 1 nothing could match."""
    with pytest.raises(ConfigError, match="minimum IoU"):
        compare_labels(labels([]), labels([]), 1.0)
