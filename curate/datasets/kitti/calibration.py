"""Calibration files of KITTI's benchmarks, and of the programs that write their format.

Source: the readme files of KITTI's object, tracking, odometry and raw development kits. A line is a
name, with or without a colon, and the entries of a matrix, row by row:

| matrix | names | entries |
|---|---|---|
| projection of camera n | Pn (object, tracking, odometry), P_rect_0n (raw) | 3 x 4 or 4 x 4 |
| rectification | R0_rect (object), R_rect (tracking), R_rect_00 (raw) | 3 x 3, 3 x 4 or 4 x 4 |
| LiDAR to camera n | Tr_velo_to_cam (object), Tr_velo_cam (tracking) | 3 x 4 or 4 x 4 |
| LiDAR to rectified camera | Tr (odometry) | 3 x 4 or 4 x 4 |

Converters of data with several cameras write Tr_velo_to_cam_n; for camera n it comes before the
other names. Tr takes the place of rectification and LiDAR to camera. Two names of the same matrix
may both be present if their entries are equal.
"""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from curate.errors import DataError
from curate.files.atomic import replace_file
from curate.files.text import decode_text, read_content
from curate.frames import Calibration, RotationY
from curate.geometry.mounting import check_lidar_to_camera

LEFT_COLOUR = 2
"""Number of KITTI's camera of the images in image_2."""
RAW_CAMERAS, RAW_TO_CAMERA = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"

_LINE = re.compile(r"\s*([A-Za-z]\w*)\s*:?(.*)")
_RECTIFICATIONS = ("R0_rect", "R_rect", "R_rect_00")
_TO_CAMERA = ("Tr_velo_to_cam", "Tr_velo_cam")
_TO_RECTIFIED = ("Tr",)
_SQUARE, _WIDE = ((3, 3), (3, 4), (4, 4)), ((3, 4), (4, 4))
# Larger entries are damaged, and their products would not be finite.
_MAX_ENTRY = 1e9
# Largest relative difference of the entries of two names of one matrix: rounding of the file.
_ROUNDING = 1e-5


@dataclass(frozen=True)
class CalibrationLine:
    """A line of a calibration file: its place for messages, its name, and the text after it."""

    place: str
    name: str
    entries: str


class CalibrationLines:
    """The lines of a calibration file by name, in any case.

    Args:
        path: the file.
        content: its content; None to read it.

    Raises:
        DataError: if the file is missing or not text.
    """

    def __init__(self, path: Path, content: bytes | None = None) -> None:
        self.path = path
        content = _read(path) if content is None else content
        self.lines: dict[str, list[CalibrationLine]] = {}
        for number, text in enumerate(decode_text(content, path).split("\n"), start=1):
            if match := _LINE.fullmatch(text):
                line = CalibrationLine(f"{path}:{number}", match[1], match[2])
                self.lines.setdefault(match[1].casefold(), []).append(line)

    def matrix(self, names: Sequence[str], shapes: Sequence[tuple[int, int]]) -> np.ndarray | None:
        """Return the matrix with one of these names; None if the file has none of them.

        Args:
            names: the names that the matrix may have.
            shapes: the allowed rows and columns; the first is the shape of the result.

        Raises:
            DataError: if a line is malformed, or two lines differ.
        """
        lines = [line for name in names for line in self.lines.get(name.casefold(), ())]
        found = [_fitted(_parse(line, shapes), shapes[0], line) for line in lines]
        for line, matrix in zip(lines, found, strict=True):
            if np.abs(matrix - found[0]).max() > _ROUNDING * max(1.0, np.abs(found[0]).max()):
                raise DataError(
                    f"{line.place}: {line.name} differs from {lines[0].name} at "
                    f"{lines[0].place}, but both are names of the same matrix; remove the wrong one"
                )
        return found[0] if found else None

    def required(self, names: Sequence[str], shapes: Sequence[tuple[int, int]]) -> np.ndarray:
        """Return the matrix with one of these names.

        Raises:
            DataError: if the file has none of them, or `matrix` raises it.
        """
        found = self.matrix(names, shapes)
        _require(self, {tuple(names): found})
        return np.asarray(found)


