"""Valid files of nuScenes, Parquet, masks and instance models for fuzzing, and their readers."""

import json
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from support.nuscenes_scenes import into_map, vehicle_pose, write_nuscenes
from support.toys import IMAGE_SIZE, toy_calibration

from curate.frames import Frame

CLASSES = {"Car": (3,), "Pedestrian": (1,)}


def _mapped() -> Frame:
    """Return a frame with a LiDAR pose in the map."""
    pose = vehicle_pose(0, 0)
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = pose.turn.as_matrix(), pose.place
    calibration = replace(toy_calibration(), lidar_to_map=placed)
    return Frame("000000", np.zeros((0, 4), np.float32), calibration, IMAGE_SIZE)


def write_map_results(path: Path) -> None:
    """Write results of two frames in nuScenes' format."""
    boxes = into_map(np.array([[10.0, 2, -1, 4.2, 1.8, 1.5, 0.3]]), vehicle_pose(0, 0))
    fields = {"detection_name": "car", "detection_score": 0.5}
    results = {name: [box | fields for box in boxes] for name in ("000000", "000001")}
    path.write_text(json.dumps({"meta": {"use_lidar": True}, "results": results}))


def read_map_results(path: Path) -> None:
    """Read both frames, in the LiDAR frame."""
    from curate.detectors.recorded import RecordedDetector

    detector = RecordedDetector(path)
    for name in detector.frame_ids():
        detector.predict(replace(_mapped(), frame_id=name))


def write_tables(path: Path) -> None:
    """Write a tiny nuScenes dataset; the table in `path` will be damaged."""
    write_nuscenes(path.parent.parent, scenes=("scene-0061",), steps=1)


def read_tables(path: Path) -> None:
    """Read everything in the dataset."""
    from curate.datasets.nuscenes import NuScenesDataset

    dataset = NuScenesDataset(path.parent.parent)
    dataset.splits()
    for name in dataset.frame_ids():
        dataset.read(name)
        dataset.annotations(name)


def write_parquet(path: Path) -> None:
    """Write three frames of two boxes with a view, in two row groups."""
    import pyarrow as pa
    from pyarrow import parquet

    numbers = ("score", "x", "y", "z", "length", "width", "height", "yaw")
    columns = {
        "frame": [f"00000{i // 4}" for i in range(12)],
        "category": ["Car", "Pedestrian"] * 6,
        **{name: np.linspace(0.1, 1, 12) for name in numbers},
        "view": [0, 0, 1, 1] * 3,
        "flip_y": [0, 0, 1, 1] * 3,
        "rotation_rad": [0.0, 0, 0.2, 0.2] * 3,
        "scale": [1.0, 1, 1.02, 1.02] * 3,
    }
    parquet.write_table(pa.table(columns), path, row_group_size=6)


def read_parquet(path: Path) -> None:
    """Read every frame and view."""
    from curate.detectors.recorded.parquet import ParquetRecord

    record = ParquetRecord.read(path)
    for name in record.frame_ids():
        record.result(name)
        record.views(name)


def _image_frame() -> Frame:
    image = np.zeros((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), dtype=np.uint8)
    points = np.zeros((0, 4), np.float32)
    return Frame("000000", points, toy_calibration(), IMAGE_SIZE, image)


def write_masks(path: Path) -> None:
    """Write masks of a frame in each of COCO's three formats."""
    width, height = IMAGE_SIZE
    runs = [5 * height, 100, width * height - 5 * height - 100]
    forms = [
        {"size": [height, width], "counts": runs},
        {"size": [height, width], "counts": "0" + _packed(width * height)},
        [[5, 5, 60, 5, 60, 30, 5.5, 30]],
    ]
    objects = [
        {"image_id": 1, "category_id": 3, "score": 0.9, "segmentation": form} for form in forms
    ]
    images = [{"id": 1, "file_name": "000000.png"}]
    path.write_text(json.dumps({"images": images, "annotations": objects}))


def _packed(number: int) -> str:
    """Return a non-negative number in the characters of compressed runs."""
    text = ""
    while True:
        bits, number = number & 31, number >> 5
        more = number > 0 or bool(bits & 16)
        text += chr(48 + bits + 32 * more)
        if not more:
            return text


def read_masks(path: Path) -> None:
    """Read the file as a map of the frame."""
    from curate.segmenters.instances import InstanceSegmenter

    InstanceSegmenter(path, CLASSES).segment(_image_frame())


def write_wide_map(path: Path) -> None:
    """Write a map of 16 bits: class * 1000 + instance."""
    cv2.imwrite(str(path), np.full((IMAGE_SIZE[1], IMAGE_SIZE[0]), 3002, dtype=np.uint16))


