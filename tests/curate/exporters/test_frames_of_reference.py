"""One property for every export in another frame of reference: its readers get the same boxes."""

import json
import pickle
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from oracles.camera_boxes import in_camera, mmdetection3d_boxes, openpcdet_boxes
from support.exported import block, label, toy_labels, truth, truth_block
from support.rigs import LEFT, TILTED, Rig, assert_equal_boxes, detections, rigs

from curate.datasets.kitti.labels import read_objects, to_detections
from curate.detections import Detections
from curate.detectors.recorded import RecordedDetector
from curate.errors import DataError
from curate.exporters.base import LabelSet
from curate.exporters.coco import CocoExporter
from curate.exporters.kitti import KittiExporter
from curate.exporters.mmdet3d import MMDet3DExporter
from curate.exporters.nuscenes import NuScenesExporter
from curate.exporters.openpcdet import OpenPCDetExporter

FOUR_DIGITS = 1e-4


def labels_of(found: Detections, rig: Rig) -> LabelSet:
    """Return the detections as labels of frame 000001 and as ground truth of frame 000000."""
    names = [{"Cyclist": "bicycle"}.get(name, name.lower()) for name in found.categories.tolist()]
    rows = [label("000001", k, box, category=names[k]) for k, box in enumerate(found.boxes)]
    true = [truth("000000", k, box) for k, box in enumerate(found.boxes)]
    return replace(
        toy_labels(),
        labels=[block(rows)],
        ground_truth=truth_block(true),
        read=rig.frame,
        read_points=rig.frame,
    )


def openpcdet_and_mmdet3d(folder: Path, found: Detections, rig: Rig) -> list[np.ndarray]:
    """Return the boxes that the two frameworks get of the labeled and the unlabeled frame."""
    labels = labels_of(found, rig)
    OpenPCDetExporter().write(folder / "pcdet", labels)
    infos = pickle.loads((folder / "pcdet" / "kitti_infos_train.pkl").read_bytes())
    boxes = [
        openpcdet_boxes(
            info["annos"]["location"],
            info["annos"]["dimensions"],
            info["annos"]["rotation_y"],
            info["calib"]["R0_rect"] @ info["calib"]["Tr_velo_to_cam"],
        )
        for info in infos
    ]
    MMDet3DExporter().write(folder / "mmdet3d", labels)
    content = pickle.loads((folder / "mmdet3d" / "kitti_infos_train.pkl").read_bytes())
    for info in content["data_list"]:
        camera_boxes = np.array([each["bbox_3d"] for each in info["instances"]])
        standing = mmdetection3d_boxes(camera_boxes, np.array(info["images"]["CAM2"]["lidar2cam"]))
        standing[:, 2] += standing[:, 5] / 2
        boxes.append(standing)
    return boxes


@settings(max_examples=20)
@given(found=detections, rig=rigs)
def test_openpcdet_and_mmdetection3d_get_the_same_boxes(found: Detections, rig: Rig) -> None:
    """By their own formulas, whatever the mounting of the camera."""
    with tempfile.TemporaryDirectory() as folder:
        for boxes in openpcdet_and_mmdet3d(Path(folder), found, rig):
            assert_equal_boxes(boxes, found.boxes)


@settings(max_examples=20)
@given(found=detections, rig=rigs)
def test_kitti_files_are_in_the_camera_frame(found: Detections, rig: Rig) -> None:
    """As computed with scipy; curate reads the same boxes back, also as recorded results."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kitti"
        KittiExporter().write(path, labels_of(found, rig))
        file = path / "label_2" / "000001.txt"
        objects = read_objects(file, scored=True, categories=None)
        bottoms, rotations_y = in_camera(
            found.boxes, rig.turn, np.array(rig.origin), rig.yaw, upside_down=rig.upside_down
        )
        np.testing.assert_allclose(objects.locations, bottoms, atol=FOUR_DIGITS)
        turned = np.sin((objects.rotations_y - rotations_y) / 2)
        np.testing.assert_allclose(turned, 0, atol=FOUR_DIGITS)
        back = to_detections(objects, rig.calibration).boxes
        assert_equal_boxes(back, found.boxes, FOUR_DIGITS)
        recorded = RecordedDetector(path / "label_2").predict(rig.frame("000001"))
        np.testing.assert_array_equal(recorded.boxes, back)


def test_openpcdet_gets_the_boxes_of_a_camera_that_looks_down(tmp_path: Path) -> None:
    """Its formula needs no heading in the camera frame; KITTI's files do."""
    rig = Rig(pitch=1.57)
    found = Detections(np.array([[1.0, 2, -3, 4, 2, 1.5, 0.4]]), np.ones(1), np.array(["Car"]))
    for boxes in openpcdet_and_mmdet3d(tmp_path, found, rig):
        assert_equal_boxes(boxes, found.boxes)
    with pytest.raises(DataError, match=r"frame 000001: the camera's y axis is 0\.0 degrees"):
        KittiExporter().write(tmp_path / "kitti", labels_of(found, rig))


@settings(max_examples=20)
@given(found=detections, rig=rigs)
def test_nuscenes_results_are_read_back(found: Detections, rig: Rig) -> None:
    """Map and LiDAR frame, independent of the camera."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.json"
        NuScenesExporter().write(path, labels_of(found, rig))
        back = RecordedDetector(path, kind="nuscenes").predict(rig.frame("000001"))
        assert_equal_boxes(back.boxes, found.boxes)


@settings(max_examples=10)
@given(found=detections, rig=rigs)
def test_coco_keeps_the_boxes_of_the_lidar_frame(found: Detections, rig: Rig) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.json"
        CocoExporter().write(path, labels_of(found, rig))
        boxes = [each["box_3d"] for each in json.loads(path.read_text())["annotations"]]
        np.testing.assert_array_equal(boxes, np.vstack([found.boxes, found.boxes]))


@pytest.mark.parametrize("rig", [TILTED, LEFT, Rig(yaw=-0.3, pitch=0.4, roll=0.2)])
def test_alpha_is_the_heading_seen_from_the_camera(rig: Rig, tmp_path: Path) -> None:
    """rotation_y by the calibration minus the angle of the ray, in every format with alpha."""
    boxes = np.array([[12.0, 3.0, -0.9, 4.1, 1.7, 1.5, 0.4], [15.0, -6.0, -0.8, 4, 1.8, 1.6, 2]])
    found = Detections(boxes, np.ones(2), np.array(["Car", "Car"]))
    bottoms, rotations_y = in_camera(
        boxes, rig.turn, np.array(rig.origin), rig.yaw, upside_down=False
    )
    expected = np.exp(1j * (rotations_y - np.arctan2(bottoms[:, 0], bottoms[:, 2])))
    labels = labels_of(found, rig)
    KittiExporter().write(tmp_path / "kitti", labels)
    text = read_objects(tmp_path / "kitti/label_2/000001.txt", scored=True, categories=None)
    OpenPCDetExporter().write(tmp_path / "pcdet", labels)
    info = pickle.loads((tmp_path / "pcdet/kitti_infos_train.pkl").read_bytes())[1]
    MMDet3DExporter().write(tmp_path / "mmdet3d", labels)
    content = pickle.loads((tmp_path / "mmdet3d/kitti_infos_train.pkl").read_bytes())
    instances = content["data_list"][1]["instances"]
    for alpha in (text.alpha, info["annos"]["alpha"], [each["alpha"] for each in instances]):
        np.testing.assert_allclose(np.exp(1j * np.array(alpha)), expected, atol=FOUR_DIGITS)