def read_calibration(
    path: Path, camera: int = LEFT_COLOUR, rotation_y: RotationY = "calibration"
) -> Calibration:
    """Return the calibration of one camera from a file with all matrices.

    Args:
        path: a calibration file of the object, tracking or odometry benchmark, or of a converter.
        camera: number of the camera.
        rotation_y: the meaning of rotation_y in the label files of the data set.

    Raises:
        DataError: if the file or a matrix is missing, a matrix has a wrong number of entries,
            entries that are not finite, two names of one matrix differ, or the transform from
            LiDAR to camera is not a rotation and a translation.
    """
    return _parsed(_File(_read(path), path), camera, rotation_y)


@dataclass(frozen=True)
class _File:
    """The content of a file, which is equal to that of a file at another path."""

    content: bytes
    path: Path = field(compare=False)


# All frames of a drive have the same calibration, each in a file of its own.
@lru_cache(maxsize=256)
def _parsed(file: _File, camera: int, rotation_y: RotationY) -> Calibration:
    path, lines = file.path, CalibrationLines(file.path, file.content)
    names = (f"P{camera}", f"P_rect_{camera:02d}")
    projection = lines.matrix(names, _WIDE)
    rectification = lines.matrix(_RECTIFICATIONS, _SQUARE)
    to_camera = _to_camera(lines, camera)
    to_rectified = lines.matrix(_TO_RECTIFIED, _WIDE)
    needed: dict[tuple[str, ...], np.ndarray | None] = {names: projection}
    if to_rectified is None:
        needed |= {_RECTIFICATIONS: rectification, _TO_CAMERA: to_camera}
    _require(lines, needed)
    place = f"{path}: Tr"
    if rectification is not None and to_camera is not None:
        place = f"{path}: the product of R0_rect and Tr_velo_to_cam"
        product = (_square(rectification) @ _square(to_camera))[:3]
        if to_rectified is not None and not np.allclose(product, to_rectified, atol=1e-4):
            raise DataError(f"{place} differs from Tr; both lead to the rectified camera")
        to_rectified = product
    transform = _square(np.asarray(to_rectified))
    check_lidar_to_camera(transform, place)
    shared = np.array(projection), np.array(transform)
    for matrix in shared:
        matrix.setflags(write=False)
    return Calibration(*shared, rotation_y=rotation_y)


def read_raw_calibration(
    folder: Path, camera: int = LEFT_COLOUR, rotation_y: RotationY = "calibration"
) -> Calibration:
    """Return the calibration of one camera of KITTI's raw recordings.

    Args:
        folder: the date folder, with `RAW_CAMERAS` (P_rect_0n, R_rect_00) and `RAW_TO_CAMERA` (R,
            T).
        camera: number of the camera.
        rotation_y: the meaning of rotation_y in the label files of the data set.

    Raises:
        DataError: if a file or an entry is missing or malformed, or the transform from LiDAR to
            camera is not a rotation and a translation.
    """
    extrinsic, rectify = np.eye(4), np.eye(4)
    to_camera = CalibrationLines(folder / RAW_TO_CAMERA)
    extrinsic[:3, :3] = to_camera.required(("R",), ((3, 3),))
    extrinsic[:3, 3:] = to_camera.required(("T",), ((3, 1),))
    cameras = CalibrationLines(folder / RAW_CAMERAS)
    rectify[:3, :3] = cameras.required(("R_rect_00",), _SQUARE)
    projection = cameras.required((f"P_rect_{camera:02d}",), _WIDE)
    check_lidar_to_camera(rectify @ extrinsic, str(folder / RAW_TO_CAMERA))
    return Calibration(projection, rectify @ extrinsic, rotation_y=rotation_y)


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file that `read_calibration` reads back exactly.

    Tr_velo_to_cam is the complete transform from the LiDAR to the rectified camera, and R0_rect is
    the identity. P0, P1 and P3 repeat P2, for readers that expect P2 on the third line.
    """
    replace_file(path, _text(calibration).encode())


def _text(calibration: Calibration) -> str:
    matrices = dict.fromkeys(("P0", "P1", "P2", "P3"), calibration.projection)
    matrices["R0_rect"] = np.eye(3)
    matrices["Tr_velo_to_cam"] = calibration.lidar_to_camera[:3]
    matrices["Tr_imu_to_velo"] = np.eye(4)[:3]
    lines = [
        f"{key}: {' '.join(f'{entry:.16e}' for entry in matrix.ravel())}\n"
        for key, matrix in matrices.items()
    ]
    return "".join(lines)


# Numbers without a sign are the shortest; a missing line is longer than all signs.
_SHORTEST = len(_text(Calibration(np.zeros((3, 4)), np.zeros((4, 4)))))


def is_written_calibration(path: Path) -> bool:
    """Return whether a file of `write_calibration` is complete, as far as its size and end show."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            return size >= _SHORTEST and file.seek(size - 1) >= 0 and file.read() == b"\n"
    except OSError:
        return False


