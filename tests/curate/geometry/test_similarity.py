"""The similarity A and its inverse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import box_arrays, similarities

from curate.errors import ConfigError
from curate.geometry.overlap import iou_3d
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.similarity import Similarity, wrap_angle


@given(similarities, box_arrays())
def test_the_inverse_restores_boxes(similarity, boxes):
    """A^-1(A(x)) = x and A(A^-1(x)) = x, with the yaw in (-pi, pi]."""
    for there, back in (
        (similarity.apply_to_boxes, similarity.invert_boxes),
        (similarity.invert_boxes, similarity.apply_to_boxes),
    ):
        moved = there(boxes)
        assert np.all((moved[:, 6] > -np.pi) & (moved[:, 6] <= np.pi))
        again = back(moved)
        assert np.allclose(again[:, :6], boxes[:, :6], atol=1e-9)
        turn = np.mod(again[:, 6] - boxes[:, 6] + np.pi, 2 * np.pi) - np.pi
        assert np.allclose(turn, 0, atol=1e-9)


@given(similarities, st.integers(0, 2**32 - 1), st.sampled_from([np.float32, np.float64]))
def test_points_keep_their_type_and_intensity(similarity, seed, dtype):
    """Boxes that are moved back match the points."""
    points = np.random.default_rng(seed).normal(0, 10, (20, 4)).astype(dtype)
    moved = similarity.apply_to_points(points)
    assert moved.dtype == points.dtype
    boxes = np.column_stack([moved[:, :3], np.ones((20, 3)), np.zeros(20)])
    again = similarity.invert_boxes(boxes)[:, :3]
    assert np.allclose(again, points[:, :3], atol=1e-4 if dtype is np.float32 else 1e-9)
    assert np.array_equal(moved[:, 3], points[:, 3])


@given(similarities, st.integers(0, 2**32 - 1))
def test_points_and_boxes_move_together(similarity, seed):
    """A box contains as many points after A as before, and overlaps do not change."""
    generator = np.random.default_rng(seed)
    boxes = generator.uniform([-3, -3, -1, 1, 1, 1, -3], [3, 3, 1, 6, 3, 3, 3], (4, 7))
    points = generator.uniform(-4, 4, (200, 3))
    moved_points, moved = similarity.apply_to_points(points), similarity.apply_to_boxes(boxes)
    assert np.array_equal(
        count_points_in_boxes(moved_points, moved), count_points_in_boxes(points, boxes)
    )
    assert np.allclose(iou_3d(moved, moved), iou_3d(boxes, boxes), atol=1e-9)


def test_a_is_flip_then_rotation_then_scale():
    """A worked example: the point ahead and to the left."""
    similarity = Similarity(flip_y=True, rotation_rad=np.pi / 2, scale=2.0)
    assert similarity.apply_to_points(np.array([[1.0, 3.0, 0.5]])) == pytest.approx(
        np.array([[6.0, 2.0, 1.0]])
    )
    box = similarity.apply_to_boxes(np.array([[1.0, 3.0, 0.5, 4.0, 2.0, 1.5, 0.25]]))
    assert box == pytest.approx(np.array([[6.0, 2.0, 1.0, 8.0, 4.0, 3.0, np.pi / 2 - 0.25]]))


def test_recorded_view_is_the_transformed_frame(kitti_root):
    """On real frames, recorded boxes of view 1, mapped back, match boxes of view 0."""
    path = kitti_root / "recorded" / "pointgnn_T1.csv"
    rows = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    names = ["x", "y", "z", "length", "width", "height", "yaw"]
    boxes = np.stack([rows[name] for name in names], axis=1).astype(float)
    sure = rows["score"] > 0.8
    overlaps = []
    for frame in np.unique(rows["frame"]):
        view_0 = sure & (rows["frame"] == frame) & (rows["view"] == 0)
        view_1 = sure & (rows["frame"] == frame) & (rows["view"] == 1)
        if view_0.any() and view_1.any():
            row = rows[np.flatnonzero(view_1)[0]]
            similarity = Similarity(
                str(row["flip_y"]).lower() in {"1", "true"},
                float(row["rotation_rad"]),
                float(row["scale"]),
            )
            matrix = iou_3d(similarity.invert_boxes(boxes[view_1]), boxes[view_0])
            overlaps.extend(matrix.max(axis=1))
    assert len(overlaps) > 20
    assert np.median(overlaps) > 0.7


def test_a_draw_depends_only_on_the_generator():
    """The same seed gives the same A, within the requested limits."""
    drawn = [Similarity.draw(np.random.default_rng(seed)) for seed in range(50)]
    assert drawn == [Similarity.draw(np.random.default_rng(seed)) for seed in range(50)]
    assert {similarity.flip_y for similarity in drawn} == {False, True}
    assert all(abs(similarity.rotation_rad) <= np.pi / 4 for similarity in drawn)
    assert all(0.95 <= similarity.scale <= 1.05 for similarity in drawn)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_a_similarity_without_inverse_is_rejected(scale):
    """Scale 0, negative or not finite is a one-line error."""
    with pytest.raises(ConfigError, match="positive scale"):
        Similarity(scale=scale)


@given(st.floats(-1e3, 1e3))
def test_wrapping_keeps_the_direction(angle):
    """The result lies in (-pi, pi] and points the same way."""
    wrapped = float(wrap_angle(np.array(angle)))
    assert -np.pi < wrapped <= np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


def test_wrapping_at_the_seam():
    """Minus pi becomes pi, floats next to pi stay in range, and angles in range do not change."""
    seam = np.array([-np.pi, np.pi, np.nextafter(np.pi, 4), -np.nextafter(np.pi, 4), 0.1, -3.0])
    wrapped = wrap_angle(seam)
    assert np.all((wrapped > -np.pi) & (wrapped <= np.pi))
    assert wrapped[0] == np.pi
    assert wrapped[[1, 4, 5]].tolist() == [np.pi, 0.1, -3.0]
