"""Copies of frames: the same draws, and a calibration that fits the moved points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.rigs import IMAGE_SIZE, Rig, rigs

from curate.errors import ConfigError
from curate.frames import Camera, Frame, calibration_without_camera
from curate.geometry.augmented_views import AugmentedViews, augmented_calibration, augmented_frame
from curate.geometry.mounting import check_lidar_to_camera
from curate.geometry.projection import in_camera_view, project_points
from curate.geometry.similarity import Similarity

similarities = st.builds(
    Similarity, st.booleans(), st.floats(-np.pi, np.pi), st.floats(0.5, 2.0)
)  # fmt: skip


@given(rigs, similarities, st.integers(0, 2**32 - 1))
def test_every_point_keeps_its_pixel(rig: Rig, similarity: Similarity, seed: int) -> None:
    """For any mounting; the depth is scaled, and the transform to the camera stays rigid."""
    points = np.random.default_rng(seed).uniform(-40, 40, (50, 3))
    calibration = augmented_calibration(rig.calibration, similarity)
    check_lidar_to_camera(calibration.lidar_to_camera, "copy")
    assert calibration.lidar_to_camera[3].tolist() == [0, 0, 0, 1]
    pixels, depth = project_points(similarity.apply_to_points(points), calibration)
    expected, original = project_points(points, rig.calibration)
    far = np.abs(original) > 0.5
    np.testing.assert_allclose(depth, similarity.scale * original, atol=1e-9)
    np.testing.assert_allclose(pixels[far], expected[far], rtol=1e-9, atol=1e-6)


@given(rigs, rigs, similarities)
def test_a_crop_after_a_is_a_crop_before_it(rig: Rig, other: Rig, similarity: Similarity) -> None:
    """Of the points that any of two cameras sees."""
    points = np.random.default_rng(0).uniform(-40, 40, (200, 4))
    cameras = [
        Camera(name, each.calibration, IMAGE_SIZE) for name, each in (("a", rig), ("b", other))
    ]
    frame = Frame("0", points, rig.calibration, IMAGE_SIZE).with_cameras(cameras)
    before, after = in_camera_view(frame), in_camera_view(augmented_frame(frame, similarity))
    assert np.sum(before != after) <= 1  # a point on the border


def test_data_without_a_camera_keep_their_calibration() -> None:
    """It is that of labels in KITTI's form; there is nothing to project to."""
    calibration = calibration_without_camera()
    assert augmented_calibration(calibration, Similarity(True, 1.0, 1.1)) is calibration


def test_draws_depend_on_seed_round_and_frame_only() -> None:
    """The first views are the same whatever their number."""
    many = AugmentedViews(3, 2, views=4).draw("000008")
    assert AugmentedViews(3, 2, views=2).draw("000008") == many[:2]
    assert len(set(many)) == 4
    for other in (AugmentedViews(4, 2), AugmentedViews(3, 1)):
        assert other.draw("000008")[0] != many[0]
    assert AugmentedViews(3, 2).draw("000009")[0] != many[0]


def test_draws_of_a_released_version_stay() -> None:
    """Stored repredictions and written copies remain valid."""
    [found] = AugmentedViews(0, 1).draw("000008")
    assert found == Similarity(False, -0.1356736284075849, 0.9841801979172125)


@pytest.mark.parametrize(
    "wrong",
    [
        {"views": 0}, {"seed": -1}, {"flip_probability": 1.1}, {"rotation_limit_rad": -1.0},
        {"scale_range": (1.1, 1.0)}, {"scale_range": (0.0, 1.0)},
    ],
)  # fmt: skip
def test_invalid_values_are_rejected(wrong: dict) -> None:
    """With their values in the message."""
    with pytest.raises(ConfigError, match=r"copies (of|with)"):
        AugmentedViews(**wrong)


def test_a_point_is_rounded_alike_in_any_selection() -> None:
    """So that a detector elsewhere, which crops the copy, sees the very numbers of repredict."""
    points = np.random.default_rng(0).uniform(-70, 70, (1000, 4)).astype(np.float32)
    similarity = Similarity(True, 0.7, 1.03)
    chosen = np.flatnonzero(points[:, 0] > 3)
    np.testing.assert_array_equal(
        similarity.apply_to_points(points)[chosen], similarity.apply_to_points(points[chosen])
    )
