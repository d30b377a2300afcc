"""Paths of a dataset stay inside it."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.dataset_layouts import write_toy_folder, write_toy_raw
from support.nuscenes_scenes import write_nuscenes
from support.toys import write_toy_kitti

from curate.datasets.folder import FolderDataset
from curate.datasets.formats.containment import check_frame_id
from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.raw import KittiRawDataset
from curate.datasets.nuscenes.dataset import NuScenesDataset
from curate.errors import DataError

LAYOUTS = {
    "kitti": (lambda root: write_toy_kitti(root, 4), KittiDataset),
    "raw": (write_toy_raw, KittiRawDataset),
    "folder": (write_toy_folder, FolderDataset),
}


@given(st.text(max_size=20))
def test_a_frame_id_is_a_plain_name(name: str) -> None:
    """An accepted id is a file name in a folder, and prints on one line."""
    try:
        check_frame_id(name)
    except DataError as error:
        message = str(error)
    else:
        message = name
        assert Path("/folder", f"{name}.bin").parent == Path("/folder")
    assert len(message.splitlines()) == 1


@pytest.mark.parametrize("name", ["../000001", "/etc/passwd", "..", "a/b", "a\\b", "a\0b", "a\nb"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_no_frame_id_leads_outside(tmp_path: Path, layout: str, name: str) -> None:
    """Neither as an argument nor in a list."""
    write, kind = LAYOUTS[layout]
    write(tmp_path)
    with pytest.raises(DataError, match="not a frame id"):
        kind(tmp_path).files(name)


@pytest.mark.parametrize("frame_id", [None, 7, b"000001", ""])
def test_a_frame_id_is_text(frame_id: object) -> None:
    """A damaged database may have a null or a number in its place."""
    with pytest.raises(DataError, match="not a frame id"):
        check_frame_id(frame_id)


@pytest.mark.parametrize("line", ["../../secret", "/etc/passwd", "a\\b", "\a"])
def test_a_list_with_a_path_in_it_is_rejected(tmp_path: Path, line: str) -> None:
    """The error contains the line."""
    write_toy_kitti(tmp_path, 4)
    (tmp_path / "ImageSets" / "train.txt").write_text(f"000000\n{line}\n")
    with pytest.raises(DataError, match=r"train\.txt:2: .* not a frame id"):
        KittiDataset(tmp_path).splits()


@pytest.mark.parametrize("part", ["points", "image", "label"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_link_to_the_outside_is_not_followed(tmp_path: Path, layout: str, part: str) -> None:
    """Of a file or of its folder, unless an option allows it.

    Links within the dataset are followed.
    """
    write, kind = LAYOUTS[layout]
    write(tmp_path / "data")
    name = kind(tmp_path / "data").frame_ids()[0]
    path = getattr(kind(tmp_path / "data").files(name), part)
    inside = path.with_name(f"other-{path.name}")
    path.rename(inside)
    path.symlink_to(inside)
    kind(tmp_path / "data").read(name)
    path.unlink()
    outside = tmp_path / path.name
    inside.rename(outside)
    path.symlink_to(outside)
    with pytest.raises(DataError, match="leads out of the data set") as caught:
        kind(tmp_path / "data").files(name)
    assert "--follow-links" in str(caught.value)
    assert getattr(kind(tmp_path / "data", follow_links=True).files(name), part) == path
    path.unlink()
    outside.rename(path)
    folder = path.parent
    folder.rename(tmp_path / "folder")
    folder.symlink_to(tmp_path / "folder")
    with pytest.raises(DataError, match="leads out of the data set"):
        kind(tmp_path / "data").files(name)


@pytest.mark.parametrize("key", ["points", "images", "labels", "splits", "calibration"])
def test_a_description_that_leads_outside_is_rejected(tmp_path: Path, key: str) -> None:
    """By `..` or by an absolute path."""
    for where in ("../outside", "/etc"):
        description = {
            "points": "lidar",
            "images": "camera",
            "calibration": "calib.txt",
            key: where,
        }
        lines = [f'{name} = "{value}"' for name, value in description.items()]
        (tmp_path / "dataset.toml").write_text("\n".join(lines))
        with pytest.raises(DataError, match="leads out of the data set"):
            FolderDataset(tmp_path)


@pytest.mark.parametrize("follow_links", [False, True])
@pytest.mark.parametrize("key", ["points", "images", "labels", "splits", "calibration"])
def test_an_impossible_file_name_is_rejected(
    tmp_path: Path, key: str, *, follow_links: bool
) -> None:
    """In one short line, also if links may lead outside."""
    for where in ("9" * 5000, "nul\\u0000"):
        description = {
            "points": "lidar",
            "images": "camera",
            "calibration": "calib.txt",
            key: where,
        }
        lines = [f'{name} = "{value}"' for name, value in description.items()]
        (tmp_path / "dataset.toml").write_text("\n".join(lines))
        with pytest.raises(DataError, match="is not a valid path") as raised:
            FolderDataset(tmp_path, follow_links=follow_links)
        assert len(str(raised.value)) < 500


def test_a_link_in_place_of_a_description_is_not_followed(tmp_path: Path) -> None:
    """The message does not quote the other file."""
    (tmp_path / "secret").write_text("password = 1\n")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "dataset.toml").symlink_to(tmp_path / "secret")
    with pytest.raises(DataError, match="leads out of the data set"):
        FolderDataset(tmp_path / "data")


@pytest.mark.parametrize(
    "linked", ["mapping", "mapping/train_mapping.txt", "mapping/train_rand.txt"]
)
def test_a_mapping_outside_the_dataset_is_not_read(tmp_path: Path, linked: str) -> None:
    """The message does not quote the file that it links to."""
    write_toy_kitti(tmp_path / "data", 4)
    (tmp_path / "data" / "mapping").mkdir()
    (tmp_path / "data" / "mapping" / "train_mapping.txt").write_text("2011_09_26 drive_1 0\n" * 4)
    (tmp_path / "data" / "mapping" / "train_rand.txt").write_text("secret,2,3,4\n")
    path = tmp_path / "data" / linked
    path.rename(tmp_path / "outside")
    path.symlink_to(tmp_path / "outside")
    with pytest.raises(DataError, match="leads out of the data set") as caught:
        KittiDataset(tmp_path / "data").sequence_of("000000")
    assert "secret" not in str(caught.value)


def test_tables_outside_the_dataset_are_not_read(tmp_path: Path) -> None:
    """Of nuScenes, each file and the folder of a version."""
    write_nuscenes(tmp_path / "data", ("scene-0061",), 1)
    version = NuScenesDataset(tmp_path / "data").version
    for path in (tmp_path / "data" / version / "sample_data.json", tmp_path / "data" / version):
        path.rename(tmp_path / path.name)
        path.symlink_to(tmp_path / path.name)
        with pytest.raises(DataError, match="leads out of the data set"):
            NuScenesDataset(tmp_path / "data")
        path.unlink()
        (tmp_path / path.name).rename(path)


@pytest.mark.parametrize("part", ["points", "image", "calibration", "label"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_pipe_is_not_read(tmp_path: Path, layout: str, part: str) -> None:
    """Reading would wait forever; a link to a pipe within the dataset is rejected too."""
    write, kind = LAYOUTS[layout]
    write(tmp_path)
    name = kind(tmp_path).frame_ids()[0]
    path = getattr(kind(tmp_path).files(name), part)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(DataError, match="pipe or a device"):
        kind(tmp_path).files(name)
    path.rename(path.with_name("pipe"))
    path.symlink_to(path.with_name("pipe"))
    with pytest.raises(DataError, match="pipe or a device"):
        kind(tmp_path).files(name)
