"""The layout of converters of the Waymo Open Dataset: several cameras, each with an extrinsic."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.toys import toy_calibration, write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import ConfigError

NAMES = ("0000000", "0000001", "0001000", "1000000")


def text(matrix: np.ndarray) -> str:
    """Return the entries of a matrix for a calibration file."""
    return " ".join(map(repr, matrix.ravel().tolist()))


def write_waymo(root: Path, cameras: tuple[int, ...] = (0, 1, 2)) -> None:
    """Write four toy frames; camera n is turned by n times 20 degrees, and image n is n bright."""
    write_toy_kitti(root / "made", frames=4)
    home = root / "training"
    front = toy_calibration()
    for folder in ("velodyne", "calib", "label_all", *(f"image_{n}" for n in cameras)):
        (home / folder).mkdir(parents=True)
    for name, made in zip(NAMES, sorted((root / "made/training/velodyne").iterdir()), strict=True):
        shutil.copy(made, home / "velodyne" / f"{name}.bin")
        shutil.copy(
            root / "made/training/label_2" / f"{made.stem}.txt", home / "label_all" / f"{name}.txt"
        )
        lines = ["R0_rect: 1 0 0 0 1 0 0 0 1"]
        for n in cameras:
            cos, sin = np.cos(0.35 * n), np.sin(0.35 * n)
            turn = np.array([[cos, 0, -sin, 0.1 * n], [0, 1, 0, 0], [sin, 0, cos, 0], [0, 0, 0, 1]])
            lines.append(f"P{n}: {text(front.projection + n * np.eye(3, 4))}")
            lines.append(f"Tr_velo_to_cam_{n}: {text((turn @ front.lidar_to_camera)[:3])}")
            image = np.full((40, 120, 3), 10 * n, np.uint8)
            cv2.imwrite(str(home / f"image_{n}" / f"{name}.jpg"), image)
        (home / "calib" / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (root / "ImageSets").mkdir()
    shutil.rmtree(root / "made" / "ImageSets")


@pytest.mark.parametrize("camera", [None, 0, 1, 2])
def test_each_camera_has_its_image_and_calibration(tmp_path: Path, camera: int | None) -> None:
    """The front camera is the default; all labels are in the frame of the front camera."""
    write_waymo(tmp_path)
    dataset = KittiDataset(tmp_path, camera=camera)
    number = camera or 0
    assert dataset.frame_ids() == NAMES
    frame = dataset.read(NAMES[0], image=True)
    assert (np.abs(frame.image.astype(int) - 10 * number) < 3).all()
    assert frame.calibration.projection[0, 0] == 60 + number
    position = np.linalg.inv(frame.calibration.lidar_to_camera)[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(position), 0.1 * number, atol=1e-12)
    expected = KittiDataset(tmp_path / "made").annotations("000000")
    np.testing.assert_allclose(dataset.annotations(NAMES[0]).boxes, expected.boxes, atol=1e-9)


def test_rotation_y_is_that_of_the_converter_unless_declared(tmp_path: Path) -> None:
    write_waymo(tmp_path)
    assert KittiDataset(tmp_path).read(NAMES[0]).calibration.rotation_y == "mmdetection3d"
    declared = KittiDataset(tmp_path, rotation_y="calibration")
    assert declared.read(NAMES[0]).calibration.rotation_y == "calibration"


def test_labels_of_the_camera_come_first(tmp_path: Path) -> None:
    write_waymo(tmp_path)
    (tmp_path / "training" / "label_1").mkdir()
    (tmp_path / "training" / "label_1" / f"{NAMES[0]}.txt").write_text("")
    assert len(KittiDataset(tmp_path, camera=1).annotations(NAMES[0])) == 0
    assert len(KittiDataset(tmp_path, camera=0).annotations(NAMES[0])) == 3


def test_segments_stay_whole(tmp_path: Path) -> None:
    """A name is a digit for the split, three for the segment and three for the frame."""
    write_waymo(tmp_path)
    dataset = KittiDataset(tmp_path)
    assert [dataset.sequence_of(name) for name in NAMES] == ["0000", "0000", "0001", "1000"]
    assert dataset.sequence_of("000008") is None


def test_a_camera_without_images_is_rejected(tmp_path: Path) -> None:
    write_waymo(tmp_path)
    with pytest.raises(ConfigError, match=r"no folder image_4; its cameras are 0 \(image_0\), 1"):
        KittiDataset(tmp_path, camera=4)


def test_the_only_camera_is_chosen(tmp_path: Path, toy_kitti: Path) -> None:
    """KITTI's own layout has image_2, or image_0 after a conversion with one camera."""
    write_waymo(tmp_path, cameras=(1,))
    with pytest.raises(ConfigError):
        KittiDataset(tmp_path, camera=2)
    assert KittiDataset(tmp_path).camera == 1
    assert KittiDataset(toy_kitti).camera == 2
    (toy_kitti / "training" / "image_3").mkdir()
    assert KittiDataset(toy_kitti).camera == 2
