"""One property for every data set with labels in KITTI's form, for every mounting of the camera.

The labels are written with scipy's rotations, not with curate's conversions.
"""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.camera_boxes import in_camera, projected_rotations_y
from support.dataset_layouts import DRIVE, write_toy_folder, write_toy_raw
from support.rigs import Rig, assert_equal_boxes, detections, rigs
from support.toys import write_toy_kitti

from curate.datasets.kitti.calibration import write_calibration
from curate.datasets.kitti.labels import from_annotations, from_detections
from curate.detections import Detections
from curate.errors import ConfigError, DataError
from curate.frames import RotationY
from pipelines.registry import DATASETS

MEANINGS: tuple[RotationY, ...] = get_args(RotationY)


def _text(matrix: np.ndarray) -> str:
    return " ".join(map(repr, matrix.ravel().tolist()))


def write_kitti(root: Path, rig: Rig) -> Path:
    """Write a data set in KITTI's layout and return its label file."""
    write_toy_kitti(root, 1)
    write_calibration(root / "training/calib/000000.txt", rig.calibration)
    return root / "training/label_2/000000.txt"


def write_raw(root: Path, rig: Rig) -> Path:
    """Write a drive; a rectification takes a part of the rotation."""
    write_toy_raw(root, 1)
    date, matrix = root / "2011_09_26", rig.calibration.lidar_to_camera
    rectify = Rig(yaw=0.02, pitch=0.01).turn.as_matrix()
    (date / "calib_velo_to_cam.txt").write_text(
        f"R: {_text(rectify.T @ matrix[:3, :3])}\nT: {_text(rectify.T @ matrix[:3, 3])}\n"
    )
    (date / "calib_cam_to_cam.txt").write_text(
        f"R_rect_00: {_text(rectify)}\nP_rect_02: {_text(rig.calibration.projection)}\n"
    )
    return date / DRIVE / "label_2/0000000000.txt"


def write_folder(root: Path, rig: Rig) -> Path:
    """Write a plain folder."""
    write_toy_folder(root, 1)
    path = root / "dataset.toml"
    head = path.read_text().partition("[calibration]")[0]
    calibration = rig.calibration
    path.write_text(
        f"{head}[calibration]\nprojection = {calibration.projection.tolist()}\n"
        f"lidar_to_camera = {calibration.lidar_to_camera.tolist()}\n"
    )
    return root / "boxes/000000.txt"


LAYOUTS: Mapping[str, Callable[[Path, Rig], Path]] = {
    "kitti": write_kitti,
    "kitti-raw": write_raw,
    "folder": write_folder,
}


def write_labels(path: Path, found: Detections, rig: Rig, meaning: RotationY) -> None:
    """Write boxes as a label file."""
    bottoms, rotations_y = in_camera(
        found.boxes, rig.turn, np.array(rig.origin), rig.yaw, upside_down=rig.upside_down
    )
    if meaning in ("nuscenes", "dair-v2x"):
        rotations_y = projected_rotations_y(found.boxes, rig.turn)
    elif meaning != "calibration":
        rotations_y = -found.boxes[:, 6] - np.pi / 2
    lines = [
        f"{name} 0 0 0 1 2 3 4 {_text(np.array([*box[5:2:-1], *bottoms[k], rotations_y[k]]))}\n"
        for k, (name, box) in enumerate(zip(found.categories, found.boxes, strict=True))
    ]
    path.write_text("".join(lines))


@pytest.mark.parametrize("kind", LAYOUTS)
@settings(max_examples=15)
@given(found=detections, rig=rigs, meaning=st.sampled_from(MEANINGS))
def test_labels_are_read_in_the_lidar_frame(
    kind: str, found: Detections, rig: Rig, meaning: RotationY
) -> None:
    """And written back with the same numbers, as labels and as detections."""
    with tempfile.TemporaryDirectory() as folder:
        path = LAYOUTS[kind](Path(folder), rig)
        write_labels(path, found, rig, meaning)
        dataset = DATASETS.build(kind, Path(folder), offered={}, options={"rotation_y": meaning})
        [name] = dataset.frame_ids()
        truth, frame = dataset.annotations(name), dataset.read(name, points=False)
        fields = np.array([line.split()[8:] for line in path.read_text().splitlines()], dtype=float)
    assert_equal_boxes(truth.boxes, found.boxes)
    written = Detections(truth.boxes, found.scores, truth.categories)
    for objects in (
        from_annotations(truth, frame.calibration),
        from_detections(written, frame.calibration, frame.image_size),
    ):
        np.testing.assert_allclose(objects.dimensions, fields[:, :3], atol=1e-9)
        np.testing.assert_allclose(objects.locations, fields[:, 3:6], atol=1e-9)
        turned = np.sin((objects.rotations_y - fields[:, 6]) / 2)
        np.testing.assert_allclose(turned, 0, atol=1e-9)


@pytest.mark.parametrize("kind", LAYOUTS)
def test_impossible_calibrations_are_rejected_with_their_file(kind: str, tmp_path: Path) -> None:
    """A mirrored one at once, a camera that looks down where its labels are read."""
    path = LAYOUTS[kind](tmp_path / "down", Rig(pitch=np.pi / 2))
    dataset = DATASETS.build(kind, tmp_path / "down", offered={}, options={})
    [name] = dataset.frame_ids()
    dataset.read(name)
    with pytest.raises(DataError, match=f"{path.name}: the camera's y axis is 0.0 degrees"):
        dataset.annotations(name)

    class Mirrored(Rig):
        @property
        def calibration(self):
            found = super().calibration
            found.lidar_to_camera[1] *= -1
            return found

    LAYOUTS[kind](tmp_path / "mirrored", Mirrored())
    with pytest.raises(DataError, match=r"(000000\.txt|calib_velo_to_cam\.txt|toml).* mirrors"):
        DATASETS.build(kind, tmp_path / "mirrored", offered={}, options={}).read(name)


@pytest.mark.parametrize("kind", LAYOUTS)
def test_an_unknown_meaning_of_rotation_y_is_rejected(kind: str, tmp_path: Path) -> None:
    LAYOUTS[kind](tmp_path, Rig())
    with pytest.raises(ConfigError, match=r"option rotation_y = \"lidar\" should be 'cal"):
        DATASETS.build(kind, tmp_path, offered={}, options={"rotation_y": "lidar"})
