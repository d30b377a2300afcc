"""Calibration files in KITTI's format."""

from pathlib import Path

import numpy as np

from curate.datasets.formats.binary import read_bytes
from curate.errors import DataError
from curate.files.atomic import replace_file
from curate.frames import Calibration

LEFT_COLOUR = 2
"""Number of KITTI's camera of the images in image_2."""
RAW_CAMERAS, RAW_TO_CAMERA = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"

# Focal lengths are thousands of pixels; the last column of P2 is at most a million.
_MAX_ENTRY = 1e9


def read_calibration(path: Path, camera: int = LEFT_COLOUR) -> Calibration:
    """Return the calibration of one camera (P2, R0_rect, Tr_velo_to_cam for camera 2).

    Raises:
        DataError: if the file or one of the three matrices is missing, or a matrix has a wrong
            number of entries, entries that are not finite, or no inverse.
    """
    own = f"Tr_velo_to_cam_{camera}"
    names = {
        f"P{camera}": "P2", "R0_rect": "R0_rect", "R_rect": "R0_rect",
        "Tr_velo_to_cam": "Tr_velo_to_cam", "Tr_velo_cam": "Tr_velo_to_cam", own: own,
    }  # fmt: skip
    matrices: dict[str, np.ndarray] = {}
    text = read_bytes(path, "calibration").decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        key, _, entries = line.replace(":", " ", 1).partition(" ")
        if key in names:
            shape = (3, 3) if names[key] == "R0_rect" else (3, 4)
            matrices[names[key]] = parse_matrix(entries, shape, f"{path}:{number}")
    if own in matrices:
        matrices["Tr_velo_to_cam"] = matrices[own]
    missing = [key for key in ("P2", "R0_rect", "Tr_velo_to_cam") if key not in matrices]
    if missing:
        raise DataError(f"{path}: no line {' and no line '.join(f'{key}:' for key in missing)}")
    rectify, extrinsic = np.eye(4), np.eye(4)
    rectify[:3, :3] = matrices["R0_rect"]
    extrinsic[:3] = matrices["Tr_velo_to_cam"]
    lidar_to_camera = rectify @ extrinsic
    if abs(np.linalg.det(lidar_to_camera)) < 1e-6:
        raise DataError(f"{path}: the product of R0_rect and Tr_velo_to_cam cannot be inverted")
    return Calibration(matrices["P2"], lidar_to_camera)


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file that `read_calibration` reads back exactly.

    Tr_velo_to_cam is the complete transform from the LiDAR to the rectified camera, and R0_rect is
    the identity. P0, P1 and P3 repeat P2, for readers that expect P2 on the third line.
    """
    matrices = dict.fromkeys(("P0", "P1", "P2", "P3"), calibration.projection)
    matrices["R0_rect"] = np.eye(3)
    matrices["Tr_velo_to_cam"] = calibration.lidar_to_camera[:3]
    matrices["Tr_imu_to_velo"] = np.eye(4)[:3]
    lines = [
        f"{key}: {' '.join(f'{entry:.16e}' for entry in matrix.ravel())}\n"
        for key, matrix in matrices.items()
    ]
    replace_file(path, "".join(lines).encode())


def parse_matrix(entries: str, shape: tuple[int, int], location: str) -> np.ndarray:
    """Parse the numbers of a calibration line as a matrix.

    Args:
        entries: the part of the line after the key.
        shape: rows and columns of the matrix.
        location: file and line, for error messages.

    Raises:
        DataError: if an entry is not a finite number of sane size, or their count is wrong.
    """
    try:
        numbers = np.array([float(entry) for entry in entries.split()])
    except ValueError as error:
        raise DataError(f"{location}: {error}; a calibration line holds only numbers") from None
    if len(numbers) != shape[0] * shape[1]:
        raise DataError(f"{location}: {len(numbers)} numbers, expected {shape[0]} x {shape[1]}")
    if not np.isfinite(numbers).all():
        raise DataError(f"{location}: contains NaN or infinite numbers")
    if np.abs(numbers).max() > _MAX_ENTRY:
        raise DataError(f"{location}: contains numbers beyond {_MAX_ENTRY:g}")
    return numbers.reshape(shape)


def read_raw_calibration(folder: Path) -> Calibration:
    """Return the calibration of the left colour camera (P_rect_02, R_rect_00, R and T).

    Args:
        folder: the date folder.

    Raises:
        DataError: if a file or an entry is missing or malformed.
    """
    extrinsic, rectify = np.eye(4), np.eye(4)
    extrinsic[:3, :3] = _entry(folder / RAW_TO_CAMERA, "R", (3, 3))
    extrinsic[:3, 3:] = _entry(folder / RAW_TO_CAMERA, "T", (3, 1))
    rectify[:3, :3] = _entry(folder / RAW_CAMERAS, "R_rect_00", (3, 3))
    return Calibration(_entry(folder / RAW_CAMERAS, "P_rect_02", (3, 4)), rectify @ extrinsic)


def _entry(path: Path, key: str, shape: tuple[int, int]) -> np.ndarray:
    text = read_bytes(path, "calibration").decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        name, _, entries = line.partition(":")
        if name == key:
            return parse_matrix(entries, shape, f"{path}:{number}")
    raise DataError(f"{path}: no line {key}:")
