"""Calibration files of KITTI's benchmarks and of converters."""

import re

import numpy as np
import pytest

from curate.datasets.kitti.calibration import read_calibration, write_calibration
from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import DataError
from curate.frames import Calibration

PROJECTION = np.array([[700.0, 0, 600, 45], [0, 700, 180, -0.3], [0, 0, 1, 0.005]])
RECTIFY = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
SHIFT = np.eye(3, 4, 3)
TO_CAMERA = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3]])


def line(name: str, matrix: np.ndarray, colon: str = ":") -> str:
    """Return a line of a calibration file."""
    return f"{name}{colon} {' '.join(f'{entry!r}' for entry in matrix.ravel().tolist())}"


def wide(matrix: np.ndarray) -> np.ndarray:
    """Return a 3 x 3 matrix with a column of zeros."""
    return np.column_stack([matrix, np.zeros(3)])


def square(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix as 4 x 4."""
    found = np.eye(4)
    found[: matrix.shape[0], : matrix.shape[1]] = matrix
    return found


LINES = (line("P2", PROJECTION), line("R0_rect", RECTIFY), line("Tr_velo_to_cam", TO_CAMERA))
OTHERS = ("P0: 1 2 3", "Tr_imu_to_velo: 1 0 0", "calib_time: 09-Jan-2012 13:57:47", "# a comment")
FILES = {
    "object": (*OTHERS, *LINES),
    "tracking, without colons": tuple(
        line(name, matrix, "")
        for name, matrix in (("P2", PROJECTION), ("R_rect", RECTIFY), ("Tr_velo_cam", TO_CAMERA))
    ),
    "raw names": (line("P_rect_02", PROJECTION), line("R_rect_00", RECTIFY), LINES[2]),
    "odometry": (LINES[0], line("Tr", (square(RECTIFY) @ square(TO_CAMERA))[:3])),
    "odometry with R": (*LINES, line("Tr", (square(RECTIFY) @ square(TO_CAMERA))[:3])),
    "3 x 4 rotation": (LINES[0], line("R0_rect", wide(RECTIFY)), LINES[2]),
    "4 x 4 matrices": tuple(
        line(name, square(matrix))
        for name, matrix in (
            ("P2", PROJECTION),
            ("R0_rect", RECTIFY),
            ("Tr_velo_to_cam", TO_CAMERA),
        )
    ),
    "several cameras": (
        line("P0", PROJECTION + 1),
        *LINES[:2],
        line("Tr_velo_to_cam_0", TO_CAMERA + SHIFT),
        line("Tr_velo_to_cam_2", TO_CAMERA),
    ),
    "other letters and spaces": tuple(
        text.replace("R0_rect:", "  R0_Rect :").replace(" ", "\t") for text in LINES
    ),
    "no space after the colon": tuple(text.replace(": ", ":") for text in LINES),
    "both names, equal": (*LINES, line("R_rect", RECTIFY), line("Tr_velo_cam", TO_CAMERA + 1e-9)),
}


@pytest.mark.parametrize("kind", FILES)
def test_every_kind_of_file_gives_the_same_calibration(tmp_path, kind):
    path = tmp_path / "a.txt"
    path.write_text("\n".join(FILES[kind]))
    found = read_calibration(path)
    np.testing.assert_array_equal(found.projection, PROJECTION)
    np.testing.assert_allclose(
        found.lidar_to_camera, square(RECTIFY) @ square(TO_CAMERA), atol=1e-8
    )


def test_another_camera_is_read_by_its_number(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("\n".join(FILES["several cameras"]))
    found = read_calibration(path, camera=0)
    np.testing.assert_array_equal(found.projection, PROJECTION + 1)
    np.testing.assert_allclose(found.lidar_to_camera[:3], RECTIFY @ (TO_CAMERA + SHIFT))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (LINES[1:], "no line P2: (or P_rect_02); the file has R0_rect, Tr_velo_to_cam"),
        (
            LINES[:1] + LINES[2:],
            "no line R0_rect: (or R_rect, R_rect_00); the file has P2, Tr_velo",
        ),
        (LINES[:1] + LINES[2:], "if the images are rectified, add the line R0_rect: 1 0 0 0 1 0 0"),
        (LINES[:2], "no line Tr_velo_to_cam: (or Tr_velo_cam)"),
        ((LINES[0], "R: 1 0 0"), "no line R0_rect: (or R_rect, R_rect_00) and no line Tr_velo_to"),
        ((*LINES, line("R_rect", np.eye(3))), ":4: R_rect differs from R0_rect at "),
        ((*LINES, line("P2", PROJECTION * 2)), ":4: P2 differs from P2 at "),
        ((*LINES, line("Tr", TO_CAMERA)), "Tr_velo_to_cam differs from Tr; both lead to the rect"),
        ((*LINES[:2], line("Tr_velo_cam", TO_CAMERA[:, :3])), ":3: 9 numbers, expected 3 x 4 or 4"),
        (
            (LINES[0], line("R0_rect", np.ones((4, 4))), LINES[2]),
            ":2: the 4 x 4 matrix R0_rect has",
        ),
        ((LINES[0], line("R0_rect", RECTIFY + 1j), LINES[2]), ":2: could not convert string to"),
    ],
)
def test_a_missing_or_contradictory_matrix_is_reported(tmp_path, lines, message):
    """With the names that it may have and those in the file."""
    path = tmp_path / "a.txt"
    path.write_text("\n".join(lines))
    with pytest.raises(DataError, match=re.escape(message)) as caught:
        read_calibration(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_data_set_with_the_calibration_of_the_tracking_benchmark_is_read(toy_kitti):
    """Names without colons, as in KITTI's tracking benchmark."""
    expected = KittiDataset(toy_kitti).read("000000").calibration
    path = toy_kitti / "training" / "calib" / "000000.txt"
    text = path.read_text().replace("R0_rect:", "R_rect").replace("Tr_velo_to_cam:", "Tr_velo_cam")
    path.write_text(text.replace("Tr_imu_to_velo:", "Tr_imu_velo"))
    found = KittiDataset(toy_kitti).read("000000").calibration
    np.testing.assert_array_equal(found.lidar_to_camera, expected.lidar_to_camera)


def test_a_calibration_is_read_back_exactly(tmp_path):
    calibration = Calibration(PROJECTION, square(RECTIFY) @ square(TO_CAMERA))
    write_calibration(tmp_path / "a.txt", calibration)
    found = read_calibration(tmp_path / "a.txt")
    np.testing.assert_array_equal(found.projection, calibration.projection)
    np.testing.assert_array_equal(found.lidar_to_camera, calibration.lidar_to_camera)


def test_files_with_equal_content_are_parsed_once(tmp_path):
    """A changed file is read again, and an error names its own file."""
    paths = [tmp_path / f"{name}.txt" for name in "ab"]
    for path in paths:
        path.write_text("\n".join(LINES))
    first, second = map(read_calibration, paths)
    assert first is second
    assert not first.projection.flags.writeable
    paths[1].write_text("\n".join((line("P2", PROJECTION + 1), *LINES[1:])))
    assert (read_calibration(paths[1]).projection == PROJECTION + 1).all()
    for path in paths:
        path.write_text(LINES[0])
        with pytest.raises(DataError, match=path.name):
            read_calibration(path)
