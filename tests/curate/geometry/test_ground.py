"""The height of the ground: beside walls, below outliers, and without points."""

import numpy as np
import pytest

from curate.geometry.ground import GroundMap


def plane(slope=0.0):
    """Return points every metre on a plane that rises with x."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.0, 40), np.arange(-20.0, 20)))
    return np.column_stack([x, y, -1.7 + slope * x, np.zeros(len(x))])


def test_a_plane_has_its_height_everywhere():
    """On a gentle slope the height is that of the position, to a few centimetres."""
    places = np.array([[10.0, 0.0], [30.0, -10.0]])
    heights = GroundMap.of(plane(slope=0.01)).at(places)
    np.testing.assert_allclose(heights, [-1.6, -1.4], atol=0.06)


def test_a_wall_does_not_raise_the_ground_beside_it():
    """If half of the surroundings are hidden by something high, the other half counts."""
    points = plane()
    points[points[:, 1] > 3, 2] = 2.0
    assert GroundMap.of(points).at(np.array([[20.0, 2.0]]))[0] == -1.7


def test_one_outlier_below_does_not_lower_the_ground():
    """A reflection from below the ground is ignored."""
    outlier = np.array([[20.0, 0.0, -9.0, 0.0]])
    assert GroundMap.of(np.concatenate([plane(), outlier])).at(outlier[:, :2])[0] == -1.7


def test_without_points_the_height_is_unknown():
    """Far from all points, also off the map."""
    heights = GroundMap.of(plane()).at(np.array([[500.0, 0.0], [-500.0, -500.0], [20.0, 0.0]]))
    assert np.isnan(heights).tolist() == [True, True, False]


def test_lowering_and_raising_are_inverse():
    """On a slope the ground's own points are moved to about 0, and back to the last bit."""
    points = plane(slope=0.02)
    ground = GroundMap.of(points)
    lowered = ground.lowered(points)
    assert np.abs(lowered[:, 2]).max() < 0.13
    np.testing.assert_array_equal(lowered[:, [0, 1, 3]], points[:, [0, 1, 3]])
    np.testing.assert_allclose(ground.raised(lowered), points, rtol=0, atol=1e-12)


def test_ground_without_points_has_the_usual_height():
    """A box behind all points stands on ground of the median height."""
    ground = GroundMap.of(plane())
    behind = np.array([[500.0, 0.0, -0.9, 4.0, 1.6, 1.6, 0.0]])
    assert ground.lowered(behind)[0, 2] == pytest.approx(0.8)


@pytest.mark.parametrize("count", [0, 1])
def test_few_points_do_not_fail(count):
    """Without points the ground is unknown and nothing moves; one point is its own ground."""
    points = np.full((count, 4), 3.0)
    assert GroundMap.of(points).lowered(np.full((1, 7), 3.0))[0, 2] == (0.0 if count else 3.0)


def test_points_at_absurd_distances_do_not_enlarge_the_map():
    """A damaged file may have points light years away, or NaN."""
    odd = np.array([[1e30, 0, 0, 0], [0, -np.inf, 0, 0], [np.nan, 0, 0, 0]])
    ground = GroundMap.of(np.concatenate([plane(), odd]))
    assert ground.heights.size < 1000
    assert ground.at(np.array([[20.0, 0.0]]))[0] == -1.7


def test_the_heights_are_those_of_the_definition():
    """Every square has the second lowest of the lowest points of nine squares."""
    generator = np.random.default_rng(0)
    points = generator.uniform([0, -9, -2, 0], [30, 9, 2, 1], (150, 4)).astype(np.float32)
    points[:3] = [[np.nan, 0, -9, 0], [3, 3, np.nan, 0], [900, 0, -9, 0]]
    ground = GroundMap.of(points)
    square = np.floor((points[:, :2] - ground.low) / 3.0)
    for column, row in np.ndindex(ground.heights.shape):
        lowest = []
        for place in np.ndindex(3, 3):
            near = (square == [column + place[0] - 1, row + place[1] - 1]).all(axis=1)
            lowest += [np.nanmin(points[near, 2])] if near.any() else []
        expected = sorted(lowest)[min(1, len(lowest) - 1)] if lowest else np.nan
        np.testing.assert_equal(ground.heights[column, row], expected)
