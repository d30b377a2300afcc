"""Every reader of external files: a valid file for each, and a function that reads it."""

import io
import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from fuzzing.foreign_formats import FORMATS
from fuzzing.mutations import Choose, mutated
from fuzzing.native import damaged_onnx, damaged_png
from support.dataset_layouts import write_cloud
from support.exported import toy_labels
from support.toys import IMAGE_SIZE, toy_calibration

from curate.datasets.folder import FolderDataset
from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.containment import check_frame_id
from curate.datasets.formats.images import read_image, read_image_size
from curate.datasets.frame_names import read_frame_list
from curate.datasets.kitti.calibration import (
    read_calibration,
    read_raw_calibration,
    write_calibration,
)
from curate.datasets.kitti.dataset import read_drives, read_points
from curate.datasets.kitti.labels import parse_rows, read_objects, to_annotations, to_detections
from curate.datasets.kitti.oxts import read_lidar_to_imu, read_oxts
from curate.datasets.kitti.oxts import read_times as read_timestamps
from curate.datasets.kitti.tracking import rows_by_frame
from curate.datasets.kitti.tracklets import TrackletTable
from curate.datasets.motion import read_pose, read_times
from curate.detectors.recorded.formats import read_results
from curate.detectors.recorded.results import ReadOptions
from curate.detectors.recorded.table import TableRecord
from curate.errors import CurateError
from curate.exporters.sqlite import SqliteExporter
from curate.frames import Frame

LABELS = (
    b"Car 0.00 0 1.55 614.24 181.78 727.31 284.77 1.57 1.73 4.15 1.00 1.75 13.22 1.62\n"
    b"DontCare -1 -1 -10 5.00 229.89 214.12 367.61 -1 -1 -1 -1000 -1000 -1000 -10\n"
)
POSE = {"tx": 20, "ty": 0, "tz": -1.7, "rx": 0, "ry": 0, "rz": 0.5, "occlusion": 0, "truncation": 0}
DESCRIPTION = """points = "lidar"
images = "camera"
columns = 4
intensity_scale = 255.0
sequence_separator = "_"
[calibration]
projection = [[60.0, 0, 60, 0], [0, 60, 20, 0], [0, 0, 1, 0]]
lidar_to_camera = [[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]
"""
COLUMNS = "frame,view,flip_y,rotation_rad,scale,category,score,x,y,z,length,width,height,yaw"


@dataclass(frozen=True)
class Target:
    """A reader.

    Attributes:
        name: of the file that it reads.
        write: creates a valid one in an otherwise empty folder, with the files that it refers to.
        read: reads it; raises nothing but `CurateError`.
        damage: returns damaged content of the file.
    """

    name: str
    write: Callable[[Path], None]
    read: Callable[[Path], object]
    damage: Callable[[bytes, Choose], bytes] = mutated

    def attempt(self, path: Path) -> CurateError | None:
        """Read the file; return the error if it is rejected, after checking that it is one line."""
        try:
            self.read(path)
        except CurateError as error:
            rejected = error
        else:
            return None
        assert len(str(rejected).splitlines()) == 1, repr(str(rejected))
        return rejected


def toy_frame() -> Frame:
    """Return a frame with a hundred points."""
    points = np.random.default_rng(0).uniform([5, -5, -2, 0], [30, 5, 1, 1], (100, 4))
    image = np.zeros((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), dtype=np.uint8)
    return Frame("000000", points.astype(np.float32), toy_calibration(), IMAGE_SIZE, image)


