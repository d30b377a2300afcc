"""IoU of rotated boxes against polygon clipping and random points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import clipping
from support.strategies import angles, box_arrays

from curate.geometry import overlap
from curate.geometry.overlap import bev_iou, iou_3d, overlapping_pairs, paired_iou_3d

CAR = np.array([12.3, -4.7, -0.8, 4.2, 1.7, 1.55, 0.3])


def by_clipping(overlap, boxes_a, boxes_b):
    """Return (n, m) IoU of the oracle."""
    return np.array([[overlap(a, b) for b in boxes_b] for a in boxes_a]).reshape(
        len(boxes_a), len(boxes_b)
    )


@settings(max_examples=150)
@given(box_arrays(), box_arrays())
def test_iou_equals_polygon_clipping(boxes_a, boxes_b):
    """Random and degenerate boxes, in BEV and in 3D."""
    expected = by_clipping(clipping.bev_iou, boxes_a, boxes_b)
    assert np.allclose(bev_iou(boxes_a, boxes_b), expected, rtol=0, atol=1e-6)
    expected = by_clipping(clipping.iou_3d, boxes_a, boxes_b)
    assert np.allclose(iou_3d(boxes_a, boxes_b), expected, rtol=0, atol=1e-6)


@settings(max_examples=150)
@given(box_arrays(), box_arrays())
def test_paired_iou_is_the_diagonal(boxes_a, boxes_b):
    n = min(len(boxes_a), len(boxes_b))
    expected = np.diagonal(iou_3d(boxes_a[:n], boxes_b[:n]))
    assert np.array_equal(paired_iou_3d(boxes_a[:n], boxes_b[:n]), expected)


@settings(max_examples=150)
@given(box_arrays(), box_arrays())
def test_iou_is_symmetric_and_within_0_and_1(boxes_a, boxes_b):
    """Bit for bit the same in both orders, never NaN."""
    for iou in (bev_iou, iou_3d):
        matrix = iou(boxes_a, boxes_b)
        assert np.array_equal(matrix, iou(boxes_b, boxes_a).T)
        assert np.all((matrix >= 0) & (matrix <= 1))


@settings(max_examples=200)
@given(
    st.tuples(*[st.floats(-80.0, 80.0)] * 3),
    st.tuples(*[st.floats(0.01, 30.0)] * 3),
    angles,
)
def test_a_box_has_iou_exactly_1_with_itself(centre, sides, yaw):
    """Also after half turns, and after a quarter turn with swapped sides."""
    length, width, height = sides
    half_turn = yaw + np.pi if yaw <= 0 else yaw - np.pi
    boxes = np.array(
        [
            [*centre, length, width, height, yaw],
            [*centre, length, width, height, half_turn],
            [*centre, length, width, height, yaw - 2 * np.pi],
            [*centre, width, length, height, yaw + np.pi / 2],
        ]
    )
    assert np.all(bev_iou(boxes, boxes) == 1.0)
    assert np.all(iou_3d(boxes, boxes) == 1.0)


def test_random_points_give_the_same_overlap():
    """An estimate that does not use polygons."""
    generator = np.random.default_rng(0)
    other = np.add(CAR, [0.6, 0.4, 0, 0.5, -0.2, 0, 0.7])
    expected = clipping.bev_iou_by_sampling(CAR, other, generator, 200_000)
    assert bev_iou(CAR[None], other[None])[0, 0] == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("turn", [0.0, 1e-15, 1e-13, 1e-11, 1e-9, 1e-6, 1e-3])
def test_iou_is_continuous_for_nearly_parallel_edges(turn):
    """IoU changes no faster than the angle, also where the aligned case takes over."""
    copies = np.stack([CAR, np.add(CAR, [0, 0, 0, 0, 0, 0, turn])])
    assert bev_iou(copies, copies)[0, 1] == pytest.approx(1, abs=4 * turn + 1e-12)


def test_boxes_that_touch_do_not_overlap():
    """A shared side, corner or end face has no area or volume."""
    box = np.array([[0, 0, 0, 2.0, 2.0, 2.0, 0]])
    beside = np.add(box, [2.0, 0, 0, 0, 0, 0, 0])
    corner = np.add(box, [2.0, 2.0, 0, 0, 0, 0, 0])
    above = np.add(box, [0, 0, 2.0, 0, 0, 0, 0])
    assert bev_iou(box, np.vstack([beside, corner])).tolist() == [[0, 0]]
    assert iou_3d(box, above).tolist() == [[0]]
    assert bev_iou(box, above).tolist() == [[1]]


def test_a_nested_box_has_the_ratio_of_the_areas():
    """A small rotated box inside a large one."""
    outer, inner = np.array([[5, 5, 0, 10.0, 8.0, 4.0, 0.4]]), np.array([[5, 5, 0, 2.0, 1, 1, 1.1]])
    assert bev_iou(outer, inner)[0, 0] == pytest.approx(2 / 80, rel=1e-12)
    assert iou_3d(outer, inner)[0, 0] == pytest.approx(2 / 320, rel=1e-12)


@pytest.mark.parametrize("column", range(7))
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_boxes_that_are_not_finite_overlap_nothing(column, value):
    """NaN and infinity give 0, never NaN."""
    broken = CAR.copy()
    broken[column] = value
    both = np.stack([broken, CAR])
    with np.errstate(invalid="ignore"):
        assert iou_3d(both, both).tolist() == [[0, 0], [0, 1]]


@pytest.mark.parametrize("sides", [(0, 1, 1), (1, 0, 1), (-1, -1, 1), (-1, 1, 1)])
def test_flat_and_negative_boxes_overlap_nothing(sides):
    """A box without area overlaps neither another nor itself."""
    boxes = np.stack([np.array([0, 0, 0, *sides, 0.2]), np.array([0, 0, 0, 3, 3, 3, 0])])
    assert bev_iou(boxes, boxes).tolist() == [[0, 0], [0, 1]]
    assert iou_3d(boxes, boxes).tolist() == [[0, 0], [0, 1]]


def test_no_boxes_give_an_empty_matrix():
    """Zero boxes on either side keep the shape."""
    none = np.zeros((0, 7))
    assert bev_iou(none, CAR[None]).shape == (0, 1)
    assert iou_3d(CAR[None], none).shape == (1, 0)


def test_many_boxes_over_a_wide_field_agree_with_clipping():
    """The sweep over x loses no pair."""
    generator = np.random.default_rng(3)
    low, high = [-20, -20, 0, 0.3, 0.3, 1, -3], [20, 20, 1, 12, 4, 2, 3]
    boxes_a, boxes_b = generator.uniform(low, high, (2, 40, 7))
    expected = by_clipping(clipping.bev_iou, boxes_a, boxes_b)
    assert np.sum(expected > 0) > 50
    assert np.allclose(bev_iou(boxes_a, boxes_b), expected, rtol=0, atol=1e-9)


def test_pairs_of_groups_are_the_matrices_of_each_group():
    """Groups, also empty ones, never mix, and pairs ascend."""
    generator = np.random.default_rng(4)
    low, high = [-3, -3, 0, 1, 1, 1, -3], [3, 3, 1, 4, 4, 2, 3]
    boxes_a, boxes_b = generator.uniform(low, high, (2, 9, 7))
    starts_a, starts_b = np.array([0, 4, 4, 9]), np.array([0, 2, 6, 9])
    rows, columns, bev, volume = overlapping_pairs(boxes_a, starts_a, boxes_b, starts_b)
    group_a = np.repeat([0, 1, 2], np.diff(starts_a))
    group_b = np.repeat([0, 1, 2], np.diff(starts_b))
    matrix = bev_iou(boxes_a, boxes_b) * (group_a[:, None] == group_b)
    assert np.array_equal(np.argwhere(matrix > 0), np.stack([rows, columns], axis=1))
    assert np.array_equal(bev, matrix[rows, columns])
    assert np.array_equal(volume, iou_3d(boxes_a, boxes_b)[rows, columns])


def test_no_groups_give_no_pairs():
    none, starts = np.zeros((0, 7)), np.zeros(1, dtype=np.int64)
    assert [len(part) for part in overlapping_pairs(none, starts, none, starts)] == [0, 0, 0, 0]


@pytest.mark.parametrize("block", [1, 7, 1 << 20])
def test_the_pairs_of_groups_do_not_depend_on_the_blocks(monkeypatch, block):
    """Every pair of a group is yielded once, in ascending order, with empty groups between."""
    monkeypatch.setattr(overlap, "_BLOCK", block)
    generator = np.random.default_rng(block)
    sizes = generator.integers(0, 4, (2, 30)) * (generator.random((2, 30)) < 0.7)
    for used in (sizes, sizes[:, :0], sizes * [[0], [1]], sizes * [[1], [0]]):
        starts_a, starts_b = (np.concatenate([[0], np.cumsum(part)]) for part in used)
        blocks = list(overlap.pairs_within_groups(starts_a, starts_b))
        assert blocks
        found = [pair for rows, columns in blocks for pair in zip(rows, columns, strict=True)]
        expected = [
            (i, j)
            for group in range(used.shape[1])
            for i in range(starts_a[group], starts_a[group + 1])
            for j in range(starts_b[group], starts_b[group + 1])
        ]
        assert found == expected
