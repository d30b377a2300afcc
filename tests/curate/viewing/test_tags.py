"""Tests of captions."""

import numpy as np

from curate.viewing.canvas import Canvas
from curate.viewing.tags import ShownLabels, draw_tags

BOUNDS = np.array([0.0, 0, 400, 300])


def labels(count, weights, points=None):
    """Labels of which only the captions matter."""
    categories, scores = np.array(["Car"] * count), np.full(count, 0.87)
    return ShownLabels(np.zeros((count, 7)), categories, scores, np.array(weights), points)


def drawn(shown, anchors):
    """Which pixels the captions cover."""
    canvas = Canvas(400, 300, (255, 255, 255))
    draw_tags(canvas, shown, np.array(anchors, dtype=np.float64), BOUNDS)
    return (canvas.finish() < 250).any(axis=2)


def test_captions_tell_category_score_weight_and_points():
    """The points are told only where they were counted."""
    assert labels(1, [0.5], np.array([12])).caption(0) == ("0.50", "Car 0.87  12 pts")
    assert labels(1, [0.5]).caption(0) == ("0.50", "Car 0.87")
    assert labels(1, [0.0]).caption(0) == ("", "Car 0.87")


def test_a_caption_stands_beside_its_box():
    """Near the box, but not over it."""
    covered = drawn(labels(1, [0.5]), [[180, 140, 220, 160]])
    assert covered.any()
    assert not covered[141:159, 181:219].any()
    rows, columns = np.nonzero(covered)
    assert rows.min() > 90
    assert rows.max() < 210
    assert columns.min() > 90
    assert columns.max() < 310


def test_boxes_that_are_not_seen_have_no_caption():
    """NaN anchors are left out."""
    assert not drawn(labels(1, [0.5]), [[np.nan] * 4]).any()


def test_captions_stay_in_bounds_and_give_way_to_higher_weights():
    """Where all boxes are at one place, four captions fit around it, not twenty."""
    anchors = [[0, 0, 400, 300]]
    assert not drawn(labels(1, [0.5]), anchors).any()
    anchors = [[190, 140, 210, 160]] * 20
    many = drawn(labels(20, np.linspace(0.1, 1, 20)), anchors).sum()
    one = drawn(labels(1, [1.0]), anchors[:1]).sum()
    assert one < many <= 4.5 * one


def test_no_labels():
    """Nothing is drawn."""
    assert not drawn(labels(0, []), np.zeros((0, 4))).any()