def _bytes(content: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(content) and None


def _cloud(path: Path) -> None:
    write_cloud(path, toy_frame().points)


def _ply_of_bytes(path: Path) -> None:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 100\n{names}end_header\n"
    path.write_bytes(head.encode() + toy_frame().points.tobytes())


def _pcd_of_text(path: Path) -> None:
    rows = "\n".join(" ".join(map(str, row)) for row in toy_frame().points.tolist())
    path.write_text(
        "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH 100\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 100\nDATA ascii\n{rows}\n"
    )


def _image(path: Path) -> None:
    import cv2

    pixels = np.random.default_rng(0).integers(0, 255, (12, 20, 3), dtype=np.uint8)
    cv2.imwrite(str(path), pixels)


def _read_image(path: Path) -> None:
    read_image_size(path)
    read_image(path)


def _map(path: Path) -> None:
    import cv2

    cv2.imwrite(str(path), np.ones((IMAGE_SIZE[1], IMAGE_SIZE[0]), dtype=np.uint8))


def _read_map(path: Path) -> None:
    from curate.segmenters.saved import SavedSegmenter

    SavedSegmenter(path.parent, {"Car": (1,)}).segment(toy_frame())


def _read_labels(path: Path) -> None:
    to_annotations(read_objects(path), toy_calibration())


def _read_results(path: Path) -> None:
    to_detections(read_objects(path, scored=True, categories=None), toy_calibration())


def _tracking_labels(path: Path) -> None:
    car = "Car 0 0 -1.5 60 17 64 20 1.5 1.6 3.9 1.0 1.7 20.0 -1.57"
    path.write_text(
        f"0 3 {car}\n0 -1 DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1 -1 -1 -1\n1 3 {car} 0.5\n"
    )


def _read_tracking_labels(path: Path) -> None:
    for rows in rows_by_frame(path).values():
        to_annotations(parse_rows(path, rows, categories=None), toy_calibration())


def _tracklets(path: Path) -> None:
    pose = "".join(f"<{key}>{value}</{key}>\n" for key, value in POSE.items())
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
        "<boost_serialization>\n<tracklets>\n<count>1</count>\n<item>\n<objectType>Car</objectType>\n"
        "<h>1.5</h>\n<w>1.6</w>\n<l>4</l>\n<first_frame>0</first_frame>\n<poses>\n<count>1</count>\n"
        f"<item>\n{pose}</item>\n</poses>\n</item>\n</tracklets>\n</boost_serialization>\n"
    )


def _read_tracklets(path: Path) -> None:
    TrackletTable(path).read(0, toy_frame())


def _raw_calibration(path: Path) -> None:
    (path.parent / "calib_cam_to_cam.txt").write_text(
        "R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: 60 0 60 0 0 60 20 0 0 0 1 0\n"
    )
    path.write_text("calib_time: 15-Mar-2012 11:37:16\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")


def _drives(path: Path) -> None:
    (path.parent / "train_mapping.txt").write_text(
        "2011_09_26 2011_09_26_drive_0005_sync 0000000109\n"
        "2011_09_26 2011_09_26_drive_0009_sync 0000000130\n"
    )
    path.write_text("2,1")


def _description(path: Path) -> None:
    (path.parent / "lidar").mkdir()
    (path.parent / "camera").mkdir()
    _cloud(path.parent / "lidar" / "a_0.bin")
    _image(path.parent / "camera" / "a_0.png")
    path.write_text(DESCRIPTION)


def _read_folder(path: Path) -> None:
    dataset = FolderDataset(path.parent)
    dataset.splits()
    for name in dataset.frame_ids():
        dataset.sequence_of(name)
        dataset.read(name)


def _config(path: Path) -> None:
    from pipelines.workspace.config import Config
    from pipelines.workspace.config_file import write_config

    write_config(path, Config.model_validate({"dataset": {"root": "data"}}))


def _read_config(path: Path) -> None:
    from pipelines.workspace.workspace import Workspace

    read = Workspace.open(path.parent)
    read.database.close()


def _entries() -> list[dict]:
    return [
        {
            "frame_id": f"00000{i}",
            "name": np.array(["Car", "Pedestrian"]),
            "score": np.array([0.9, 0.5], dtype=np.float32),
            "boxes_lidar": np.full((2, 7), 1.5, dtype=np.float32),
        }
        for i in range(2)
    ]


