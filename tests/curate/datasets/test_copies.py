"""Copies of frames as other tools read them, and of data sets of a user's own."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from oracles.openpcdet_kitti import Calibration as OpenPCDetCalibration
from support.copied import TURNED, assert_is_copy, copied, write_all
from support.dataset_layouts import write_toy_folder, write_toy_raw
from support.nuscenes_scenes import MOUNTED, SIDES, write_nuscenes
from support.rigs import IMAGE_SIZE, Rig, rigs
from support.strategies import similarities
from support.toys import write_toy_kitti

from curate.datasets.copies import copy_kind, copy_writer
from curate.datasets.folder import FolderDataset
from curate.datasets.formats.point_layout import PointLayout
from curate.datasets.kitti.calibration import write_calibration
from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.raw import KittiRawDataset
from curate.datasets.nuscenes import NuScenesDataset
from curate.errors import ConfigError, DataError
from curate.frames import Camera
from curate.geometry.augmented_views import augmented_calibration
from curate.geometry.projection import in_camera_view, in_view
from curate.geometry.similarity import Similarity


@settings(max_examples=30, deadline=None)
@given(rig=rigs, similarity=similarities.filter(lambda a: 0.5 < a.scale < 2))
def test_openpcdet_crops_a_copy_as_it_crops_the_frame(
    rig: Rig, similarity: Similarity, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Its own formulas on the written calibration files, for any mounting; and back by its inverse.

    Its depth leaves out the entry of P that curate adds, so points on a border may differ.
    """
    folder = tmp_path_factory.mktemp("calib")
    points = np.random.default_rng(0).uniform(-40, 40, (500, 3))
    seen = []
    for name, calibration, cloud in (
        ("frame", rig.calibration, points),
        (
            "copy",
            augmented_calibration(rig.calibration, similarity),
            similarity.apply_to_points(points),
        ),
    ):
        write_calibration(folder / name, calibration)
        read = OpenPCDetCalibration(folder / name)
        seen.append(read.in_view(cloud, IMAGE_SIZE))
        np.testing.assert_allclose(read.in_lidar(read.rectified(cloud)), cloud, atol=1e-3)
        inside = in_view(cloud, calibration, IMAGE_SIZE)
        assert np.sum(inside != seen[-1]) <= 2  # single precision
    assert np.sum(seen[0] != seen[1]) <= 2


def test_kitti_copies_have_what_openpcdet_needs(tmp_path: Path) -> None:
    """P2, R0_rect and Tr on their lines, images with their suffix, the frames in testing/."""
    write_toy_kitti(tmp_path / "kitti", 3)
    dataset = KittiDataset(tmp_path / "kitti")
    folder = tmp_path / "copies"
    again, _ = copied(dataset, folder, {"000000": TURNED, "000002": TURNED})
    assert again.frame_ids() == ("000000", "000002")
    lists = {path.stem: path.read_text() for path in (folder / "ImageSets").iterdir()}
    assert lists == {"test": "000000\n000002\n", "train": "", "val": ""}
    home = folder / "testing"
    assert sorted(path.name for path in home.iterdir()) == ["calib", "image_2", "velodyne"]
    lines = (home / "calib/000002.txt").read_text().splitlines()
    names = [line.partition(":")[0] for line in lines]
    assert names[2:6] == ["P2", "P3", "R0_rect", "Tr_velo_to_cam"]
    source = tmp_path / "kitti/training/image_2/000002.png"
    assert (home / "image_2/000002.png").samefile(source)  # a link, no copy


def test_untouched_frames_are_links(tmp_path: Path) -> None:
    """Points of a frame that is copied as it is need no space."""
    write_toy_kitti(tmp_path / "kitti", 1)
    copied(KittiDataset(tmp_path / "kitti"), tmp_path / "copies", {"000000": None})
    name = "training/velodyne/000000.bin"
    assert (tmp_path / "copies" / name).samefile(tmp_path / "kitti" / name)


def test_links_of_the_data_set_are_followed(tmp_path: Path) -> None:
    """A hard link is one to the file, not to the symbolic link."""
    write_toy_kitti(tmp_path / "kitti", 1)
    image = tmp_path / "kitti/training/image_2/000000.png"
    image.rename(tmp_path / "elsewhere.png")
    image.symlink_to(tmp_path / "elsewhere.png")
    dataset = KittiDataset(tmp_path / "kitti", follow_links=True)
    copied(dataset, tmp_path / "copies", {"000000": TURNED})
    found = tmp_path / "copies/training/image_2/000000.png"
    assert not found.is_symlink()
    assert found.samefile(tmp_path / "elsewhere.png")


