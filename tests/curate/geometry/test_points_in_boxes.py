"""Points in boxes against one test per point and box."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.containment import contains, first_box
from support.strategies import box_arrays

from curate.geometry.points_in_boxes import (
    box_of_points,
    count_points_in_boxes,
    points_in_box_mask,
)


def assert_exact(points, boxes):
    """Check that all three functions agree with the oracle."""
    table = np.array([[contains(box, point) for point in points] for box in boxes], dtype=bool)
    table = table.reshape(len(boxes), len(points))
    counts = count_points_in_boxes(points, boxes)
    assert counts.dtype == np.int64
    assert counts.tolist() == table.sum(axis=1).tolist()
    assert box_of_points(points, boxes).tolist() == [first_box(boxes, point) for point in points]
    for box, row in zip(boxes, table, strict=True):
        assert np.array_equal(points_in_box_mask(points, box), row)


@settings(max_examples=60)
@given(box_arrays(), st.integers(0, 2**32 - 1), st.sampled_from([np.float32, np.float64]))
def test_random_points_are_counted_exactly(boxes, seed, dtype):
    """Random points in and around overlapping, flat and rotated boxes."""
    generator = np.random.default_rng(seed)
    assert_exact(generator.uniform(-6, 6, (60, 4)).astype(dtype), boxes)


def test_points_over_a_wide_field_are_counted_exactly():
    """Many cells, boxes of a hundred metres and of centimetres."""
    generator = np.random.default_rng(5)
    low, high = [-60, -60, -1, 0.05, 0.05, 0.5, -3], [60, 60, 1, 9, 4, 3, 3]
    boxes = generator.uniform(low, high, (25, 7))
    boxes[3, 3:5] = 150, 90
    points = generator.uniform([-80, -80, -2], [80, 80, 2], (800, 3))
    points[:200] = boxes[generator.integers(25, size=200), :3] + generator.normal(0, 1, (200, 3))
    assert_exact(points, boxes)


def test_the_boundary_belongs_to_the_box():
    """Faces, edges and corners count; points beyond by a rounding error do not."""
    box = np.array([[1.0, 2.0, 0.5, 4.0, 2.0, 1.0, 0.0]])
    inside = np.array([[3.0, 2, 0.5], [-1, 3, 1], [3, 1, 0], [1, 2, 0], [-1, 2, 0.5]])
    outside = np.array([[np.nextafter(3, 4), 2, 0.5], [1, 1 - 1e-12, 0.5], [1, 2, 1.01]])
    assert count_points_in_boxes(inside, box).tolist() == [5]
    assert count_points_in_boxes(outside, box).tolist() == [0]


def test_the_boundary_belongs_to_boxes_turned_by_quarters():
    """The grid never drops a point that lies on the side of a box."""
    sides = np.array([[0.0, 1.0, 0.0], [0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    for yaw in (np.pi / 2, -np.pi / 2):
        box = np.array([[0.0, 0.0, 0.0, 2.0, 1.0, 1.0, yaw]])
        assert_exact(sides, box)
        assert count_points_in_boxes(sides, box).tolist() == [3]


def test_a_point_in_two_boxes_counts_in_both_and_belongs_to_the_first():
    boxes = np.array([[9.0, 0, 0, 1, 1, 1, 0], [0, 0, 0, 2, 2, 2, 0.3], [0, 0, 0, 4, 4, 4, 0]])
    point = np.zeros((1, 4), dtype=np.float32)
    assert count_points_in_boxes(point, boxes).tolist() == [0, 1, 1]
    assert box_of_points(point, boxes).tolist() == [1]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_and_boxes_that_are_not_finite_do_not_count(value):
    box = np.array([0, 0, 0, 2.0, 2.0, 2.0, 0])
    points = np.zeros((4, 3))
    points[np.arange(3), np.arange(3)] = value
    for column in (0, 1, 2, 3, 6):
        broken = box.copy()
        broken[column] = value
        with np.errstate(invalid="ignore"):
            assert count_points_in_boxes(points, np.stack([broken, box])).tolist() == [0, 1]


def test_empty_points_and_boxes():
    """No points, no boxes, or neither."""
    box = np.array([[0, 0, 0, 1.0, 1, 1, 0]])
    assert count_points_in_boxes(np.zeros((0, 4), dtype=np.float32), box).tolist() == [0]
    assert count_points_in_boxes(np.zeros((3, 4)), box[:0]).tolist() == []
    assert box_of_points(np.zeros((2, 4)), box[:0]).tolist() == [-1, -1]


def test_points_without_three_columns_are_rejected():
    """The error contains the shape."""
    with pytest.raises(ValueError, match=r"\(5, 2\)"):
        count_points_in_boxes(np.zeros((5, 2)), np.zeros((0, 7)))


def test_views_and_other_types_of_points_are_accepted():
    """Slices, Fortran order, read-only and integer arrays give the same counts."""
    generator = np.random.default_rng(6)
    points = generator.integers(-3, 4, (300, 4)).astype(np.float32)
    boxes = np.array([[0, 0, 0, 3.0, 2.0, 3.0, 0.4]])
    expected = count_points_in_boxes(points, boxes)
    frozen = points.copy()
    frozen.setflags(write=False)
    for other in (points[:, :3], np.asfortranarray(points), frozen, points.astype(int)):
        assert np.array_equal(count_points_in_boxes(other, boxes), expected)
    assert np.array_equal(count_points_in_boxes(points[::-1], boxes), expected)
