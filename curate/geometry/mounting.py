"""How a camera is mounted, and the angle rotation_y of KITTI's form under any mounting.

KITTI gives the heading of an object as rotation_y about the camera's y axis, from the camera's x
axis: an object with rotation_y -pi/2 drives along the optical axis. Objects stand upright in the
LiDAR frame, and a camera is rarely level in it. Its mounting is therefore split into a yaw, which
turns headings, and pitch and roll, which do not: rotation_y is an angle about the LiDAR's vertical,
counted from the azimuth of the optical axis.

    yaw = mounting yaw - rotation_y - pi/2      camera upright
    yaw = mounting yaw + rotation_y + pi/2      camera upside down

This is the meaning "calibration" of `curate.frames.RotationY`. Other tools take -yaw - pi/2 under
every mounting, or project the heading into the camera's xz plane; for a level camera that looks
along x there is no difference.

Example: a camera that looks to the left (mounting yaw pi/2) and 12 degrees down sees a car drive
away from it. Its rotation_y is -pi/2, and its yaw in the LiDAR frame pi/2.
"""

from dataclasses import dataclass
from typing import Self, get_args

import numpy as np

from curate.errors import ConfigError, DataError
from curate.frames import Calibration, RotationY
from curate.geometry.similarity import wrap_angle
from curate.shapes import Float, Num
from curate.spelling import did_you_mean

_FORMULA = ("openpcdet", "mmdetection3d", "view-of-delft")
_PROJECTED = ("nuscenes", "dair-v2x")
# Entries of R R^T - 1 of a rotation written with few digits. A scaled or sheared one has far more.
_LARGEST_ERROR = 0.01
# Below this angle between the camera's y axis and the horizontal plane, an angle about that axis is
# not a heading.
_LEAST_UPRIGHT_RAD = np.deg2rad(5)
# A camera that looks along x within this angle shows no difference between meanings of rotation_y.
_AHEAD_RAD = np.deg2rad(5)


@dataclass(frozen=True)
class Mounting:
    """The direction of a camera in the LiDAR frame, as yaw, then pitch, then roll (ISO 8855).

    Attributes:
        yaw_rad: azimuth of the optical axis, counter-clockwise from the LiDAR's x axis.
        pitch_rad: angle of the optical axis below the horizontal plane.
        roll_rad: rotation about the optical axis, clockwise seen along it; pi for a camera that is
            mounted upside down.
    """

    yaw_rad: float
    pitch_rad: float
    roll_rad: float

    @classmethod
    def of(cls, calibration: Calibration) -> Self:
        """Return the mounting of a calibrated camera."""
        right, down, forward = calibration.lidar_to_camera[:3, :3]
        return cls(
            float(np.arctan2(forward[1], forward[0])),
            float(-np.arcsin(np.clip(forward[2], -1, 1))),
            float(np.arctan2(-right[2], -down[2])),
        )


def defines_headings(calibration: Calibration) -> bool:
    """Return whether an angle about the camera's y axis is a heading in the LiDAR frame.

    It is not if that axis is about horizontal: the camera lies on its side, or looks up or down.
    """
    return bool(abs(calibration.lidar_to_camera[1, 2]) >= np.sin(_LEAST_UPRIGHT_RAD))


def check_rotation_y(value: str, setting: str = "dataset.options.rotation_y") -> None:
    """Raise ConfigError if the value of a setting is not a meaning of rotation_y."""
    names = get_args(RotationY)
    if value not in names:
        raise ConfigError(
            f"{setting} '{value}': use one of {', '.join(names)}{did_you_mean(value, names)}"
        )


def rotation_y_of_tools(calibration: Calibration) -> RotationY:
    """Return how rotation_y of a detector's results is most likely meant in augmented copies.

    Results of the frames themselves do not show it if the camera looks along x. The tools that
    write such files for LiDAR detectors use OpenPCDet's formula.

    Args:
        calibration: calibration of a frame, with the meaning in its label files.
    """
    if calibration.rotation_y != "calibration":
        return calibration.rotation_y
    ahead = abs(Mounting.of(calibration).yaw_rad) < _AHEAD_RAD
    return "openpcdet" if ahead else "calibration"


def check_lidar_to_camera(
    matrix: Float[np.ndarray, "4 4"],
    place: str,
    name: str = "the transform from LiDAR to camera",
) -> None:
    """Check that a transform, such as that between LiDAR and camera, is a rotation and a shift.

    Args:
        matrix: the transform.
        place: the file, for messages.
        name: what it is, for messages.

    Raises:
        DataError: if it scales, shears or mirrors.
    """
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _LARGEST_ERROR:
        lengths = ", ".join(f"{length:.3g}" for length in np.linalg.norm(rotation, axis=1))
        raise DataError(
            f"{place}: {name} is not a rotation (its rows must be "
            f"orthogonal and of length 1, their lengths are {lengths}); correct the calibration"
        )
    if np.linalg.det(rotation) < 0:
        raise DataError(
            f"{place}: {name} mirrors (its determinant is -1); one axis has the wrong sign, "
            "correct the calibration"
        )