def _require(
    lines: CalibrationLines, matrices: Mapping[tuple[str, ...], np.ndarray | None]
) -> None:
    """Raise DataError if a matrix is None; the keys are the names that it may have."""
    missing = [names for names, matrix in matrices.items() if matrix is None]
    if not missing:
        return
    shown = " and ".join(
        f"no line {name}:" + (f" (or {', '.join(others)})" if others else "")
        for name, *others in missing
    )
    present = [found[0].name for found in lines.lines.values()]
    hint = f"; the file has {', '.join(present[:12])}" if present else ""
    if missing == [_RECTIFICATIONS]:
        hint += "; if the images are rectified, add the line R0_rect: 1 0 0 0 1 0 0 0 1"
    raise DataError(f"{lines.path}: {shown}{hint}")


def _read(path: Path) -> bytes:
    """Return the content of a calibration file."""
    if not path.exists() and not any(path.parent.glob("*.txt")):
        raise DataError(
            f"{path}: no such calibration file, nor any other in the folder; if the data have "
            'no camera, describe them as a plain folder (docs/datasets.md, "Plain folders")'
        )
    return read_content(path, "calibration")


def _to_camera(lines: CalibrationLines, camera: int) -> np.ndarray | None:
    """Return the (3, 4) transform from the LiDAR to the camera; its own line comes first."""
    own = lines.matrix((f"Tr_velo_to_cam_{camera}",), _WIDE)
    return own if own is not None else lines.matrix(_TO_CAMERA, _WIDE)


def _parse(line: CalibrationLine, shapes: Sequence[tuple[int, int]]) -> np.ndarray:
    """Return the entries of a line as a matrix of one of the shapes."""
    place = line.place
    try:
        numbers = np.array([float(entry) for entry in line.entries.split()])
    except ValueError as error:
        raise DataError(f"{place}: {error}; a calibration line holds only numbers") from None
    shape = next((each for each in shapes if each[0] * each[1] == len(numbers)), None)
    if shape is None:
        expected = " or ".join(f"{rows} x {columns}" for rows, columns in shapes)
        raise DataError(f"{place}: {len(numbers)} numbers, expected {expected}")
    if not np.isfinite(numbers).all():
        raise DataError(f"{place}: contains NaN or infinite numbers")
    if np.abs(numbers).max() > _MAX_ENTRY:
        raise DataError(f"{place}: contains numbers beyond {_MAX_ENTRY:g}")
    return numbers.reshape(shape)


def _fitted(matrix: np.ndarray, shape: tuple[int, int], line: CalibrationLine) -> np.ndarray:
    """Return a matrix without rows and columns that must be those of the identity."""
    rows, columns = shape
    rest = matrix - np.eye(*matrix.shape)
    rest[:rows, :columns] = 0
    if np.abs(rest).max() > _ROUNDING:
        raise DataError(
            f"{line.place}: the {matrix.shape[0]} x {matrix.shape[1]} matrix {line.name} has "
            f"entries beyond its {rows} x {columns} part that are not those of the identity"
        )
    return matrix[:rows, :columns]


def _square(matrix: np.ndarray) -> np.ndarray:
    """Return a (3, 3) or (3, 4) matrix as (4, 4)."""
    square = np.eye(4)
    square[:3, : matrix.shape[1]] = matrix
    return square
