"""The mounting of a camera, and rotation_y under it."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.camera_boxes import mounted
from support.rigs import FORWARD, LEFT, REAR, TILTED, UPSIDE_DOWN, Rig, rigs

from curate.errors import DataError
from curate.frames import RotationY
from curate.geometry.mounting import (
    Mounting,
    check_lidar_to_camera,
    rotations_y_of_yaws,
    yaws_of_rotations_y,
)
from curate.geometry.similarity import wrap_angle

ANGLES = np.linspace(-3, 3, 13)


@given(rig=rigs)
def test_yaw_pitch_and_roll_are_found(rig):
    """Those from which scipy made the rotation."""
    found = Mounting.of(rig.calibration)
    rebuilt = mounted(found.yaw_rad, found.pitch_rad, found.roll_rad)
    np.testing.assert_allclose(rebuilt.as_matrix(), rig.turn.as_matrix(), atol=1e-9)
    assert -np.pi / 2 <= found.pitch_rad <= np.pi / 2


@pytest.mark.parametrize("rig", [FORWARD, LEFT, REAR, Rig(yaw=-2.0), Rig(yaw=0.7, roll=np.pi)])
def test_the_heading_follows_the_calibration(rig):
    """A camera without pitch: the heading (cos, 0, -sin) of the camera frame, carried over."""
    headings = np.column_stack([np.cos(ANGLES), np.zeros(len(ANGLES)), -np.sin(ANGLES)])
    in_lidar = rig.turn.inv().apply(headings)
    expected = np.arctan2(in_lidar[:, 1], in_lidar[:, 0])
    assert np.abs(in_lidar[:, 2]).max() < 1e-12
    found = yaws_of_rotations_y(ANGLES, rig.calibration)
    np.testing.assert_allclose(np.sin((found - expected) / 2), 0, atol=1e-12)


@given(rig=rigs)
def test_an_object_that_drives_along_the_optical_axis_has_its_azimuth(rig):
    """Whatever pitch and roll are."""
    axis = rig.turn.inv().apply([0, 0, 1])
    [found] = yaws_of_rotations_y(np.array([-np.pi / 2]), rig.calibration)
    assert np.sin((found - np.arctan2(axis[1], axis[0])) / 2) == pytest.approx(0, abs=1e-9)


@given(pitch=st.floats(-1.3, 1.3), roll=st.floats(-1.2, 1.2))
def test_pitch_and_roll_do_not_turn_headings(pitch, roll):
    """A camera without yaw: the formula of OpenPCDet, mmdetection3d and View of Delft's kit."""
    found = yaws_of_rotations_y(ANGLES, Rig(pitch=pitch, roll=roll).calibration)
    np.testing.assert_allclose(wrap_angle(found + ANGLES + np.pi / 2), 0, atol=1e-9)


@given(rig=rigs)
def test_the_conversion_is_invertible(rig):
    """For every mounting and every meaning of rotation_y."""
    for meaning in get_args(RotationY):
        yaws = yaws_of_rotations_y(ANGLES, rig.calibration, meaning)
        back = rotations_y_of_yaws(yaws, rig.calibration, meaning)
        np.testing.assert_allclose(back, ANGLES, atol=1e-9)


@pytest.mark.parametrize("rig", [Rig(roll=np.pi / 2), Rig(pitch=np.pi / 2), Rig(pitch=-1.5)])
def test_a_camera_without_a_heading_is_rejected(rig):
    """It lies on its side, or looks straight down or up; the formula needs no heading."""
    with pytest.raises(DataError, match="degrees from the horizontal plane"):
        yaws_of_rotations_y(ANGLES, rig.calibration)
    yaws = yaws_of_rotations_y(ANGLES, rig.calibration, "mmdetection3d")
    np.testing.assert_allclose(yaws, wrap_angle(-ANGLES - np.pi / 2))


def test_all_meanings_agree_for_a_level_camera_that_looks_along_x():
    yaws = [yaws_of_rotations_y(ANGLES, FORWARD.calibration, each) for each in get_args(RotationY)]
    for found in yaws:
        np.testing.assert_allclose(found, yaws[0], atol=1e-12)


@given(rig=rigs)
def test_every_rotation_is_accepted(rig):
    """Also with three digits, as people type them."""
    matrix = rig.calibration.lidar_to_camera
    check_lidar_to_camera(matrix, "a.txt")
    check_lidar_to_camera(np.round(matrix, 3), "a.txt")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (np.diag([1, 1, -1.0]), "a.txt: .* mirrors"),
        (np.diag([1000, 1000, 1000.0]), "a.txt: .* not a rotation .* 1e\\+03"),
        (np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1.0]]), "not a rotation"),
        (np.zeros((3, 3)), "not a rotation .* lengths are 0, 0, 0"),
    ],
)
def test_other_matrices_are_rejected(change, message):
    """Mirrored, in millimetres, sheared, empty."""
    matrix = TILTED.calibration.lidar_to_camera
    matrix[:3, :3] = change @ matrix[:3, :3]
    with pytest.raises(DataError, match=message):
        check_lidar_to_camera(matrix, "a.txt")


def test_an_upside_down_camera_has_a_roll_of_180_degrees():
    found = Mounting.of(UPSIDE_DOWN.calibration)
    assert (found.yaw_rad, found.pitch_rad) == pytest.approx((0.4, -0.1))
    assert abs(found.roll_rad) == pytest.approx(np.pi)