def read_wide_map(path: Path) -> None:
    """Read the file as a map of the frame."""
    from curate.segmenters.saved import SavedSegmenter

    SavedSegmenter(path.parent, CLASSES, divisor=1000).segment(_image_frame())


def write_indexed_map(path: Path) -> None:
    """Write a map of four bits with a palette, in the pattern of a chess board."""
    from PIL import Image

    rows, columns = np.mgrid[: IMAGE_SIZE[1], : IMAGE_SIZE[0]]
    image = Image.fromarray(((rows + columns) % 16).astype(np.uint8), "P")
    image.putpalette(list(range(48)))
    image.save(path, bits=4)


def write_coloured_map(path: Path) -> None:
    """Write a map with Cityscapes' colours of road and car."""
    pixels = np.full((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), (128, 64, 128), dtype=np.uint8)
    pixels[10:20, 10:20] = (142, 0, 0)
    cv2.imwrite(str(path), pixels)


def write_array_map(path: Path) -> None:
    """Write a map as np.save does."""
    np.save(path, np.ones((IMAGE_SIZE[1], IMAGE_SIZE[0]), dtype=np.int64))


def read_other_map(path: Path) -> None:
    """Read the file as a map of the frame: by its values, and by its colours."""
    from curate.errors import DataError
    from curate.segmenters.saved import SavedSegmenter

    try:
        SavedSegmenter(path.parent, CLASSES).segment(_image_frame())
    except DataError:
        SavedSegmenter(path.parent, CLASSES, colours="cityscapes").segment(_image_frame())


def write_feather(path: Path) -> None:
    """Write three sweeps of Argoverse 2 in two record batches."""
    import pyarrow as pa
    from pyarrow import feather

    numbers = ("tx_m", "ty_m", "tz_m", "length_m", "width_m", "height_m", "score")
    columns = {
        **{name: np.linspace(0.1, 1, 12) for name in numbers},
        **{name: np.full(12, float(name == "qw")) for name in ("qw", "qx", "qy", "qz")},
        "log_id": ["02678d04"] * 12,
        "timestamp_ns": [315966070559696000 + i // 4 for i in range(12)],
        "category": ["REGULAR_VEHICLE", "PEDESTRIAN"] * 6,
    }
    feather.write_feather(pa.table(columns), path, chunksize=6)


def read_recorded(path: Path) -> None:
    """Read every frame of recorded detections."""
    from curate.detectors.recorded import RecordedDetector

    detector = RecordedDetector(path)
    for name in detector.frame_ids():
        detector.predict(replace(_mapped(), frame_id=name))


def write_instance_model(path: Path) -> None:
    """Write a model with two constant objects."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    found = {
        "boxes": np.float32([[5, 5, 60, 30], [20, 2, 90, 38]]),
        "labels": np.int64([3, 1]),
        "scores": np.float32([0.9, 0.8]),
        "masks": np.ones((2, 1, 4, 4), np.float32),
    }
    nodes = [
        helper.make_node("Constant", [], [name], value=numpy_helper.from_array(values))
        for name, values in found.items()
    ]
    kinds = [TensorProto.INT64 if name == "labels" else TensorProto.FLOAT for name in found]
    outputs = [
        helper.make_tensor_value_info(name, kind, values.shape)
        for (name, values), kind in zip(found.items(), kinds, strict=True)
    ]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, (1, 3, 16, 24))
    graph = helper.make_graph(nodes, "tiny", [image], outputs)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.save(model, str(path))


def read_instance_model(path: Path) -> None:
    """Read the file as a map of the frame."""
    from curate.segmenters.onnx_instances import OnnxInstanceSegmenter

    OnnxInstanceSegmenter(path, CLASSES).segment(_image_frame())


Use = Callable[[Path], None]
FORMATS: dict[str, tuple[str, Use, Use]] = {
    "nuscenes results": ("a.json", write_map_results, read_map_results),
    "masks": ("a.json", write_masks, read_masks),
    "saved map of 16 bits": ("000000.png", write_wide_map, read_wide_map),
    "saved map with a palette": ("000000.png", write_indexed_map, read_other_map),
    "saved map in colours": ("000000.png", write_coloured_map, read_other_map),
    "saved map as an array": ("000000.npy", write_array_map, read_other_map),
    "onnx instances": ("a.onnx", write_instance_model, read_instance_model),
} | {
    f"nuscenes {table}": (f"v1.0-mini/{table}.json", write_tables, read_tables)
    for table in ("sample_data", "calibrated_sensor", "ego_pose", "sample_annotation", "sample")
}
"""Name of the file, what writes it, and what reads it."""

if find_spec("pyarrow"):
    FORMATS["parquet"] = ("a.parquet", write_parquet, read_parquet)
    FORMATS["feather"] = ("a.feather", write_feather, read_recorded)
