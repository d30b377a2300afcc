"""The image overlay."""

import numpy as np
import pytest
from support.shown_labels import labels
from support.toys import toy_calibration

from curate.geometry.boxes import box_corners
from curate.geometry.projection import project_points
from curate.viewing.legend import STRIP_HEIGHT, TITLE_HEIGHT
from curate.viewing.overlay import box_strokes, draw_overlay
from curate.viewing.palette import weight_colours

SIZE = (1200, 400)


def calibration():
    """Return the toy camera with a focal length for a large image."""
    toy = toy_calibration()
    toy.projection[:] = [[600, 0, 600, 0], [0, 600, 200, 0], [0, 0, 1, 0]]
    return toy


def test_strokes_are_the_edges_of_the_projected_box():
    """Twelve edges between the projected corners, the front face first."""
    box = np.array([[15.0, 1, 0, 4, 2, 1.5, 0.3]])
    [strokes] = box_strokes(box, calibration(), SIZE)
    corners, _ = project_points(box_corners(box)[0], calibration())
    assert strokes.shape == (12, 2, 2)
    for end in strokes.reshape(-1, 2):
        assert np.linalg.norm(corners - end, axis=1).min() < 1e-6
    lengths = {tuple(sorted(map(tuple, np.rint(stroke).tolist()))) for stroke in strokes}
    assert len(lengths) == 12
    front = corners[[0, 3, 7, 4]]
    for end in strokes[:4].reshape(-1, 2):
        assert np.linalg.norm(front - end, axis=1).min() < 1e-6


def test_boxes_behind_the_camera_have_no_strokes():
    """Nor do boxes beside the image; one that is half behind has finite ones."""
    boxes = np.array([
        [-15.0, 1, 0, 4, 2, 1.5, 0.3], [5, 60, 0, 4, 2, 1.5, 0], [1.0, -1.5, 0, 4, 2, 1.5, 0],
    ])  # fmt: skip
    behind, beside, partly = box_strokes(boxes, calibration(), SIZE)
    assert len(behind) == len(beside) == 0
    assert 0 < len(partly) < 12
    assert np.isfinite(partly).all()


def test_without_boxes_the_frame_is_unchanged():
    image = np.full((400, 1200, 3), 90, np.uint8)
    drawn = draw_overlay(image, calibration(), labels([], []), np.zeros((0, 7)))
    assert drawn.shape == (400 + TITLE_HEIGHT + STRIP_HEIGHT, 1200, 3)
    assert (drawn[TITLE_HEIGHT:-STRIP_HEIGHT] == 90).all()


@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
def test_boxes_have_the_colour_of_their_weight(weight):
    """Checked along an edge, on the image."""
    shown = labels([[15.0, 1, 0, 4, 2, 1.5, 0.3]], [weight])
    drawn = draw_overlay(np.full((400, 1200, 3), 90, np.uint8), calibration(), shown)
    stroke = box_strokes(shown.boxes, calibration(), SIZE)[0][1]
    column, row = np.rint(stroke.mean(axis=0)).astype(int)
    around = drawn[row + TITLE_HEIGHT - 2 : row + TITLE_HEIGHT + 3, column - 2 : column + 3]
    colour = weight_colours(np.array([weight]))[0].astype(int)
    assert (np.abs(around.astype(int) - colour).max(axis=2) < 30).any()


def test_small_images_are_enlarged():
    """By an integer factor, so that captions can be read."""
    drawn = draw_overlay(np.zeros((40, 500, 3), np.uint8), calibration(), labels([], []))
    assert drawn.shape[:2] == (40 * 3 + TITLE_HEIGHT + STRIP_HEIGHT, 1500)


def test_ground_truth_can_be_drawn():
    """It changes the image; regions without a box are left out."""
    image = np.full((400, 1200, 3), 90, np.uint8)
    truth = np.array([[15.0, 1, 0, 4, 2, 1.5, 0.3], [np.nan] * 7])
    nothing = draw_overlay(image, calibration(), labels([], []), np.zeros((0, 7)))
    drawn = draw_overlay(image, calibration(), labels([], []), truth)
    changed = drawn[(drawn != nothing).any(axis=2)]
    assert len(changed) > 100
    assert changed.max() > 230


def test_a_huge_box_is_drawn_within_limits():
    """Points clipped at the near plane lie on it, despite rounding errors of huge numbers."""
    boxes = np.array([[20.0, 0, 0, 3e38, 3e38, 3e38, 0.3], [3e38, 0, 0, 3e38, 3e38, 3e38, 0.3]])
    for strokes in box_strokes(boxes, calibration(), SIZE):
        assert np.isfinite(strokes).all()
