"""Captions."""

from dataclasses import replace

import numpy as np
import pytest

from curate.viewing.canvas import Canvas
from curate.viewing.tags import ShownLabels, draw_tags, place_tags

BOUNDS = np.array([0.0, 0, 400, 300])


def labels(count, weights, points=None):
    """Return labels with values for captions."""
    categories, scores = np.array(["Car"] * count), np.full(count, 0.87)
    return ShownLabels(np.zeros((count, 7)), categories, scores, np.array(weights), points)


def drawn(shown, anchors):
    """Return which pixels the captions cover."""
    canvas = Canvas(400, 300, (255, 255, 255))
    draw_tags(canvas, shown, np.array(anchors, dtype=np.float64), BOUNDS)
    return (canvas.finish() < 250).any(axis=2)


def placed(shown, anchors):
    """Return captions and their positions."""
    return place_tags(Canvas(400, 300, (0, 0, 0)), shown, np.array(anchors, dtype=float), BOUNDS)


def common_areas(tags):
    """Return the common areas of all pairs of captions."""
    return [
        np.prod(np.maximum(np.minimum(a.place, b.place)[2:] - np.maximum(a.place, b.place)[:2], 0))
        for i, a in enumerate(tags)
        for b in tags[:i]
    ]


def test_captions_start_with_k():
    """Then the weight; the points only if they were counted."""
    assert labels(1, [0.5], np.array([12])).caption(0) == ("k0  0.50", "Car 0.87  12 pts")
    assert labels(1, [0.5]).caption(0) == ("k0  0.50", "Car 0.87")
    assert labels(2, [0.5, 0.0]).caption(1) == ("", "k1  Car 0.87")
    assert labels(1, [np.nan]).caption(0) == ("", "k0  Car 0.87")
    shown = replace(labels(1, [0.5]), numbers=np.array([7]))
    assert shown.caption(0)[0] == "k7  0.50"
    assert shown.short_caption(0) == "k7"


def test_captions_show_decisions_of_people():
    """Without room for more, at least the decision; a score of 1 is not one of a detector."""
    decisions = np.array(["moved", "rejected", ""])
    shown = replace(labels(3, [1.0, 0.0, 0.5], np.array([12, 3, 4])), decisions=decisions)
    assert shown.caption(0) == ("k0  1.00", "Car  moved by a person  12 pts")
    assert shown.caption(1) == ("", "k1  Car 0.87  rejected by a person  3 pts")
    assert shown.caption(2) == ("k2  0.50", "Car 0.87  4 pts")
    assert [shown.short_caption(i) for i in range(3)] == ["k0 moved", "k1 rejected", "k2"]
    assert shown.is_human.tolist() == [True, False, False]
    assert shown.is_rejected.tolist() == [False, True, False]
    assert not labels(2, [0.5, 0.0]).is_human.any()


def test_a_caption_is_beside_its_box():
    """Near the box, but not over it."""
    covered = drawn(labels(1, [0.5]), [[180, 140, 220, 160]])
    assert covered.any()
    assert not covered[141:159, 181:219].any()
    rows, columns = np.nonzero(covered)
    assert rows.min() > 90
    assert rows.max() < 210
    assert columns.min() > 90
    assert columns.max() < 310


def test_invisible_boxes_have_no_caption():
    """NaN anchors are left out."""
    assert not drawn(labels(1, [0.5]), [[np.nan] * 4]).any()


@pytest.mark.parametrize("seed", range(5))
def test_every_label_shows_its_k_and_captions_do_not_overlap(seed):
    """In a crowd, the highest weights have full captions, the others at least their number."""
    generator = np.random.default_rng(seed)
    low = generator.uniform([0, 0], [380, 280], (25, 2))
    anchors = np.concatenate([low, low + generator.uniform(5, 60, (25, 2))], axis=1)
    shown = labels(25, np.linspace(0.04, 1, 25))
    tags = placed(shown, anchors)
    assert sorted(tag.index for tag in tags) == list(range(25))
    for tag in tags:
        assert f"k{tag.index}" in " ".join(tag.lines).split()
        assert (tag.place[:2] >= BOUNDS[:2]).all()
        assert (tag.place[2:] <= BOUNDS[2:]).all()
    assert not any(common_areas(tags))
    whole = [tag.index for tag in tags if tag.lines == shown.caption(tag.index)]
    assert len(whole) >= 5
    assert whole == sorted(whole, reverse=True)


def test_lines_connect_crowded_boxes_with_their_numbers():
    """Up to four captions fit around the box; the other numbers are farther away."""
    tags = placed(labels(20, np.linspace(0.1, 1, 20)), [[190, 140, 210, 160]] * 20)
    assert 2 <= sum(bool(tag.lines[0]) for tag in tags) <= 4
    assert sum(not tag.beside for tag in tags) >= 12
    assert not any(common_areas(tags))
    # The lines start in the middle of the box.
    assert drawn(labels(20, np.linspace(0.1, 1, 20)), [[190, 140, 210, 160]] * 20)[150, 200]
    assert not drawn(labels(1, [1.0]), [[190, 140, 210, 160]])[150, 200]


def test_a_box_that_fills_the_image_has_its_number_inside():
    """There is no space beside it."""
    [tag] = placed(labels(1, [0.5]), [[-100, -100, 500, 400]])
    assert tag.lines == ("", "k0")
    assert (tag.place >= 0).all()


def test_without_labels_nothing_is_drawn():
    assert not drawn(labels(0, []), np.zeros((0, 4))).any()