def yaws_of_rotations_y(
    rotations_y: Num[np.ndarray, " n"], calibration: Calibration, meaning: RotationY | None = None
) -> Float[np.ndarray, " n"]:
    """Return the yaws of headings in the LiDAR frame, in (-pi, pi].

    Args:
        rotations_y: (n,) radians.
        calibration: calibration of the frame.
        meaning: of rotation_y; None for that of the data set.

    Raises:
        DataError: if the mounting does not define the headings.
    """
    meaning = meaning or calibration.rotation_y
    if meaning in _PROJECTED:
        planar = np.stack([np.cos(rotations_y), -np.sin(rotations_y)])
        headings = np.linalg.solve(_projection(calibration), planar)
        return wrap_angle(np.arctan2(headings[1], headings[0]))
    zero, sign = _zero(calibration, meaning)
    return wrap_angle(zero - sign * (rotations_y + np.pi / 2))


def rotations_y_of_yaws(
    yaws: Num[np.ndarray, " n"], calibration: Calibration, meaning: RotationY | None = None
) -> Float[np.ndarray, " n"]:
    """Return (n,) rotation_y in (-pi, pi], the inverse of `yaws_of_rotations_y`."""
    meaning = meaning or calibration.rotation_y
    if meaning in _PROJECTED:
        planar = _projection(calibration) @ np.stack([np.cos(yaws), np.sin(yaws)])
        return wrap_angle(np.arctan2(-planar[1], planar[0]))
    zero, sign = _zero(calibration, meaning)
    return wrap_angle(sign * (zero - yaws) - np.pi / 2)


def observation_angles(
    boxes: Num[np.ndarray, "n 7"], calibration: Calibration
) -> Float[np.ndarray, " n"]:
    """Return KITTI's alpha in (-pi, pi]: rotation_y minus the angle of the ray to the bottom.

    It is the heading that the camera sees, so it follows the calibration. Where the mounting does
    not define it, rotation_y is -yaw - pi/2.

    Args:
        boxes: (n, 7) in the LiDAR frame.
        calibration: calibration of the frame.
    """
    meaning: RotationY = "calibration" if defines_headings(calibration) else "openpcdet"
    bottoms = bottom_centres_in_camera(boxes, calibration)
    rays = np.arctan2(bottoms[:, 0], bottoms[:, 2])
    return wrap_angle(rotations_y_of_yaws(boxes[:, 6], calibration, meaning) - rays)


def bottom_centres_in_camera(
    boxes: Num[np.ndarray, "n 7"], calibration: Calibration
) -> Float[np.ndarray, "n 3"]:
    """Return (n, 3) the points on which boxes stand, in the rectified camera frame."""
    bottoms = np.array(boxes[:, :3], dtype=np.float64)
    bottoms[:, 2] -= boxes[:, 5] / 2
    to_camera = calibration.lidar_to_camera
    found: np.ndarray = bottoms @ to_camera[:3, :3].T + to_camera[:3, 3]
    return found


def _zero(calibration: Calibration, meaning: RotationY) -> tuple[float, int]:
    """Return the yaw of rotation_y -pi/2, and 1 if rotation_y grows clockwise seen from above."""
    if meaning in _FORMULA:
        return 0.0, 1
    _check_headings(calibration)
    upright = calibration.lidar_to_camera[1, 2] < 0
    return Mounting.of(calibration).yaw_rad, 1 if upright else -1


def _projection(calibration: Calibration) -> np.ndarray:
    """Return the (2, 2) matrix from x, y of a heading in the LiDAR frame to the camera's x, z."""
    _check_headings(calibration)
    return np.asarray(calibration.lidar_to_camera[np.ix_([0, 2], [0, 1])])


def _check_headings(calibration: Calibration) -> None:
    if not defines_headings(calibration):
        angle = np.rad2deg(np.arcsin(abs(calibration.lidar_to_camera[1, 2])))
        raise DataError(
            f"the camera's y axis is {angle:.1f} degrees from the horizontal plane of the LiDAR "
            "frame: rotation_y, an angle about this axis, is not a heading; correct the "
            "calibration, or set rotation_y to the tool with the formula -yaw - pi/2 that wrote it"
        )
