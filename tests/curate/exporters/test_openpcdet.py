"""Weighted labels as OpenPCDet's infos and object database."""

import json
import pickle
import pickletools

import numpy as np
import pytest
from support.exported import BOXES, SCORES, TRUE_BOX, WEIGHTS, toy_labels

from curate.exporters.openpcdet import OpenPCDetExporter


@pytest.fixture
def folder(tmp_path):
    """Return an export."""
    assert OpenPCDetExporter().write(tmp_path / "out", toy_labels()) == 3
    return tmp_path / "out"


def load(path):
    """Return what a trainer reads."""
    return pickle.loads(path.read_bytes())


def test_labels_are_stored_with_their_weights(folder):
    """All arrays have one row per object, so that they can be filtered by one mask."""
    infos = load(folder / "kitti_infos_train.pkl")
    assert [info["point_cloud"]["lidar_idx"] for info in infos] == ["000000", "000001"]
    annos = infos[1]["annos"]
    assert {len(array) for array in annos.values()} == {3}
    assert annos["weight"].tolist() == list(WEIGHTS)
    assert annos["score"].tolist() == list(SCORES)
    assert annos["name"].tolist() == ["Car", "DontCare", "Car"]
    assert annos["category"].tolist() == ["Car", "Pedestrian", "Car"]
    assert annos["ignored"].tolist() == [False, True, False]
    assert annos["num_points_in_gt"].tolist() == [12, -1, 3]
    np.testing.assert_array_equal(annos["gt_boxes_lidar"], BOXES)


def test_background_has_the_name_dontcare_and_is_marked(tmp_path):
    """OpenPCDet drops DontCare; a trainer that reads weights sees that it is not to be ignored."""
    OpenPCDetExporter().write(tmp_path / "out", toy_labels(zero_weight="background"))
    annos = load(tmp_path / "out" / "kitti_infos_train.pkl")[1]["annos"]
    assert annos["name"].tolist() == ["Car", "DontCare", "Car"]
    assert annos["ignored"].tolist() == [False, False, False]
    marker = json.loads((tmp_path / "out" / "export.json").read_text())
    assert marker["zero_weight"] == "background"


def test_camera_boxes_convert_to_the_lidar_boxes(folder):
    """By the equations that OpenPCDet applies to location, dimensions (l, h, w), rotation_y."""
    info = load(folder / "kitti_infos_train.pkl")[1]
    annos, calib = info["annos"], info["calib"]
    to_lidar = np.linalg.inv(calib["R0_rect"] @ calib["Tr_velo_to_cam"])
    bottom = np.column_stack([annos["location"], np.ones(3)]) @ to_lidar.T
    length, height, width = annos["dimensions"].T
    bottom[:, 2] += height / 2
    yaw = -(annos["rotation_y"] + np.pi / 2)
    boxes = np.column_stack([bottom[:, :3], length, width, height, yaw])
    assert boxes[:, :6] == pytest.approx(np.array(BOXES)[:, :6])
    assert np.sin(boxes[:, 6]) == pytest.approx(np.sin(np.array(BOXES)[:, 6]))
    assert np.cos(boxes[:, 6]) == pytest.approx(np.cos(np.array(BOXES)[:, 6]))


def test_ground_truth_has_weight_1_and_kittis_difficulty(folder):
    """A car 16 m ahead is 12 pixels high in the toy image: beyond all levels."""
    annos = load(folder / "kitti_infos_train.pkl")[0]["annos"]
    assert annos["weight"].tolist() == [1, 1]
    assert annos["score"].tolist() == [-1, -1]
    assert annos["num_points_in_gt"].tolist() == [7, 0]
    assert annos["difficulty"].tolist() == [-1, -1]


def test_the_database_has_only_objects_of_labeled_frames(folder):
    """Their points are relative to the box centre, which OpenPCDet adds again."""
    database = load(folder / "kitti_dbinfos_train.pkl")
    assert {name: len(entries) for name, entries in database.items()} == {"Car": 1, "Van": 1}
    car = database["Car"][0]
    assert (car["image_idx"], car["gt_idx"], car["weight"]) == ("000000", 0, 1.0)
    np.testing.assert_array_equal(car["box3d_lidar"], TRUE_BOX)
    points = np.fromfile(folder / car["path"], dtype=np.float32).reshape(-1, 4)
    assert len(points) == car["num_points_in_gt"] == 7
    assert points[:, 0] == pytest.approx(np.linspace(-1, 1, 7), abs=1e-6)
    assert points[:, 1:] == pytest.approx(0, abs=1e-6)


def test_any_numpy_version_reads_it_and_arrays_are_writable(folder):
    """The pickle uses no name that only numpy 2 has."""
    content = (folder / "kitti_infos_train.pkl").read_bytes()
    texts = {str(argument) for _, argument, _ in pickletools.genops(content)}
    assert "numpy ndarray" in texts
    assert not any("_core" in text for text in texts)
    annos = pickle.loads(content)[1]["annos"]
    assert all(array.flags.writeable for array in annos.values())
