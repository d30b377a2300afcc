"""Weighted labels as mmdetection3d's infos."""

import pickle

import numpy as np
import pytest
from support.exported import TRUE_BOX, WEIGHTS, toy_labels

from curate.exporters.mmdet3d import MMDet3DExporter


@pytest.fixture
def infos(tmp_path):
    """Return what a trainer reads."""
    assert MMDet3DExporter().write(tmp_path / "out", toy_labels()) == 3
    return pickle.loads((tmp_path / "out" / "kitti_infos_train.pkl").read_bytes())


def test_labels_are_stored_with_their_weights(infos):
    """The numbers of the categories are those of mmdetection3d's KittiDataset; -1 is ignored."""
    assert list(infos["metainfo"]["categories"])[:4] == ["Pedestrian", "Cyclist", "Car", "Van"]
    instances = infos["data_list"][1]["instances"]
    assert [each["weight"] for each in instances] == list(WEIGHTS)
    assert [each["bbox_label_3d"] for each in instances] == [2, -1, 2]
    assert [each["category"] for each in instances] == ["Car", "Pedestrian", "Car"]
    assert [each["ignored"] for each in instances] == [False, True, False]
    assert infos["metainfo"]["zero_weight"] == "ignore"
    truth = infos["data_list"][0]["instances"]
    assert [(each["bbox_label_3d"], each["weight"]) for each in truth] == [(2, 1.0), (3, 1.0)]


def test_background_has_no_category_and_is_marked(tmp_path):
    """Label -1 is left out; a trainer that reads weights sees that it is not to be ignored."""
    MMDet3DExporter().write(tmp_path / "out", toy_labels(zero_weight="background"))
    infos = pickle.loads((tmp_path / "out" / "kitti_infos_train.pkl").read_bytes())
    instances = infos["data_list"][1]["instances"]
    assert [each["bbox_label_3d"] for each in instances] == [2, -1, 2]
    assert [each["ignored"] for each in instances] == [False, False, False]
    assert infos["metainfo"]["zero_weight"] == "background"


def test_boxes_are_in_the_camera_frame(infos):
    """Bottom centre, then length, height, width, and the yaw about y, by hand."""
    # The toy camera is at the LiDAR: right is -y, down is -z, ahead is x.
    x, y, z, length, width, height, _ = TRUE_BOX
    box = infos["data_list"][0]["instances"][0]["bbox_3d"]
    assert box == pytest.approx([-y, -z + height / 2, x, length, height, width, -np.pi / 2])


def test_a_frame_lists_its_files_and_its_calibration(infos):
    """Only file names, which `data_prefix` completes; matrices as lists."""
    info = infos["data_list"][1]
    assert (info["sample_idx"], info["lidar_points"]["lidar_path"]) == (1, "000001.bin")
    camera = info["images"]["CAM2"]
    assert camera["img_path"] == "000001.png"
    product = np.array(camera["cam2img"]) @ np.array(camera["lidar2cam"])
    assert np.array(camera["lidar2img"]) == pytest.approx(product)
    assert info["instances"][0]["depth"] == pytest.approx(20.0)
