"""Files without a header: how many columns they have, and how a wrong number is found."""

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.point_layout import PointLayout
from curate.datasets.formats.readings import better_readings
from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import DataError

SHAPES = ("around", "forward", "beams", "corner", "dark", "bytes")


def random_cloud(generator: np.random.Generator, count: int, shape: str = "around") -> np.ndarray:
    """Return (count, 4) points of a LiDAR 1.7 m above the ground.

    Args:
        generator: source of the points.
        count: number of points.
        shape: "around", "forward" (camera view), "beams" (low and high beams in turn, as a VLP-16
            fires them), "corner" (x, y and z are never negative), "dark" (no intensity) or "bytes"
            (intensities from 0 to 255).
    """
    angle = generator.uniform(-0.7, 0.7, count)
    if shape not in ("forward", "corner"):
        angle *= 4
    distance = 2 + generator.gamma(2, 8, count)
    height = np.where(
        generator.random(count) < 0.6,
        generator.normal(-1.7, 0.05, count),
        generator.uniform(-1.7, 2, count),
    )
    intensity = generator.beta(1, 4, count)
    if shape == "beams":
        low = np.arange(count) % 2 == 0
        height = np.where(low, -1.7, np.abs(height))
        distance = np.where(low, 4 + generator.random(count), distance + 10)
    if shape == "corner":
        height, angle = np.abs(height), np.abs(angle)
    if shape == "dark":
        intensity[:] = 0
    if shape == "bytes":
        intensity = np.rint(255 * intensity)
    x, y = distance * np.cos(angle), distance * np.sin(angle)
    return np.column_stack([x, y, height, intensity]).astype(np.float32)


def with_extra_columns(points: np.ndarray, columns: int, generator: np.random.Generator):
    """Return the points with further columns in random order: ring, time, elongation, class."""
    count = len(points)
    extra = [
        generator.integers(0, 64, count),
        generator.uniform(0, 0.1, count),
        generator.uniform(0, 1.5, count),
        generator.integers(0, 20, count),
    ]
    generator.shuffle(extra)
    return np.column_stack([points, *extra[: columns - 4]]).astype(np.float32)


def scale_of(shape: str) -> PointLayout:
    """Return the layout with the scale of the intensities, but without a number of columns."""
    return PointLayout(intensity_scale=255.0 if shape == "bytes" else None)


@pytest.mark.parametrize("shape", SHAPES)
@given(seed=st.integers(0, 2**32), count=st.integers(0, 300))
def test_four_columns_are_never_rejected(shape: str, seed: int, count: int) -> None:
    """Of any kind and number of points."""
    points = random_cloud(np.random.default_rng(seed), count, shape)
    assert better_readings(points.reshape(-1), 4, least_rows=4) == ()


@pytest.mark.parametrize("shape", SHAPES)
@given(seed=st.integers(0, 2**32), columns=st.integers(5, 7), count=st.integers(20, 300))
def test_more_columns_are_found(shape: str, seed: int, columns: int, count: int) -> None:
    """The right number is among those named, also of a file that has the size of four columns."""
    generator = np.random.default_rng(seed)
    table = with_extra_columns(random_cloud(generator, count, shape), columns, generator)
    assert columns in better_readings(table.reshape(-1), 4)


@pytest.mark.parametrize("columns", [5, 6, 7, 8])
def test_a_file_with_two_readings_is_rejected_with_both(tmp_path: Path, columns: int) -> None:
    """And read as declared."""
    generator = np.random.default_rng(columns)
    points = random_cloud(generator, 440, "forward")
    table = with_extra_columns(points, columns, generator)
    table.tofile(tmp_path / "a.bin")
    with pytest.raises(DataError) as caught:
        read_cloud(tmp_path / "a.bin")
    message = str(caught.value)
    assert f"{table.size // 4} points of 4 float32" in message
    assert f"440 of {columns}" in message
    assert f"set dataset.columns = {columns} or 4" in message
    found = read_cloud(tmp_path / "a.bin", PointLayout(columns=columns))
    np.testing.assert_array_equal(found, points)