def _pickled(protocol: int) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(pickle.dumps(_entries(), protocol=protocol)) and None


def _pseudo_labels(path: Path) -> None:
    row = [1.5, 2, 0, 4, 2, 1.5, 0.5, 1, 0.75]
    frame = {"gt_boxes": np.array([row, row]), "cls_scores": None, "iou_scores": np.full(2, 0.5)}
    path.write_bytes(pickle.dumps({"000000": frame, "000001": frame}, protocol=4))


def _json(path: Path) -> None:
    entry = {"bboxes_3d": [[1.0, 2, 0, 4, 2, 1.5, 0]], "scores_3d": [0.5], "labels_3d": [0]}
    path.write_text(json.dumps([{"frame_id": f"00000{i}", **entry} for i in range(2)]))


def _read_list(path: Path) -> None:
    results = read_results(path, "list", ReadOptions(("Car",)))
    for name in results:
        results[name]


def _read_table(path: Path) -> None:
    record = TableRecord.read(path)
    for name in record.frame_ids():
        record.result(name)


def _safetensors(path: Path) -> None:
    from safetensors.numpy import save

    metadata = {"format": "curate-pillars", "format_version": "2", "preset": "small"}
    tensors = {"stem.weight": np.zeros((4, 4), np.float32), "head.bias": np.zeros(3, np.float32)}
    path.write_bytes(save(tensors, {**metadata, "categories": '["Car"]'}))


def _read_checkpoint(path: Path) -> None:
    from curate.detectors.pillars.checkpoint import load_checkpoint, write_graph
    from curate.detectors.pillars.network import network_of
    from curate.errors import ModelError

    checkpoint = load_checkpoint(path)
    try:
        write_graph(path, checkpoint, "")
    except ModelError:
        network_of(checkpoint)


def _openpcdet(path: Path) -> None:
    from support.openpcdet_files import write_files

    write_files(path.parent).rename(path)


def _read_openpcdet(path: Path) -> None:
    from curate.detectors.openpcdet.checkpoint import load_network

    load_network(path, path.parent / "model.yaml")


def _model_file(path: Path) -> None:
    from support.openpcdet_files import document

    path.write_text(json.dumps(document()))


def _read_model_file(path: Path) -> None:
    from curate.detectors.openpcdet.schema import load_model_file

    load_model_file(path)


def _onnx(path: Path) -> None:
    from support.tiny_onnx import tiny_detector

    tiny_detector(path)


def _read_onnx(path: Path) -> None:
    from curate.detectors.onnx import OnnxDetector

    OnnxDetector(path, classes=("Car", "Pedestrian", "Cyclist")).predict(toy_frame())


def _segmenter(path: Path) -> None:
    import onnx
    from onnx import TensorProto, helper

    graph = helper.make_graph(
        [helper.make_node("ArgMax", ["image"], ["classes"], axis=1, keepdims=0)],
        "tiny",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, (1, 3, 16, 24))],
        [helper.make_tensor_value_info("classes", TensorProto.INT64, (1, 16, 24))],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.save(model, str(path))


def _read_segmenter(path: Path) -> None:
    from curate.segmenters.onnx import OnnxSegmenter

    OnnxSegmenter(path, {"Car": (1,)}).segment(toy_frame())


def _label_file(path: Path) -> None:
    SqliteExporter().write(path, toy_labels())


def _read_label_file(path: Path) -> None:
    from curate.training.labels import WeightedLabels

    for sample in WeightedLabels(path, read=_safe_frame):
        assert sample.weights.shape == (len(sample.boxes),)


def _safe_frame(name: str) -> Frame:
    check_frame_id(name)
    return toy_frame()


def _npy(path: Path) -> None:
    buffer = io.BytesIO()
    np.save(buffer, toy_frame().points)
    path.write_bytes(buffer.getvalue())


