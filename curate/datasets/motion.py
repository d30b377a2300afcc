"""The files of times and poses of a plain folder."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from curate.errors import DataError
from curate.files.text import read_lines, read_text
from curate.geometry.mounting import check_lidar_to_camera
from curate.shapes import Float

# Larger numbers are damaged, and their products would not be finite.
_MAX_NUMBER = 1e10


def read_times(path: Path) -> Mapping[str, float]:
    """Return the time of each frame in seconds from a file with lines "FRAME SECONDS".

    Raises:
        DataError: if the file is missing, a line is malformed, or a frame is listed twice.
    """
    times: dict[str, float] = {}
    for number, line in enumerate(read_lines(path, "times"), start=1):
        frame, *fields = line.split() or [""]
        if not frame or frame.startswith("#"):
            continue
        found = _numbers(f"{path}:{number}", " ".join(fields))
        if len(found) != 1:
            raise DataError(
                f"{path}:{number}: {line[:40]!r} is not a frame and its time in seconds"
            )
        if frame in times:
            raise DataError(f"{path}:{number}: frame {frame} is listed twice")
        times[frame] = float(found[0])
    return times


def read_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    """Return the (4, 4) pose in a file of 3 x 4 or 4 x 4 numbers, row by row.

    Raises:
        DataError: if the file is missing, or not a pose.
    """
    numbers = _numbers(str(path), read_text(path, "pose"))
    if len(numbers) not in (12, 16):
        raise DataError(f"{path}: {len(numbers)} numbers, expected 12 or 16: the pose of the LiDAR")
    pose = np.eye(4)
    pose.ravel()[: len(numbers)] = numbers
    if not np.array_equal(pose[3], [0, 0, 0, 1]):
        raise DataError(f"{path}: the last row of the pose must be 0 0 0 1")
    check_lidar_to_camera(pose, str(path), "the pose")
    return pose


def _numbers(place: str, text: str) -> np.ndarray:
    """Return the finite numbers of a text."""
    try:
        numbers = np.array([float(field) for field in text.split()])
    except ValueError as error:
        raise DataError(f"{place}: {error}; expected numbers") from None
    if not (np.abs(numbers) <= _MAX_NUMBER).all():
        raise DataError(f"{place}: contains NaN, infinite or very large numbers")
    return numbers