@pytest.mark.parametrize("missing", ["link", "link symlink"])
def test_without_links_images_are_copied(
    tmp_path: Path, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on file systems that have no links, or between two of them."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError

    write_toy_kitti(tmp_path / "kitti", 1)
    writer = copy_writer(KittiDataset(tmp_path / "kitti"), tmp_path / "copies", {"000000": TURNED})
    writer.prepare()  # makes the link testing/
    for name in missing.split():
        monkeypatch.setattr(f"os.{name}", refuse)
    writer.write("000000")
    image = tmp_path / "copies/training/image_2/000000.png"
    assert image.is_symlink() == (missing == "link")
    assert image.read_bytes() == (tmp_path / "kitti/training/image_2/000000.png").read_bytes()


def test_the_camera_view_has_the_points_that_repredict_passes_on(tmp_path: Path) -> None:
    """Cropped before A, by all cameras of the frame."""
    write_nuscenes(tmp_path / "data")
    dataset = NuScenesDataset(tmp_path / "data", cameras="all")
    names = dataset.frame_ids()
    folder = tmp_path / "copies"
    write_all(copy_writer(dataset, folder, dict.fromkeys(names, TURNED), camera_view=True))
    again = NuScenesDataset(folder, cameras="all")
    for name in names:
        frame = dataset.read(name)
        visible = frame.with_points(frame.points[in_camera_view(frame)])
        assert 0 < len(visible.points) < len(frame.points)
        assert_is_copy(again.read(name), visible, TURNED)


def test_the_camera_view_of_files_with_a_header_is_rejected(tmp_path: Path) -> None:
    """Their header counts the points; the calibration of the copies fits a crop anyway."""
    write_toy_folder(tmp_path / "data")
    dataset = FolderDataset(tmp_path / "data")
    writer = copy_writer(
        dataset, tmp_path / "copies", dict.fromkeys(dataset.frame_ids(), TURNED), camera_view=True
    )
    writer.prepare()
    writer.write("000000")
    with pytest.raises(ConfigError, match=r"000002\.pcd: only \.bin files .* --camera-view"):
        writer.write("000002")


def test_nuscenes_copies_have_all_tables_and_cameras(tmp_path: Path) -> None:
    """Also cameras that the data set does not read: tools need all six. No sweep follows another.

    The tables of all frames stay consistent if only some are copied.
    """
    write_nuscenes(tmp_path / "data", steps=3, mounted=(*MOUNTED, *SIDES))
    dataset = NuScenesDataset(tmp_path / "data")
    chosen = dataset.frame_ids()[::2]
    folder = tmp_path / "copies"
    write_all(copy_writer(dataset, folder, dict.fromkeys(chosen, TURNED)))
    names = {path.name for path in (folder / "v1.0-mini").iterdir()}
    assert names == {path.name for path in (tmp_path / "data/v1.0-mini").iterdir()}
    everything = NuScenesDataset(tmp_path / "data", cameras="all")
    again = NuScenesDataset(folder, cameras="all")
    assert again.frame_ids() == chosen
    assert again.skipped_frames() == ""
    for name in chosen:
        frame, copy = everything.read(name, image=True), again.read(name, image=True)
        assert len(copy.cameras) == 6
        assert_is_copy(copy, frame, TURNED)
        assert again.sequence_of(name) == dataset.sequence_of(name)
        assert np.allclose(copy.calibration.pose_in_map(), frame.calibration.pose_in_map())


class Oblique(KittiDataset):
    """A data set of a user's own, with other points than those of its files."""

    def read(self, frame_id: str, *, points: bool = True, image: bool = False):
        """Read a frame, without its first points, seen by two cameras."""
        frame = super().read(frame_id, points=points, image=image)
        cameras = [Camera(name, frame.calibration, frame.image_size) for name in ("left", "right")]
        return frame.with_points(frame.points[10:]).with_cameras(cameras)


def test_copies_of_a_users_own_data_set_are_a_plain_folder(tmp_path: Path) -> None:
    """With the points that the class returns, whatever class it is derived from."""
    write_toy_kitti(tmp_path / "kitti", 3)
    shutil.rmtree(tmp_path / "kitti/training/image_2")
    dataset = Oblique(tmp_path / "kitti", image_size=(120, 40))
    assert copy_kind(dataset) == "folder"
    again, _ = copied(dataset, tmp_path / "copies", dict.fromkeys(dataset.frame_ids(), TURNED))
    for name in dataset.frame_ids():
        assert_is_copy(again.read(name), dataset.read(name), TURNED)


def test_other_columns_and_scales_stay(tmp_path: Path) -> None:
    """The copies are read with the same declared layout."""
    write_toy_kitti(tmp_path / "kitti", 1)
    path = tmp_path / "kitti/training/velodyne/000000.bin"
    rows = np.fromfile(path, np.float32).reshape(-1, 4)
    ring = np.arange(len(rows), dtype=np.float32)
    np.column_stack([ring, rows[:, :3], rows[:, 3] * 255]).astype(np.float32).tofile(path)
    layout = PointLayout(column_names=("ring", "x", "y", "z", "intensity"), intensity_scale=255)
    dataset = KittiDataset(tmp_path / "kitti", layout=layout)
    again, _ = copied(dataset, tmp_path / "copies", {"000000": TURNED})
    assert_is_copy(again.read("000000"), dataset.read("000000"), TURNED)
    found = np.fromfile(again.files("000000").points, np.float32).reshape(-1, 5)
    np.testing.assert_array_equal(found[:, 0], ring)


def test_a_damaged_frame_leaves_no_copy(tmp_path: Path) -> None:
    """So that it is written when its file has been fixed."""
    write_toy_kitti(tmp_path / "kitti", 1)
    path = tmp_path / "kitti/training/velodyne/000000.bin"
    path.write_bytes(path.read_bytes()[:-3])
    writer = copy_writer(KittiDataset(tmp_path / "kitti"), tmp_path / "copies", {"000000": TURNED})
    writer.prepare()
    with pytest.raises(DataError, match=r"000000\.bin"):
        writer.write("000000")
    assert not writer.is_written("000000")


def test_frames_of_recordings_keep_their_names(tmp_path: Path) -> None:
    """Raw drives share a calibration, copies do not: they become single frames."""
    write_toy_raw(tmp_path / "data")
    dataset = KittiRawDataset(tmp_path / "data")
    similarities_of = {
        name: Similarity(flip_y=bool(k % 2), rotation_rad=0.3 * k)
        for k, name in enumerate(dataset.frame_ids())
    }
    again, writer = copied(dataset, tmp_path / "copies", similarities_of)
    assert writer.kind == "kitti"
    for name, similarity in similarities_of.items():
        assert_is_copy(again.read(name), dataset.read(name), similarity)


@pytest.mark.parametrize("kind", ["kitti", "folder", "nuscenes"])
def test_a_copy_with_a_damaged_calibration_or_image_is_written_again(
    tmp_path: Path, kind: str
) -> None:
    """Its points are whole, but the files beside them were deleted or cut off."""
    root, folder = tmp_path / "data", tmp_path / "copies"
    if kind == "kitti":
        write_toy_kitti(root, 1)
        dataset = KittiDataset(root)
    elif kind == "folder":
        write_toy_folder(root)
        dataset = FolderDataset(root)
    else:
        write_nuscenes(root)
        dataset = NuScenesDataset(root)
    frame_id = dataset.frame_ids()[0]
    writer = copy_writer(dataset, folder, {frame_id: TURNED})
    write_all(writer)
    points = next((folder / writer.clouds).iterdir())
    beside = [
        path
        for path in folder.rglob("*")
        if path.is_file() and path != points and {"samples", "calib", "images", "image_2"} & {
            *path.parent.relative_to(folder).parts
        }
    ]  # fmt: skip
    assert beside
    whole = {path: path.read_bytes() for path in beside}
    for path, content in whole.items():
        for left in (None, b"", content[: len(content) // 2], content[:-1]):
            path.unlink()
            if left is not None:
                path.write_bytes(left)
            assert not writer.is_written(frame_id), (path, left)
            writer.write(frame_id)
            assert writer.is_written(frame_id)
            assert path.read_bytes() == content
    assert dataset.files(frame_id).points.exists()
