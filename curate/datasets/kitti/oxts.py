"""Times and poses of KITTI's recordings: timestamps.txt, and the GPS and IMU of the vehicle (OXTS).

Source: Geiger et al., "Vision meets robotics: the KITTI dataset", IJRR 2013, and the functions
latlonToMercator and convertOxtsToPose of its development kit. A line has latitude and longitude in
degrees, altitude in metres, and roll, pitch and yaw in radians; 24 other numbers follow. In metres,
with the earth's radius r and the scale s = cos(latitude of the recording's first frame):

    x = s * r * longitude * pi / 180
    y = s * r * log(tan(pi * (90 + latitude) / 360))
    z = altitude
"""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from curate.datasets.kitti.calibration import CalibrationLines
from curate.errors import DataError
from curate.files.text import read_lines
from curate.geometry.mounting import check_lidar_to_camera
from curate.geometry.poses import invert_pose
from curate.shapes import Float

_EARTH_M = 6378137.0
_FIELDS = 6
_MAX_DEGREES, _MAX_ALTITUDE_M = (89.0, 180.0), 1e5


def read_times(path: Path) -> list[float]:
    """Return the time of each frame of a drive in seconds since 1970, in UTC.

    Lines are of the form 2011-09-26 13:02:25.594360375.

    Raises:
        DataError: if the file is missing, or a line is not a time.
    """
    lines = read_lines(path, "timestamps")
    return [_time(f"{path}:{number}", line) for number, line in enumerate(lines, 1) if line.strip()]


def _time(place: str, line: str) -> float:
    whole, _, fraction = line.strip().partition(".")
    try:
        seconds = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        return seconds.timestamp() + float(f"0.{fraction or 0}")
    except (OverflowError, ValueError):
        raise DataError(
            f"{place}: {line[:40]!r} is not a time such as 2011-09-26 13:02:25.594360375"
        ) from None


def read_oxts(path: Path) -> Float[np.ndarray, "n 6"]:
    """Return latitude, longitude, altitude, roll, pitch and yaw of each line of an OXTS file.

    Raises:
        DataError: if the file is missing, or a line is malformed.
    """
    lines = enumerate(read_lines(path, "OXTS"), start=1)
    rows = [_fields(f"{path}:{number}", line) for number, line in lines if line.strip()]
    return np.array(rows, dtype=np.float64).reshape(-1, _FIELDS)


def _fields(place: str, line: str) -> list[float]:
    try:
        values = [float(field) for field in line.split()[:_FIELDS]]
    except ValueError as error:
        raise DataError(f"{place}: {error}; an OXTS line holds only numbers") from None
    limits = np.array([*_MAX_DEGREES, _MAX_ALTITUDE_M, *[2 * np.pi] * 3])
    if len(values) != _FIELDS or not (np.abs(values) <= limits).all():
        raise DataError(
            f"{place}: expected latitude, longitude, altitude, roll, pitch and yaw, in degrees, "
            "metres and radians"
        )
    return values


def imu_pose(row: Float[np.ndarray, " 6"], latitude_deg: float) -> Float[np.ndarray, "4 4"]:
    """Return the (4, 4) pose of the IMU in the map: x east, y north, z up.

    Args:
        row: a row of `read_oxts`.
        latitude_deg: latitude of the first frame of the recording.
    """
    latitude, longitude, altitude, roll, pitch, yaw = row
    radius = _EARTH_M * np.cos(np.deg2rad(latitude_deg))
    pose = np.eye(4)
    pose[:3, :3] = _turn(yaw, 0, 1) @ _turn(pitch, 2, 0) @ _turn(roll, 1, 2)
    pose[0, 3] = radius * np.deg2rad(longitude)
    pose[1, 3] = radius * np.log(np.tan(np.deg2rad(90 + latitude) / 2))
    pose[2, 3] = altitude
    return pose


def _turn(angle_rad: float, one: int, other: int) -> np.ndarray:
    """Return the (3, 3) rotation from one axis towards the other."""
    matrix = np.eye(3)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    matrix[one, one] = matrix[other, other] = cos
    matrix[one, other], matrix[other, one] = -sin, sin
    return matrix


def read_lidar_to_imu(path: Path) -> Float[np.ndarray, "4 4"]:
    """Return the (4, 4) transform from the LiDAR to the IMU.

    Args:
        path: calib_imu_to_velo.txt of the raw recordings (R, T), or a calibration file of the
            tracking benchmark (Tr_imu_velo, or Tr_imu_to_velo).

    Raises:
        DataError: if the file or a matrix is missing or malformed.
    """
    lines = CalibrationLines(path)
    transform = np.eye(4)
    if "r" in lines.lines:
        transform[:3, :3] = lines.required(("R",), ((3, 3),))
        transform[:3, 3:] = lines.required(("T",), ((3, 1),))
    else:
        names = ("Tr_imu_velo", "Tr_imu_to_velo")
        transform[:3] = lines.required(names, ((3, 4), (4, 4)))
    check_lidar_to_camera(transform, str(path), "the transform from IMU to LiDAR")
    return invert_pose(transform)
