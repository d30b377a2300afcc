"""Copies of point files keep format and columns; only x, y and z are new."""

from pathlib import Path

import numpy as np
import pytest

from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.moved_clouds import move_cloud
from curate.datasets.formats.point_layout import UNDECLARED, PointLayout
from curate.errors import DataError
from curate.geometry.similarity import Similarity
from curate.simulation.open3d_loader import load

TURNED = Similarity(flip_y=True, rotation_rad=0.7, scale=0.96)
COUNT = 50
NAMES = ("ring", "y", "intensity", "x", "z", "time")


def table(seed: int = 0) -> np.ndarray:
    """Return rows of ring, y, intensity, x, z and time."""
    rng = np.random.default_rng(seed)
    rows = rng.uniform(-30, 30, (COUNT, 6))
    rows[:, 0], rows[:, 2], rows[:, 5] = rng.integers(0, 64, COUNT), rng.random(COUNT), 1e-7
    return rows.astype(np.float32)


def moved(path: Path, layout: PointLayout = UNDECLARED) -> Path:
    """Return the path of the turned copy, after a check of its points."""
    target = path.with_name(f"turned{path.suffix}")
    move_cloud(path, target, layout, TURNED.apply_to_points)
    before, after = (read_cloud(each, layout) for each in (path, target))
    np.testing.assert_allclose(after, TURNED.apply_to_points(before), rtol=1e-6, atol=1e-5)
    return target


def test_bin_keeps_the_other_columns_exactly(tmp_path: Path) -> None:
    """Columns in any order, of which only some are read."""
    rows = table()
    rows.tofile(tmp_path / "a.bin")
    target = moved(tmp_path / "a.bin", PointLayout(column_names=NAMES))
    found = np.fromfile(target, np.float32).reshape(-1, 6)
    np.testing.assert_array_equal(found[:, [0, 2, 5]], rows[:, [0, 2, 5]])


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int16])
def test_npy_of_rows(tmp_path: Path, kind: type) -> None:
    """Integers become floats, which can hold turned coordinates."""
    rows = np.round(table()).astype(kind)
    np.save(tmp_path / "a.npy", rows)
    target = moved(tmp_path / "a.npy", PointLayout(column_names=NAMES))
    np.testing.assert_array_equal(np.load(target)[:, [0, 2, 5]], rows[:, [0, 2, 5]])


def test_npy_with_named_fields_keeps_shape_and_types(tmp_path: Path) -> None:
    """An organised cloud, with a field of another type."""
    fields = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "<f4"), ("t", "<i8")]
    cloud = np.zeros((5, 10), fields)
    for name in ("x", "y", "z"):
        cloud[name] = np.random.default_rng(1).uniform(-20, 20, (5, 10))
    cloud["t"] = np.arange(50).reshape(5, 10)
    np.save(tmp_path / "a.npy", cloud)
    found = np.load(moved(tmp_path / "a.npy"))
    assert (found.dtype, found.shape) == (cloud.dtype, cloud.shape)
    np.testing.assert_array_equal(found["t"], cloud["t"])


@pytest.mark.parametrize("ascii_", [True, False])
@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_files_of_a_library(tmp_path: Path, suffix: str, ascii_: bool, compressed: bool) -> None:
    """Open3D writes every encoding, and reads the copy with its other attributes."""
    o3d = load()
    rows = table()
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(rows[:, [3, 1, 4]]))
    for name, column in (("intensity", 2), ("time", 5)):
        cloud.point[name] = o3d.core.Tensor(rows[:, [column]])
    path = tmp_path / f"a{suffix}"
    o3d.t.io.write_point_cloud(str(path), cloud, write_ascii=ascii_, compressed=compressed)
    stored = o3d.t.io.read_point_cloud(str(path))  # text has fewer digits
    found = o3d.t.io.read_point_cloud(str(moved(path)))
    np.testing.assert_allclose(
        found.point.positions.numpy(),
        TURNED.apply_to_points(stored.point.positions.numpy()),
        rtol=1e-6, atol=1e-5,
    )  # fmt: skip
    for name in ("intensity", "time"):
        np.testing.assert_array_equal(found.point[name].numpy(), stored.point[name].numpy())


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_keeps_its_other_elements(tmp_path: Path, order: str) -> None:
    """An element before the vertices, and faces behind them."""
    kind = np.dtype([("x", "f8"), ("y", "f8"), ("z", "f8"), ("ring", "u1")])
    rows = np.zeros(2, kind.newbyteorder(">" if "big" in order else "<"))
    rows["x"], rows["y"], rows["ring"] = [1.5, 2.5], [3.0, 4.0], [7, 8]
    head = (
        f"ply\nformat {order} 1.0\nelement camera 1\nproperty uchar id\nelement vertex 2\n"
        "property double x\nproperty double y\nproperty double z\nproperty uchar ring\n"
        "element face 1\nproperty uchar end\nend_header\n"
    ).encode()
    body = b"9\n1.5 3 0 7\n2.5 4 0 8\n5\n" if order == "ascii" else b"\x09" + rows.tobytes() + b"\5"
    (tmp_path / "a.ply").write_bytes(head + body)
    found = moved(tmp_path / "a.ply").read_bytes()
    assert found.startswith(head)
    if order == "ascii":
        words = found[len(head) :].split()
        assert [words[k] for k in (0, 4, 8, 9)] == [b"9", b"7", b"8", b"5"]
    else:
        assert len(found) == len(head + body)
        assert (found[len(head)], found[-1]) == (9, 5)
        assert np.frombuffer(found[len(head) + 1 : -1], rows.dtype)["ring"].tolist() == [7, 8]


def test_missing_returns_stay_missing(tmp_path: Path) -> None:
    """NaN of an organised cloud."""
    rows = table()[:, [3, 1, 4, 2]]
    rows[7, :3] = np.nan
    np.save(tmp_path / "a.npy", rows)
    assert np.isnan(np.load(moved(tmp_path / "a.npy"))[7, :3]).all()


def test_integers_in_a_file_with_named_fields_are_rejected(tmp_path: Path) -> None:
    """Their type is part of the file, and cannot hold turned coordinates."""
    path = tmp_path / "a.pcd"
    path.write_text(
        "FIELDS x y z\nSIZE 2 2 2\nTYPE I I I\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\n"
        "DATA ascii\n1 2 3\n"
    )
    with pytest.raises(DataError, match="x, y and z are integers"):
        move_cloud(path, tmp_path / "b.pcd", UNDECLARED, TURNED.apply_to_points)
    assert not (tmp_path / "b.pcd").exists()
