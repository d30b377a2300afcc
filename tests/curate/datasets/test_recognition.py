"""A folder of another layout than expected is recognised, and the message names it."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support.dataset_layouts import write_toy_folder, write_toy_raw, write_toy_tracking
from support.nuscenes_scenes import write_nuscenes
from support.toys import write_toy_kitti

from curate.datasets.recognition import label_hint, layout_hint, recognised
from curate.errors import CurateError
from pipelines.registry import DATASETS

KINDS: dict[str, Callable[[Path], None]] = {
    "kitti": lambda root: write_toy_kitti(root, frames=4),
    "kitti-raw": write_toy_raw,
    "kitti-tracking": write_toy_tracking,
    "folder": write_toy_folder,
    "nuscenes": write_nuscenes,
}
UNREAD = {
    "the Waymo Open Dataset (tfrecord)": "training/segment-1.tfrecord",
    "the Waymo Open Dataset (parquet)": "training/lidar/1.parquet",
    "Argoverse 2": "val/0a1b/sensors/lidar/315.feather",
    "KITTI odometry or SemanticKITTI": "dataset/sequences/00/velodyne/000000.bin",
    "KITTI-360": "data_3d_raw/drive/velodyne_points.bin",
    "DAIR-V2X": "vehicle-side/velodyne/000000.pcd",
    "PandaSet": "001/lidar/00.pkl.gz",
    "ONCE": "data/000027/lidar_roof/1.bin",
    "ROS or pcap recordings": "drive.mcap",
}


def test_every_registered_layout_is_tested() -> None:
    assert set(KINDS) == set(DATASETS.classes)


@pytest.mark.parametrize("kind", KINDS)
def test_a_data_set_is_recognised(tmp_path: Path, kind: str) -> None:
    KINDS[kind](tmp_path / "root")
    if kind != "kitti":  # the samples are made from KITTI's layout and keep a part of it
        shutil.rmtree(tmp_path / "root" / "made", ignore_errors=True)
    found = recognised(tmp_path / "root")
    assert found is not None
    assert found[1] == kind
    assert layout_hint(tmp_path / "root", kind) == ""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("other", KINDS)
def test_the_message_names_the_layout(tmp_path: Path, kind: str, other: str) -> None:
    """For every pair of an expected layout and another one."""
    if kind == other:
        return
    KINDS[other](tmp_path / "root")
    shutil.rmtree(tmp_path / "root" / "made", ignore_errors=True)
    with pytest.raises(CurateError, match=f"use --dataset {other}") as caught:
        DATASETS.build(kind, tmp_path / "root", offered={}, options={}).frame_ids()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", UNREAD)
def test_layouts_without_a_reader_are_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / "root" / UNREAD[name]
    path.parent.mkdir(parents=True)
    path.touch()
    for kind in KINDS:
        with pytest.raises(CurateError) as caught:
            DATASETS.build(kind, tmp_path / "root", offered={}, options={}).frame_ids()
        assert f"looks like {name}, which curate does not read" in str(caught.value)


def test_a_root_one_level_too_high_or_too_low_is_named(tmp_path: Path) -> None:
    write_toy_kitti(tmp_path / "downloads" / "object", frames=1)
    hint = layout_hint(tmp_path / "downloads", "kitti")
    assert hint.endswith(f"use --dataset kitti --root {tmp_path / 'downloads' / 'object'}")
    below = tmp_path / "downloads" / "object" / "training" / "velodyne"
    assert layout_hint(below, "kitti").endswith(f"--root {below.parent}")


def test_an_unknown_folder_has_no_hint(tmp_path: Path) -> None:
    (tmp_path / "root" / "papers").mkdir(parents=True)
    assert layout_hint(tmp_path / "root", "kitti") == ""
    assert layout_hint(tmp_path / "nothing", "kitti") == ""


def test_a_folder_of_other_files_says_which(tmp_path: Path) -> None:
    """For example a points folder with recordings of another program."""
    (tmp_path / "velodyne").mkdir()
    for k in range(3):
        (tmp_path / "velodyne" / f"{k}.las").touch()
    with pytest.raises(CurateError, match=r"velodyne: no point files .*; it contains 3 \*\.las"):
        DATASETS.build("kitti", tmp_path, offered={}, options={}).frame_ids()


def test_points_under_another_name_are_shown(tmp_path: Path) -> None:
    """OpenPCDet's velodyne_reduced, and its custom data sets with points, labels and ImageSets."""
    write_toy_kitti(tmp_path / "kitti", frames=4)
    home = tmp_path / "kitti" / "training"
    (home / "velodyne").rename(home / "velodyne_reduced")
    with pytest.raises(CurateError, match=r"velodyne_reduced contains .*: rename it to velodyne$"):
        DATASETS.build("kitti", tmp_path / "kitti", offered={}, options={})
    (tmp_path / "custom").mkdir()
    (home / "velodyne_reduced").rename(tmp_path / "custom" / "points")
    for kind in ("kitti", "folder"):
        with pytest.raises(CurateError, match=r'dataset\.toml with points = "points" .*folder$'):
            DATASETS.build(kind, tmp_path / "custom", offered={}, options={})


def test_labels_of_other_programs_are_shown(tmp_path: Path) -> None:
    write_toy_kitti(tmp_path, frames=4)
    assert label_hint(tmp_path) == ""
    folder = tmp_path / "training" / "label_2"
    for path in folder.glob("*.txt"):
        path.rename(path.with_suffix(".json"))
    assert label_hint(tmp_path).startswith(f"; {folder} contains *.json, but labels are KITTI's")


def test_no_calibration_at_all_suggests_a_plain_folder(tmp_path: Path) -> None:
    """A single missing file is not data without a camera."""
    write_toy_kitti(tmp_path, frames=4)
    dataset = DATASETS.build("kitti", tmp_path, offered={}, options={})
    first, *others = sorted((tmp_path / "training" / "calib").iterdir())
    first.unlink()
    with pytest.raises(CurateError, match=r"no such calibration file$"):
        dataset.read("000000")
    for path in others:
        path.unlink()
    with pytest.raises(CurateError, match="if the data have no camera, describe them as a plain"):
        dataset.read("000000")
