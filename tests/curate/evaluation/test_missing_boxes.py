"""Missing 2D boxes come from the projection of the 3D box."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.kitti_scenes import car, to_objects

from curate.evaluation.missing_boxes import with_projected_boxes, without_box

PROJECTION = np.array([[700.0, 0, 600, 40], [0, 700, 180, 2], [0, 0, 1, 0.003]])
SIZE = (1242, 375)
NOTHING = (0.0, 0.0, 0.0, 0.0)


def corners(item):
    """Return the eight corners in the camera frame, by KITTI's definition."""
    height, width, length = item["dimensions"]
    turn = item["rotation_y"]
    for right in (-length / 2, length / 2):
        for ahead in (-width / 2, width / 2):
            for up in (0, -height):
                x = math.cos(turn) * right + math.sin(turn) * ahead
                z = -math.sin(turn) * right + math.cos(turn) * ahead
                yield np.add(item["location"], (x, up, z))


@settings(max_examples=50)
@given(
    st.floats(-12, 12),
    st.floats(8, 60),
    st.floats(-3.1, 3.1),
    st.sampled_from([NOTHING, (-1.0,) * 4, (5.0, 9.0, 7.0, 9.0), (5.0, 9.0, 7.0, 3.0)]),
)
def test_the_2d_box_encloses_the_projected_corners(x, z, turn, box_2d):
    """Within the image; -1 if it is outside. The observation angle follows from the 3D box."""
    item = car(box_2d=box_2d, location=(x, 1.7, z), rotation_y=turn, alpha=0.0)
    found = with_projected_boxes(to_objects([item]), PROJECTION, SIZE)
    pixels = []
    for corner in corners(item):
        u, v, depth = PROJECTION @ np.append(corner, 1)
        pixels.append((u / depth, v / depth))
    low, high = np.min(pixels, axis=0), np.max(pixels, axis=0)
    last = np.array(SIZE) - 1
    assert found.missing == 1
    if (high > 0).all() and (low < last).all():
        expected = [*np.clip(low, 0, last), *np.clip(high, 0, last)]
        alpha = turn - math.atan2(x, z)
        assert math.cos(found.objects.alpha[0] - alpha) == pytest.approx(1)
        assert found.projected == 1
    else:
        expected = [-1] * 4
        assert found.projected == 0
    assert found.objects.boxes_2d[0] == pytest.approx(expected, abs=1e-6)


def test_objects_with_a_2d_box_and_dont_care_regions_do_not_change():
    """Not by a digit."""
    items = [car(), car(x=6, box_2d=NOTHING), car(category="DontCare", box_2d=NOTHING)]
    before = to_objects(items)
    found = with_projected_boxes(before, PROJECTION, SIZE)
    assert without_box(before).tolist() == [False, True, False]
    assert (found.missing, found.projected) == (1, 1)
    for row in (0, 2):
        assert np.array_equal(found.objects.boxes_2d[row], before.boxes_2d[row])
        assert found.objects.alpha[row] == before.alpha[row]


@pytest.mark.parametrize(("projection", "size"), [(None, SIZE), (PROJECTION, None), (None, None)])
def test_without_calibration_or_size_a_missing_box_stays_missing(projection, size):
    """As zeros, which say that there is none."""
    found = with_projected_boxes(to_objects([car(box_2d=(-1,) * 4)]), projection, size)
    assert (found.missing, found.projected) == (1, 0)
    assert found.objects.boxes_2d.tolist() == [list(NOTHING)]


def test_no_objects_are_no_problem():
    found = with_projected_boxes(to_objects([]), PROJECTION, SIZE)
    assert (len(found.objects), found.missing, found.projected) == (0, 0, 0)