def test_a_plausible_reading_is_rejected_if_another_one_fits_better(tmp_path: Path) -> None:
    """With x, y and z above 0 and intensities up to 255, no value is out of range."""
    generator = np.random.default_rng(0)
    points = random_cloud(generator, 400, "corner")
    points[:, 3] = np.rint(255 * points[:, 3])
    with_extra_columns(points, 5, generator).tofile(tmp_path / "a.bin")
    with pytest.raises(DataError, match=r"500 points of 4 float32 or, more likely, 400 of 5"):
        read_cloud(tmp_path / "a.bin", PointLayout(intensity_scale=255))


def test_a_size_that_does_not_fit_names_what_fits(tmp_path: Path) -> None:
    """439 rows of five numbers."""
    generator = np.random.default_rng(0)
    with_extra_columns(random_cloud(generator, 439), 5, generator).tofile(tmp_path / "a.bin")
    with pytest.raises(
        DataError, match=r"8780 bytes .* rows of 5 float32 fit: set dataset.columns = 5"
    ):
        read_cloud(tmp_path / "a.bin")


def test_a_truncated_file_is_not_taken_for_another_layout(tmp_path: Path) -> None:
    """Four columns whose last row lacks a number; the number of values is divisible by five."""
    values = random_cloud(np.random.default_rng(0), 100).reshape(-1)[:395]
    values.tofile(tmp_path / "a.bin")
    with pytest.raises(DataError, match=r"the file is truncated, fetch it again"):
        read_cloud(tmp_path / "a.bin")


def test_a_wrong_declaration_is_rejected_with_the_right_number(tmp_path: Path) -> None:
    random_cloud(np.random.default_rng(0), 100).tofile(tmp_path / "a.bin")
    with pytest.raises(DataError, match=r"80 points of 5 float32 .* more likely, 100 of 4"):
        read_cloud(tmp_path / "a.bin", PointLayout(columns=5))


def test_three_columns_are_found(tmp_path: Path) -> None:
    points = random_cloud(np.random.default_rng(0), 100)
    np.ascontiguousarray(points[:, :3]).tofile(tmp_path / "a.bin")
    with pytest.raises(DataError, match=r"75 points of 4 float32 .* more likely, 100 of 3"):
        read_cloud(tmp_path / "a.bin")
    found = read_cloud(tmp_path / "a.bin", PointLayout(columns=3))
    np.testing.assert_array_equal(found[:, :3], points[:, :3])
    assert (found[:, 3] == 0).all()


def test_named_columns_are_read_in_any_order(tmp_path: Path) -> None:
    """Radar: the fourth column is no intensity; a time stamp may come first."""
    points = random_cloud(np.random.default_rng(0), 50)
    columns = {"time": np.full(50, 1.6e9), "z": points[:, 2], "rcs": points[:, 3] - 20}
    columns |= {"x": points[:, 0], "y": points[:, 1], "v_r": points[:, 0]}
    np.column_stack(list(columns.values())).astype("<f4").tofile(tmp_path / "a.bin")
    found = read_cloud(tmp_path / "a.bin", PointLayout(column_names=tuple(columns)))
    np.testing.assert_array_equal(found[:, :3], points[:, :3])
    assert (found[:, 3] == 0).all()
    layout = PointLayout(column_names=("ring", "Intensity", "z", "y", "x"))
    np.column_stack([np.arange(50), points[:, ::-1]]).astype("<f4").tofile(tmp_path / "a.bin")
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.bin", layout), points)


@pytest.mark.kitti
def test_real_sweeps_are_read_without_a_declaration(kitti_root: Path) -> None:
    """All of them, in whole and in parts, in less than 1 ms more than before."""
    for folder in (kitti_root, kitti_root / "raw"):
        dataset = KittiDataset(folder)
        for name in dataset.frame_ids():
            values = np.fromfile(dataset.files(name).points, dtype="<f4")
            for count in (1, 5, 20, 100, 1000, 10_000, len(values) // 4):
                assert better_readings(values[: 4 * count], 4, least_rows=4) == ()
            assert len(dataset.read(name).points) == len(values) // 4
    times = []
    for _ in range(20):
        start = time.perf_counter()
        better_readings(values, 4, least_rows=4)
        times.append(time.perf_counter() - start)
    assert min(times) < 1e-3
