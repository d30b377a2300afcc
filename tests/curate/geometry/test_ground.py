"""The height of the ground, beside walls, under strays and where nothing was seen."""

import numpy as np

from curate.geometry.ground import GroundMap


def plane(slope=0.0):
    """Points every metre on a plane that rises with x."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.0, 40), np.arange(-20.0, 20)))
    return np.column_stack([x, y, -1.7 + slope * x, np.zeros(len(x))])


def test_a_plane_has_its_height_everywhere():
    """On a gentle slope the height is that of the place, to a few centimetres."""
    places = np.array([[10.0, 0.0], [30.0, -10.0]])
    heights = GroundMap.of(plane(slope=0.01)).at(places)
    np.testing.assert_allclose(heights, [-1.6, -1.4], atol=0.06)


def test_a_wall_beside_the_place_does_not_raise_the_ground():
    """Where half of the surroundings are hidden by something high, the other half counts."""
    points = plane()
    points[points[:, 1] > 3, 2] = 2.0
    assert GroundMap.of(points).at(np.array([[20.0, 2.0]]))[0] == -1.7


def test_one_stray_point_below_does_not_lower_it():
    """A reflection from below the ground is passed over."""
    stray = np.array([[20.0, 0.0, -9.0, 0.0]])
    assert GroundMap.of(np.concatenate([plane(), stray])).at(stray[:, :2])[0] == -1.7


def test_where_nothing_was_seen_the_height_is_unknown():
    """Far from all points, also off the map, there is no height."""
    heights = GroundMap.of(plane()).at(np.array([[500.0, 0.0], [-500.0, -500.0], [20.0, 0.0]]))
    assert np.isnan(heights).tolist() == [True, True, False]
