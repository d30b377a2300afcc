"""Corners of boxes."""

import numpy as np
import pytest
from hypothesis import given
from support.strategies import box_arrays

from curate.geometry.boxes import bev_corners, box_corners


def test_a_box_along_x_has_the_corners_of_its_sides():
    """Without yaw the corners are the centre plus and minus half the sides."""
    box = np.array([[10.0, 2.0, -1.0, 4.0, 2.0, 1.5, 0.0]])
    assert bev_corners(box).tolist() == [[[12, 3], [8, 3], [8, 1], [12, 1]]]
    assert box_corners(box)[0, :, 2].tolist() == [-1.75] * 4 + [-0.25] * 4


def test_yaw_turns_counter_clockwise():
    """A quarter turn moves the front to the left."""
    front_left = bev_corners(np.array([[0, 0, 0, 4.0, 2.0, 1, np.pi / 2]]))[0, 0]
    assert front_left == pytest.approx([-1, 2])


@given(box_arrays())
def test_the_cuboid_stands_on_the_footprint(boxes):
    """Bottom and top are the footprint, the corners' mean the centre; sides keep their length."""
    corners, footprints = box_corners(boxes), bev_corners(boxes)
    assert corners.shape == (len(boxes), 8, 3)
    assert np.array_equal(corners[:, :4, :2], footprints)
    assert np.array_equal(corners[:, 4:, :2], footprints)
    assert np.allclose(corners.mean(axis=1), boxes[:, :3])
    assert np.allclose(np.linalg.norm(footprints[:, 0] - footprints[:, 1], axis=1), boxes[:, 3])
    assert np.allclose(np.linalg.norm(footprints[:, 1] - footprints[:, 2], axis=1), boxes[:, 4])


@pytest.mark.wrong_shapes
def test_arrays_that_are_not_boxes_are_rejected():
    """The error contains the shape."""
    with pytest.raises(ValueError, match=r"\(3, 6\)"):
        bev_corners(np.zeros((3, 6)))
