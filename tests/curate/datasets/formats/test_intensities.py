"""Intensities are checked against the declared full intensity before they are clipped."""

from pathlib import Path

import numpy as np
import pytest
from support.dataset_layouts import write_cloud

from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.point_layout import PointLayout
from curate.errors import DataError

SUFFIXES = (".bin", ".npy", ".pcd", ".ply")


def cloud(count: int = 100, full: float = 1.0) -> np.ndarray:
    """Return points with intensities up to `full`."""
    points = np.random.default_rng(0).uniform(-30, 30, (count, 4))
    points[:, 3] = np.linspace(0, full, count)
    return points


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(("full", "scale"), [(229, "255"), (4000, "4095"), (60000, "65535")])
def test_intensities_above_the_full_one_are_rejected(
    tmp_path: Path, suffix: str, full: float, scale: str
) -> None:
    """The message contains the setting that fixes it."""
    write_cloud(tmp_path / f"a{suffix}", cloud(full=full))
    with pytest.raises(DataError, match=f"dataset.intensity_scale = {scale}"):
        read_cloud(tmp_path / f"a{suffix}")
    found = read_cloud(tmp_path / f"a{suffix}", PointLayout(intensity_scale=full))
    np.testing.assert_allclose(found[:, 3], np.linspace(0, 1, 100), atol=1e-6)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_negative_intensities_are_rejected(tmp_path: Path, suffix: str) -> None:
    """The column is another one."""
    points = cloud()
    points[:, 3] -= 2
    write_cloud(tmp_path / f"a{suffix}", points)
    with pytest.raises(DataError, match=r"100 of 100 intensities are negative, down to -2"):
        read_cloud(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_rounding_and_a_few_saturated_points_are_clipped(tmp_path: Path, suffix: str) -> None:
    """Up to 1 % above full intensity, and one point in 1000 of any value."""
    points = cloud(3000)
    points[7, 3], points[8, 3], points[9:, 3] = 40.0, -3.0, points[9:, 3] * 1.009
    write_cloud(tmp_path / f"a{suffix}", points)
    found = read_cloud(tmp_path / f"a{suffix}")
    assert (found[:, 3].min(), found[:, 3].max()) == (0, 1)
    points[10:14, 3] = 1.5
    write_cloud(tmp_path / f"a{suffix}", points)
    with pytest.raises(DataError, match=r"5 of 3000 intensities are above the full intensity 1"):
        read_cloud(tmp_path / f"a{suffix}")


def test_a_scale_that_would_turn_almost_all_points_dark_is_not_suggested(tmp_path: Path) -> None:
    """Raw intensities of the Waymo Open Dataset: most are below 1, a few reach 40,000."""
    points = cloud(3000)
    points[:30, 3] = np.linspace(2, 40000, 30)
    write_cloud(tmp_path / "a.bin", points)
    with pytest.raises(DataError, match=r"but 99\.0% are not: clip them to 1 or take") as caught:
        read_cloud(tmp_path / "a.bin")
    assert "65535" not in str(caught.value)
