"""Rotated non-maximum suppression against its definition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import suppression
from support.strategies import box_arrays

from curate.geometry.nms import nms_bev


@settings(max_examples=100)
@given(
    box_arrays(max_size=10),
    st.lists(st.sampled_from([0.1, 0.5, 0.5000001, 0.9]), min_size=10, max_size=10),
    st.sampled_from([0.0, 0.123, 0.4321, 0.777]),
)
def test_it_keeps_the_same_boxes_as_the_definition(boxes, scores, threshold):
    """Small sets, many of them touching or equal, with equal scores."""
    boxes = boxes[np.all(boxes[:, 3:6] > 0, axis=1)]
    scores = np.array(scores[: len(boxes)])
    kept = nms_bev(boxes, scores, threshold + 1e-6)
    assert kept.dtype == np.int64
    assert kept.tolist() == suppression.nms(boxes, scores, threshold + 1e-6)


@pytest.mark.parametrize("threshold", [0.05, 0.5, 0.7])
def test_it_keeps_the_same_boxes_over_a_wide_field(threshold):
    """Clusters over many grid cells, and one box larger than all others."""
    generator = np.random.default_rng(1)
    centres = generator.uniform(-60, 60, (25, 2))[generator.integers(25, size=200)]
    boxes = generator.uniform([-1, -1, 0, 1, 1, 1, -3], [1, 1, 0, 5, 3, 2, 3], (200, 7))
    boxes[:, :2] += centres
    boxes[0, 3:5] = 40
    scores = generator.random(200)
    expected = suppression.nms(boxes, scores, threshold)
    assert nms_bev(boxes, scores, threshold).tolist() == expected


def test_equal_scores_are_ranked_by_index():
    """Of two copies with the same score the first is kept."""
    box = np.array([[0, 0, 0, 4.0, 2.0, 1.5, 0.5]])
    assert nms_bev(np.repeat(box, 3, axis=0), np.array([0.5, 0.7, 0.7]), 0.5).tolist() == [1]


def test_no_boxes_give_no_boxes():
    assert nms_bev(np.zeros((0, 7)), np.zeros(0), 0.1).tolist() == []


def test_boxes_far_apart_or_not_finite_are_kept():
    """An outlier kilometres away or a NaN neither breaks the grid nor hides a duplicate."""
    box = np.array([0, 0, 0, 4.0, 2.0, 1.5, 0.5])
    boxes = np.stack([box, np.add(box, [1e7, -1e9, 0, 0, 0, 0, 0]), box * np.nan, box])
    with np.errstate(invalid="ignore"):
        assert nms_bev(boxes, np.array([0.9, 0.8, 0.7, 0.6]), 0.5).tolist() == [0, 1, 2]