_DAMAGES = {".png": damaged_png, ".onnx": damaged_onnx}
TARGETS: dict[str, Target] = {
    "velodyne": Target("a.bin", _cloud, read_points),
    "calibration": Target(
        "a.txt", lambda path: write_calibration(path, toy_calibration()), read_calibration
    ),
    "raw calibration": Target(
        "calib_velo_to_cam.txt", _raw_calibration, lambda path: read_raw_calibration(path.parent)
    ),
    "imu calibration": Target(
        "calib_imu_to_velo.txt", _bytes(b"R: 1 0 0 0 1 0 0 0 1\nT: -1 0 0.5\n"), read_lidar_to_imu
    ),
    "oxts": Target(
        "0000.txt", _bytes(b"49.0 8.4 110 0 0 1.5 0 0\n49.1 8.4 110 0 0 1.5\n"), read_oxts
    ),
    "timestamps": Target(
        "timestamps.txt",
        _bytes(b"2011-09-26 13:02:25.59\n2011-09-26 13:02:25.69\n"),
        read_timestamps,
    ),
    "times": Target("times.txt", _bytes(b"a_0 0.5\na_1 1e2\n"), read_times),
    "pose": Target("a_0.txt", _bytes(b"1 0 0 5\n0 1 0 6\n0 0 1 7\n"), read_pose),
    "drives": Target("train_rand.txt", _drives, lambda path: read_drives(path.parent)),
    "frame list": Target("train.txt", _bytes(b"000000\n000001\n"), read_frame_list),
    "labels": Target("000000.txt", _bytes(LABELS), _read_labels),
    "results": Target("000000.txt", _bytes(LABELS.replace(b"\n", b" 0.5\n")), _read_results),
    "png": Target("a.png", _image, _read_image),
    "jpg": Target("a.jpg", _image, _read_image),
    "saved map": Target("000000.png", _map, _read_map),
    "tracking labels": Target("a.txt", _tracking_labels, _read_tracking_labels),
    "tracklets": Target("tracklet_labels.xml", _tracklets, _read_tracklets),
    "bin": Target("a.bin", _cloud, read_cloud),
    "npy": Target("a.npy", _npy, read_cloud),
    "pcd": Target("a.pcd", _cloud, read_cloud),
    "pcd text": Target("a.pcd", _pcd_of_text, read_cloud),
    "ply": Target("a.ply", _ply_of_bytes, read_cloud),
    "ply text": Target("a.ply", _cloud, read_cloud),
    "description": Target("dataset.toml", _description, _read_folder),
    "configuration": Target("curate.toml", _config, _read_config),
    "csv record": Target(
        "a.csv",
        _bytes(f"{COLUMNS}\n000000,0,0,0.0,1.0,Car,0.9,1,2,3,4,2,1.5,0.5\n".encode()),
        _read_table,
    ),
    "st3d": Target("ps_label_e0.pkl", _pseudo_labels, _read_list),
    "pickle 2": Target("a.pkl", _pickled(2), _read_list),
    "pickle 5": Target("a.pkl", _pickled(5), _read_list),
    "json": Target("a.json", _json, _read_list),
    "checkpoint": Target("a.safetensors", _safetensors, _read_checkpoint),
    "openpcdet checkpoint": Target("a.pth", _openpcdet, _read_openpcdet),
    "openpcdet model file": Target("a.yaml", _model_file, _read_model_file),
    "onnx detector": Target("a.onnx", _onnx, _read_onnx),
    "onnx segmenter": Target("a.onnx", _segmenter, _read_segmenter),
    "label file": Target("labels.sqlite", _label_file, _read_label_file),
} | {name: Target(*of) for name, of in FORMATS.items()}
TARGETS = {
    name: replace(target, damage=_DAMAGES.get(Path(target.name).suffix, mutated))
    for name, target in TARGETS.items()
}
