"""Fused boxes: the weighted mean of a prediction and its matched repredictions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from curate.detections import Detections, as_categories
from curate.fusion import fuse_boxes

CAR = [10.0, 2.0, -0.8, 4.0, 1.8, 1.5, 0.3]
NONE = np.zeros(0, dtype=np.int64)


def cars(boxes, scores) -> Detections:
    """Return detections of cars."""
    boxes = np.reshape(np.array(boxes, dtype=np.float64), (-1, 7))
    return Detections(
        boxes, np.array(scores, dtype=np.float64), as_categories(["Car"] * len(boxes))
    )


def fused(own, others, scores):
    """Return the fused box of one prediction that all others are matched with."""
    boxes, count = fuse_boxes(
        cars([own], scores[:1]), cars(others, scores[1:]), np.zeros(len(others), dtype=np.int64)
    )
    assert count.tolist() == [1 + len(others)]
    return boxes[0]


def off_axis(angle):
    """Return the distance of a direction from the line it is compared with, modulo half a turn."""
    return np.abs((angle + np.pi / 2) % np.pi - np.pi / 2)


def test_the_mean_by_hand():
    """Scores 0.9, 0.6 and 0.3: weights 0.81, 0.36 and 0.09, together 1.26."""
    others = [[10.4, 2, -0.8, 4.2, 1.8, 1.5, 0.4], [9.0, 2, -0.5, 4.0, 1.8, 1.5, 0.3]]
    found = fused(CAR, others, [0.9, 0.6, 0.3])
    assert found[0] == pytest.approx(10 + (0.36 * 0.4 - 0.09 * 1) / 1.26)
    assert found[2] == pytest.approx(-0.8 + 0.09 * 0.3 / 1.26)
    assert found[3] == pytest.approx(4 + 0.36 * 0.2 / 1.26)
    sine, cosine = 0.36 * np.sin(0.2), 0.9 + 0.36 * np.cos(0.2)
    assert found[6] == pytest.approx(0.3 + np.arctan2(sine, cosine) / 2)
    assert found[[1, 4, 5]].tolist() == [2.0, 1.8, 1.5]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_the_mean_minimises_the_weighted_squared_distance(seed, views):
    """No point of a grid around it, and no angle of a fine grid, has a lower sum."""
    rng = np.random.default_rng(seed)
    boxes = np.array(CAR) + rng.normal(0, 0.2, (1 + views, 7))
    boxes[:, 6] += rng.choice([0, np.pi, -np.pi], 1 + views)
    scores = rng.uniform(0.1, 1, 1 + views)
    found, weights = fused(boxes[0], boxes[1:], scores), scores**2

    for column in range(6):
        grid = found[column] + np.linspace(-0.5, 0.5, 1001)
        distance = weights @ (boxes[:, column, None] - grid) ** 2
        assert grid[distance.argmin()] == pytest.approx(found[column], abs=1e-3)
    angles = np.linspace(-np.pi, np.pi, 20001)
    distance = weights @ np.sin(boxes[:, 6, None] - angles) ** 2
    assert off_axis(angles[distance.argmin()] - found[6]) < 1e-3


@pytest.mark.parametrize("turn", [np.pi, -np.pi, 3 * np.pi])
def test_a_heading_the_other_way_round_keeps_the_direction_of_the_label(turn):
    """The mean of 0.3 and 0.5 + half a turn is 0.4, not 0.4 + half a turn, nor across."""
    other = [*CAR[:6], 0.5 + turn]
    assert fused(CAR, [other], [0.8, 0.8])[6] == pytest.approx(0.4)
    assert fused(other, [CAR], [0.8, 0.8])[6] == pytest.approx(0.4 - np.pi)


def test_the_yaw_stays_in_its_range():
    """Across the end of the range: the mean of 3.1 and -3.1 is pi."""
    found = fused([*CAR[:6], 3.1], [[*CAR[:6], -3.1]], [0.5, 0.5])
    assert abs(found[6]) == pytest.approx(np.pi)
    assert -np.pi < found[6] <= np.pi


def test_headings_without_a_mean_leave_that_of_the_label():
    """Two of equal weight at a right angle."""
    assert fused(CAR, [[*CAR[:6], 0.3 + np.pi / 2]], [0.5, 0.5])[6] == pytest.approx(0.3)


def test_labels_without_a_match_stay_exactly_as_they_are():
    """Also among others, and in a frame without labels or repredictions."""
    third = [1 / 3, *CAR[1:6], -3.0]
    predictions = cars([third, CAR], [0.7, 0.2])
    view = cars([[10.2, *CAR[1:]], [50, *CAR[1:]]], [0.2, 0.9])
    boxes, count = fuse_boxes(predictions, view, np.array([1, -1]))
    assert boxes[0].tolist() == third
    assert boxes[1, 0] == pytest.approx(10.1)
    assert count.tolist() == [1, 2]
    assert fuse_boxes(predictions, cars([], []), NONE)[0].tolist() == predictions.boxes.tolist()
    boxes, count = fuse_boxes(cars([], []), view, np.array([-1, -1]))
    assert (boxes.shape, count.shape) == ((0, 7), (0,))


def test_scores_of_zero_count_for_nothing():
    """The prediction alone counts if all scores are 0, its repredictions alone if only its is."""
    other = [12.0, *CAR[1:]]
    assert fused(CAR, [other], [0.0, 0.0])[0] == pytest.approx(10)
    assert fused(CAR, [other], [0.0, 0.5])[0] == pytest.approx(12)
    assert fused(CAR, [other], [0.5, 0.0])[0] == pytest.approx(10)


def test_the_order_of_the_views_does_not_matter():
    """Up to the rounding of sums."""
    rng = np.random.default_rng(1)
    others = np.array(CAR) + rng.normal(0, 0.3, (5, 7))
    scores = rng.uniform(0.1, 1, 6)
    one = fused(CAR, others, scores)
    other = fused(CAR, others[::-1], [scores[0], *scores[:0:-1]])
    np.testing.assert_allclose(one, other, rtol=1e-12)
