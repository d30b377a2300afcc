"""`curate init` finds out that the data set is not what it was declared to be."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from support.dataset_layouts import DRIVE, write_toy_folder, write_toy_raw, write_toy_tracking
from support.toys import write_toy_kitti


@pytest.fixture
def init(curate):
    """Return a function that runs `curate init` without labeled frames in a new workspace."""

    def run(root: Path, *arguments: object) -> tuple[int, str]:
        shutil.rmtree(root.parent / "work", ignore_errors=True)
        code, out, error = curate(
            "init", root.parent / "work", "--root", root, "--labeled", 0, "--val", 0, *arguments
        )
        return code, " ".join(f"{out} {error}".split())

    return run


def rewrite(folder: Path, change) -> None:
    """Change the (n, 4) points of every file in a folder."""
    for path in folder.iterdir():
        points = np.fromfile(path, dtype="<f4").reshape(-1, 4)
        change(points).astype("<f4").tofile(path)


def with_rings(points: np.ndarray) -> np.ndarray:
    """Return the first 400 points with a fifth column, the ring."""
    return np.column_stack([points[:400], np.arange(400) % 64])


def test_five_columns_are_rejected_until_they_are_declared(init, tmp_path: Path) -> None:
    """Case 08: 400 points of five numbers have the size of 500 points of four."""
    root = tmp_path / "kitti"
    write_toy_kitti(root, frames=6)
    shutil.rmtree(root / "ImageSets")
    rewrite(root / "training" / "velodyne", with_rings)
    code, message = init(root)
    assert code == 3
    assert "8000 bytes can be read as 500 points of 4 float32" in message
    assert "more likely, 400 of 5; set dataset.columns = 5 or 4" in message
    assert init(root, "--set", "dataset.columns=5")[0] == 0
    names = 'dataset.column_names=["x","y","z","intensity","ring"]'
    assert init(root, "--set", names)[0] == 0
    code, message = init(root, "--set", names, "--set", "dataset.columns=4")
    assert code == 2
    assert "dataset.column_names has 5 names, but columns is 4" in message


def test_a_size_that_does_not_fit_is_rejected_with_what_fits(init, tmp_path: Path) -> None:
    """Case 08, the other frame: 399 points of five numbers."""
    root = tmp_path / "kitti"
    write_toy_kitti(root, frames=3)
    rewrite(root / "training" / "velodyne", lambda points: with_rings(points)[:399])
    code, message = init(root)
    assert code == 3
    assert "7980 bytes are not a multiple of 16" in message
    assert "set dataset.columns = 5" in message


@pytest.mark.parametrize("kind", ["kitti", "kitti-raw", "kitti-tracking", "folder"])
def test_intensities_up_to_255_are_rejected_until_declared(init, tmp_path: Path, kind: str) -> None:
    """Case 10, in every kind of data set that has no scale of its own."""
    root = tmp_path / "data"
    write = {
        "kitti": lambda: write_toy_kitti(root, frames=4),
        "kitti-raw": lambda: write_toy_raw(root),
        "kitti-tracking": lambda: write_toy_tracking(root),
        "folder": lambda: write_toy_folder(root),
    }
    write[kind]()
    if kind == "folder":
        description = root / "dataset.toml"
        description.write_text(description.read_text().replace("intensity_scale = 255\n", ""))
    else:
        for path in root.rglob("*.bin"):
            points = np.fromfile(path, dtype="<f4").reshape(-1, 4)
            (points * np.float32([1, 1, 1, 255])).tofile(path)
    code, message = init(root, "--dataset", kind)
    assert code == 3
    assert "set dataset.intensity_scale = 255" in message
    assert init(root, "--dataset", kind, "--set", "dataset.intensity_scale=255")[0] == 0


def test_a_folder_and_its_workspace_must_not_contradict_each_other(init, tmp_path: Path) -> None:
    root = tmp_path / "data"
    write_toy_folder(root)
    code, message = init(root, "--dataset", "folder", "--set", "dataset.intensity_scale=100")
    assert code == 2
    assert "dataset.intensity_scale is 100.0, but" in message
    assert "has intensity_scale = 255" in message
    assert init(root, "--dataset", "folder", "--set", "dataset.intensity_scale=255")[0] == 0


def test_a_data_set_class_without_the_argument_rejects_the_setting(
    init, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would have no effect otherwise."""
    root = tmp_path / "data"
    write_toy_kitti(root, frames=2)
    (tmp_path / "plain_kitti.py").write_text(
        "from curate.datasets.kitti.dataset import KittiDataset\n"
        "class Plain(KittiDataset):\n"
        "    def __init__(self, root):\n"
        "        super().__init__(root)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert init(root, "--dataset", "plain_kitti:Plain")[0] == 0
    code, message = init(root, "--dataset", "plain_kitti:Plain", "--set", "dataset.columns=5")
    assert code == 2
    assert "dataset.columns: data set 'plain_kitti:Plain' has no argument layout" in message


def test_frames_without_an_image_are_counted(
    init, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Case 15: a raw drive with PNG and JPEG, of which two are missing."""
    root = tmp_path / "data"
    write_toy_raw(root, frames=6)
    folder = root / "2011_09_26" / DRIVE / "image_02" / "data"
    (folder / "0000000001.png").rename(folder / "0000000001.jpg")
    (folder / "0000000002.png").rename(folder / "0000000002.JPG")
    code, message = init(root, "--dataset", "kitti-raw")
    assert (code, caplog.text) == (0, "")
    assert "0 labeled, 6 unlabeled" in message
    (folder / "0000000002.JPG").unlink()
    (folder / "0000000003.png").unlink()
    code, message = init(root, "--dataset", "kitti-raw")
    assert "0 labeled, 4 unlabeled" in message
    assert "2 of 6 frames have no image" in caplog.text


def test_one_damaged_frame_is_no_reason_to_stop(
    init, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It is reported now, and recorded as failed later."""
    root = tmp_path / "data"
    write_toy_kitti(root, frames=3)
    (root / "training" / "velodyne" / "000001.bin").write_bytes(b"truncated")
    code, _ = init(root)
    assert code == 0
    assert "frame 000001 cannot be read" in caplog.text


@pytest.mark.parametrize("kind", ["kitti", "folder", "kitti-raw", "nuscenes"])
def test_another_layout_is_named(init, tmp_path: Path, kind: str) -> None:
    root = tmp_path / "data"
    write_toy_tracking(root)
    code, message = init(root, "--dataset", kind)
    assert code == 3
    assert "it looks like KITTI tracking: use --dataset kitti-tracking" in message


def test_val_frames_that_leave_no_frame_to_label(init, tmp_path: Path) -> None:
    """--val 1 is a share of 1, not one frame."""
    write_toy_kitti(tmp_path / "kitti", frames=4)
    code, message = init(tmp_path / "kitti", "--val", "1", "--labeled", "0.5")
    assert code == 2
    assert "--labeled 0.5: all frames are val frames already; give --val a share below 1" in message
