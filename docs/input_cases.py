"""Variations of every input file: what a reader does with them is on the page Input formats.

A row of a table is one `Case`. Its outcome is not written here: `make docs` reads the file and
writes what happened, and a test compares that with the page. Add a case as one line.
"""

import io
import json
import pickle
import struct
import zlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from curate.datasets.frame_names import match_frame_list
from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.labels import read_objects
from curate.datasets.kitti.raw import read_raw_calibration
from curate.detectors.recorded import RecordedDetector
from curate.review.edits import check_boxes
from curate.review.sheet import Sheet, ShownBox, ShownFrame
from curate.review.table import read_table
from curate.segmenters.instances import InstanceSegmenter
from curate.segmenters.saved import SavedSegmenter
from docs.input_cases_clouds import CLOUDS, PIXELS, POINTS, encoded, npy
from docs.input_cases_data_sets import (
    CALIBRATION,
    CAMERAS,
    CAR,
    DATA_SETS,
    FOLDER,
    VELODYNE,
    WALKER,
    read_folder,
)
from docs.input_cases_models import model_readers
from docs.input_frame import BOXES, CLASSES, frame
from docs.input_reader import Case, Reader, text_cases
from pipelines.registry import EDITORS
from pipelines.workspace.config import read_config

_LABELS = f"{CAR}\n{WALKER}\n"
_RESULTS = f"{CAR} 0.9\n{WALKER} 0.5\n"


def _label_cases(text: str) -> Iterable[Case]:
    first, second = text.splitlines()
    return [
        *text_cases(text),
        Case("tabs between the fields", text.replace(" ", "\t")),
        Case("an empty file: no objects", "", other=True),
        Case("a line with 14 fields", f"{' '.join(first.split()[:14])}\n{second}\n"),
        Case("a line with two fields too many", f"{first} 1 2\n{second}\n"),
        Case("a word in place of a number", text.replace("13.22", "far")),
        Case("decimal commas", text.replace(".", ",")),
        Case("NaN", text.replace("13.22", "nan")),
        Case("a side of negative length", text.replace(" 4.15 ", " -4.15 ")),
        Case("an unknown category", text.replace("Car", "Car1"), other=True),
        Case("a DontCare region besides", text + _dont_care(first), other=True),
    ]


def _dont_care(line: str) -> str:
    fields = "DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10"
    return f"{fields}{' 0.5' * (len(line.split()) - 15)}\n"


def _matrix_cases(text: str) -> Iterable[Case]:
    lines = text.splitlines()
    return [
        *text_cases(text),
        Case("lines in another order", "\n".join(reversed(lines)) + "\n"),
        Case("further lines", f"{text}P9: 1 2 3\ncalib_time: 15-Mar-2012 11:37:16\n"),
        Case("keys without colon", text.replace(":", "")),
        Case("numbers with exponents", text.replace("0.1 ", "1.0e-01 ")),
        Case("a line is missing", "\n".join(lines[1:]) + "\n"),
        Case("too few numbers", f"{lines[0].rsplit(' ', 1)[0]}\n" + "\n".join(lines[1:]) + "\n"),
        Case("a word in place of a number", text.replace("-0.3", "front")),
        Case("NaN", text.replace("-0.3", "nan")),
    ]


_MAP = np.tile(np.repeat(np.array([0, 3, 1], dtype=np.uint8), 40), (40, 1))
_COLOURS = np.zeros((*_MAP.shape, 3), np.uint8)
_COLOURS[_MAP == 3], _COLOURS[_MAP == 1] = (142, 0, 0), (60, 20, 220)  # blue, green, red


def _palette_png() -> bytes:
    """Return the map as a PNG of indices into a palette."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + checksum

    height, width = _MAP.shape
    rows = b"".join(b"\0" + row.tobytes() for row in _MAP)
    return b"".join((
        b"\x89PNG\r\n\x1a\n",
        chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        chunk(b"PLTE", bytes(range(12))),
        chunk(b"IDAT", zlib.compress(rows)),
        chunk(b"IEND", b""),
    ))  # fmt: skip


def _read_map(path: Path, **options: Any) -> Any:
    return SavedSegmenter(path.parent, CLASSES, **options).segment(frame()).class_ids


def _read_masks(path: Path) -> Any:
    segmenter = InstanceSegmenter(path, CLASSES, frame_ids=["000001"])
    return segmenter.segment(frame()).class_ids


_MASK = {"size": [40, 120], "counts": [400, 100, 4300]}
_POLYGON = [[10.0, 0.0, 12.5, 0.0, 12.5, 40.0, 10.0, 40.0]]


def _masks(segmentation: Any = _MASK, **changes: Any) -> str:
    entry = {"image_id": 1, "category_id": 3, "score": 0.9, "segmentation": segmentation} | changes
    images = [{"id": 1, "file_name": "000001.png"}]
    return json.dumps({"images": images, "annotations": [entry]})


_LIST = "000001\n000002\n"
_CONFIG = '[dataset]\nroot = "data"\n'


def _toml_cases(text: str, key: str, value: str) -> Iterable[Case]:
    return [
        *text_cases(text),
        Case("comments", f"# a comment\n{text}"),
        Case("a misspelled key", text.replace(key, f"{key}s")),
        Case("a number in place of a text", text.replace(value, "3")),
        Case("a key twice", text.replace(f"{key} =", f"{key} = {value}\n{key} =")),
        Case("a text without closing quote", text.replace(value, value[:-1])),
    ]


_SCORES, _NAMES = np.array([0.9, 0.5]), np.array(["Car", "Pedestrian"])
_COLUMNS = "frame,view,flip_y,rotation_rad,scale,category,score,x,y,z,length,width,height,yaw"
_CSV = f"{_COLUMNS}\n" + "".join(
    f"000001,0,0,0,1,{name},{score:g},{','.join(f'{number:g}' for number in box)}\n"
    for name, score, box in zip(_NAMES, _SCORES, BOXES, strict=True)
)


def _detections(path: Path, **options: Any) -> Any:
    detector = RecordedDetector(path, **options)
    return [detector.predict(frame(name)) for name in detector.frame_ids()]


def _read_numbered(path: Path, **options: Any) -> Any:
    return _detections(path, classes=("Car", "Pedestrian"), **options)


def _read_results(path: Path, **options: Any) -> Any:
    return _detections(path.parent, frame_ids=["000001"], **options)


def _openpcdet(**changes: Any) -> dict[str, Any]:
    return {
        "frame_id": "000001", "name": _NAMES, "score": _SCORES, "boxes_lidar": BOXES,
    } | changes  # fmt: skip


def _mmdet3d(**changes: Any) -> dict[str, Any]:
    boxes = BOXES - np.array([0, 0, 0.5, 0, 0, 0, 0]) * BOXES[:, 5:6]
    return {
        "frame_id": "000001", "bboxes_3d": boxes.tolist(), "scores_3d": _SCORES.tolist(),
        "labels_3d": [0, 1],
    } | changes  # fmt: skip


def _old_mmdet3d() -> dict[str, Any]:
    """Return an entry of mmdetection3d 0.x: width before length, yaw clockwise from -y."""
    rows = np.array(_mmdet3d()["bboxes_3d"])
    rows[:, [3, 4]] = rows[:, [4, 3]]
    rows[:, 6] = -rows[:, 6] - np.pi / 2
    return _without(_mmdet3d(boxes_3d=rows.tolist()), "bboxes_3d")


def _st3d_rows() -> np.ndarray:
    return np.column_stack([BOXES, [1, 2], _SCORES])


def _st3d(**changes: Any) -> bytes:
    frames = {
        "000001": {"gt_boxes": _st3d_rows(), "cls_scores": None, "iou_scores": None} | changes
    }
    return pickle.dumps(frames)


def _without(entry: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key != name}


def _changed(place: tuple[int, int], value: float) -> np.ndarray:
    boxes = BOXES.copy()
    boxes[place] = value
    return boxes


def _parquet(**changes: Any) -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    names = ("x", "y", "z", "length", "width", "height", "yaw")
    columns = {
        "frame": ["000001"] * 2, "category": _NAMES.tolist(), "score": _SCORES,
        **dict(zip(names, BOXES.T, strict=True)),
    } | changes  # fmt: skip
    buffer = io.BytesIO()
    table = pa.table({name: column for name, column in columns.items() if column is not None})
    parquet.write_table(table, buffer)
    return buffer.getvalue()


_NUSCENES_POSE = np.eye(4)


def _read_nuscenes(path: Path) -> Any:
    detector = RecordedDetector(path)
    calibration = replace(frame().calibration, lidar_to_map=_NUSCENES_POSE)
    return [
        detector.predict(replace(frame(name), calibration=calibration))
        for name in detector.frame_ids()
    ]


def _nuscenes(**changes: Any) -> str:
    box = {
        "sample_token": "000001", "translation": [10.0, 1.0, -1.0], "size": [1.8, 4.0, 1.6],
        "rotation": [1.0, 0.0, 0.0, 0.0], "velocity": [0.0, 0.0], "detection_name": "car",
        "detection_score": 0.9, "attribute_name": "",
    } | changes  # fmt: skip
    return json.dumps({"meta": {"use_lidar": True}, "results": {"000001": [box]}})


_SHEET = Sheet(
    1, "pspsl", "kitti", ("Car", "Pedestrian"),
    (ShownFrame("000001", tuple(
        ShownBox(k, str(name), tuple(box.tolist()), 0.6, 0.5, asked=True)
        for k, (name, box) in enumerate(zip(_NAMES, BOXES, strict=True))
    )),),
)  # fmt: skip
_TABLE = "frame,k,asked,category,score,weight,decision\n000001,0,yes,Car,0.6,0.5,accept\n"
_OLD_TABLE = "frame,box,asked,category,score,weight,decision\n000001,1,yes,Car,0.6,0.5,accept\n"


def _edited(editor: str, depth: int) -> Callable[[Path], Any]:
    """Return a function that reads edited boxes; the folder is `depth` levels above the file."""

    def read(path: Path) -> Any:
        found = EDITORS.build(editor, offered={}, options={}).read(
            path.parents[depth], _SHEET, frame
        )
        for boxes in found.values():
            check_boxes(boxes, _SHEET.categories)
        return {name: [(box.category, box.box) for box in boxes] for name, boxes in found.items()}

    return read


_KITTI_BOXES = (
    "Car 0 0 0 40.5 14.0 60.6 26.0 1.6 1.8 4.0 -1.0 1.8 10.0 -1.6708\n"
    "Pedestrian 0 0 0 65.6 17.1 70.2 24.2 1.7 0.6 0.8 2.0 1.85 15.0 -2.0708\n"
)


def _label_cloud(**changes: Any) -> str:
    one = {
        "name": "Car", "centroid": {"x": 10.0, "y": 1.0, "z": -1.0},
        "dimensions": {"length": 4.0, "width": 1.8, "height": 1.6},
        "rotations": {"x": 0.0, "y": 0.0, "z": 5.73},
    } | changes  # fmt: skip
    return json.dumps({"folder": "pointclouds", "filename": "000001.bin", "objects": [one]})


def _cvat(**changes: Any) -> str:
    one = {
        "type": "cuboid_3d", "label_id": 0, "position": [10.0, 1.0, -1.0],
        "rotation": [0.0, 0.0, 0.1], "scale": [4.0, 1.8, 1.6],
    } | changes  # fmt: skip
    labels = [{"name": name} for name in _SHEET.categories]
    item = {"id": "000001", "annotations": [one]}
    return json.dumps({"categories": {"label": {"labels": labels}}, "items": [item]})


READERS = (
    Reader(
        "KITTI labels", "One text file per frame, a line of 15 fields per object.",
        "label_2/000001.txt", read_objects, _LABELS,
        [
            *_label_cases(_LABELS),
            Case("16 fields, the last is a score", _RESULTS, other=True),
            Case("18 fields: an id, a date and a drive", f"{CAR} 436 2018_03_07 0002\n"),
            Case("20 fields: frame and track first", f"0 1 {CAR} 0.9 33 True\n"),
            Case("an object twice", _LABELS + _LABELS),
        ],
    ),
    Reader(
        "KITTI results",
        "One text file per frame, a line of 16 fields per object; the last one is the score.",
        "results/000001.txt", _read_results, _RESULTS,
        [
            *_label_cases(_RESULTS),
            Case("15 fields: no score", _LABELS),
            Case("a score above 1", _RESULTS.replace(" 0.9", " 9.5")),
            Case("a negative score", _RESULTS.replace(" 0.9", " -2.5")),
            Case("scores before the sigmoid with `sigmoid = true`", _RESULTS.replace(
                " 0.9", " 2.5"), other=True, options={"sigmoid": True}),
            Case("the file is called 1.txt", _RESULTS, name="results/1.txt"),
            Case("two files of one frame", _RESULTS, name="results/1.txt", beside=[
                ("results/000001.txt", _RESULTS)]),
            Case("a file of another frame", _RESULTS, name="results/000007.txt"),
            Case("a box twice", _RESULTS + _RESULTS),
        ],
    ),
    Reader(
        "Calibration", '`calib/FRAME.txt` of KITTI, and `calibration = "FILE"` of a folder.',
        "calib/000001.txt", read_calibration, CALIBRATION,
        [
            *_matrix_cases(CALIBRATION),
            Case("R_rect and Tr_velo_cam, as in the tracking benchmark", CALIBRATION.replace(
                "R0_rect", "R_rect").replace("velo_to_cam", "velo_cam")),
            Case("the matrices cannot be inverted", CALIBRATION.replace("-1 -0.1", "0 -0.1")),
        ],
    ),
    Reader(
        "Calibration of KITTI raw", "`calib_velo_to_cam.txt` beside `calib_cam_to_cam.txt`.",
        "calib_velo_to_cam.txt", lambda path: read_raw_calibration(path.parent), VELODYNE,
        _matrix_cases(VELODYNE), [("calib_cam_to_cam.txt", CAMERAS)],
    ),
    *CLOUDS,
    *DATA_SETS,
    Reader(
        "Semantic maps", "`FRAME.png` with a class id per pixel, for the segmenter `saved`.",
        "maps/000001.png", _read_map, encoded(_MAP),
        [
            Case("16 bits per pixel without `divisor`", encoded(_MAP.astype(np.uint16))),
            Case("16 bits per pixel with `divisor = 1`", encoded(_MAP.astype(np.uint16)),
                 options={"divisor": 1}),
            Case("class * 1000 + instance with `divisor = 1000`", encoded(
                _MAP.astype(np.uint16) * 1000), options={"divisor": 1000}),
            Case("class * 1000 + instance with `divisor = 256`", encoded(
                _MAP.astype(np.uint16) * 1000), options={"divisor": 256}, other=True),
            Case("a palette", _palette_png()),
            Case("an array in .npy", npy(_MAP), name="maps/000001.npy"),
            Case("an array of fractions", npy(_MAP / 2), name="maps/000001.npy"),
            Case("three equal channels", encoded(np.dstack([_MAP] * 3))),
            Case("a colour for each class without `colours`", encoded(_COLOURS)),
            Case("a colour for each class with `colours`", encoded(_COLOURS),
                 options={"colours": {"0": (0, 0, 0), "3": (0, 0, 142), "1": (220, 20, 60)}}),
            Case("a colour that `colours` does not list", encoded(_COLOURS),
                 options={"colours": {"0": (0, 0, 0), "3": (0, 0, 142)}}),
            Case("the class id in the red channel with `channel`", encoded(
                np.dstack([_MAP * 0, _MAP * 0, _MAP])), options={"channel": "red"}),
            Case("JPEG, which changes values", encoded(_MAP, ".jpg"), name="maps/000001.jpg"),
            Case("two maps of one frame", encoded(_MAP), beside=[("maps/000001.npy", npy(_MAP))]),
            Case("another size", encoded(_MAP[:20])),
            Case("the file ends early", encoded(_MAP)[:-20]),
            Case("the map of another frame", encoded(_MAP), name="maps/000002.png"),
        ],
    ),
    Reader(
        "Instance masks", "COCO's JSON with images, annotations and masks.",
        "masks.json", _read_masks, _masks(),
        [
            *text_cases(_masks()),
            Case("a list of results, `image_id` is the frame", json.dumps([
                {"image_id": "000001", "category_id": 3, "score": 0.9, "segmentation": _MASK}])),
            Case("`image_id` is the number of the frame", json.dumps([
                {"image_id": 1, "category_id": 3, "score": 0.9, "segmentation": _MASK}])),
            Case("file_name with folders", _masks().replace("000001.png", "image_2/000001.png")),
            Case("two images of one frame", _masks().replace('"images": [', '"images": ['
                 '{"id": 2, "file_name": "1.png"}, ')),
            Case("polygons", _masks(_POLYGON), other=True),
            Case("a mask of another size", _masks({"size": [20, 60], "counts": [1200]})),
            Case("runs that do not fill the image", _masks({"size": [40, 120], "counts": [4]})),
            Case("no segmentation", _masks().replace("segmentation", "bbox")),
            Case("the class as a name", _masks(category_id="car")),
            Case("a frame that is not in the file", _masks().replace("000001", "000002")),
        ],
    ),
    Reader(
        "Lists of frames", "One frame per line, for `--labeled`, `--val` and ImageSets.",
        "train.txt", lambda path: match_frame_list(path, ("000001", "000002")), _LIST,
        [
            *text_cases(_LIST),
            Case("empty lines between", _LIST.replace("\n", "\n\n")),
            Case("numbers: 1 for 000001", "1\n2\n"),
            Case("file names", "000001.png\n000002.png\n"),
            Case("paths", "training/velodyne/000001.bin\ntraining/velodyne/000002.bin\n"),
            Case("a frame twice", "000001\n1\n000002\n"),
            Case("a frame that is not in the data set", "000003\n"),
            Case("blanks before the names", _LIST.replace("0000", "  0000")),
            Case("an empty file", "", other=True),
            Case("a path out of the data set", f"{_LIST}../000003\n"),
        ],
    ),
    Reader(
        "dataset.toml", "The description of a plain folder.",
        "dataset.toml", read_folder, FOLDER,
        [
            *_toml_cases(FOLDER, "images", '"camera"'),
            Case("a missing key", FOLDER.replace('points = "lidar"\n', "")),
            Case("a matrix with a missing row", FOLDER.replace(", [0, 0, 1, 0]]", "]")),
        ],
        [("lidar/000001.bin", POINTS.tobytes()), ("camera/000001.png", encoded(PIXELS))],
    ),
    Reader(
        "curate.toml", "The settings of a workspace.", "curate.toml", read_config, _CONFIG,
        [
            *_toml_cases(_CONFIG, "root", '"data"'),
            Case("a misspelled section", f"{_CONFIG}[detectr]\n"),
            Case("names are renamed in two steps", f'{_CONFIG}rename = {{a = "b", b = "c"}}\n'),
            Case("a number out of its range", f"{_CONFIG}[run]\nworkers = -1\n"),
        ],
    ),
    Reader(
        "Recorded detections: CSV", f"A header and a row per box: {_COLUMNS.replace(',', ', ')}.",
        "detections.csv", _detections, _CSV,
        [
            *text_cases(_CSV),
            Case("columns in another order", _CSV.replace("category,score", "score,category")
                 .replace("Car,0.9", "0.9,Car").replace("Pedestrian,0.5", "0.5,Pedestrian")),
            Case("a further column", "".join(
                f"{line},{'note' if i == 0 else 'a'}\n" for i, line in enumerate(
                    _CSV.splitlines()))),
            Case("values in quotes", _CSV.replace("000001", '"000001"').replace("Car", '"Car"')),
            Case("semicolons between the values", _CSV.replace(",", ";")),
            Case("no columns of views", "".join(
                ",".join([line.split(",")[0], *line.split(",")[5:]]) for line in
                _CSV.splitlines(keepends=True))),
            Case("a column is missing", _CSV.replace(",yaw\n", ",heading\n")),
            Case("a row is too short", _CSV.replace(",0.1\n", "\n")),
            Case("a word in place of a number", _CSV.replace(",0.1\n", ",left\n")),
            Case("NaN", _CSV.replace(",0.1\n", ",nan\n")),
            Case("a score above 1", _CSV.replace("Car,0.9", "Car,9")),
            Case("a side of length 0", _CSV.replace(",4,1.8,", ",0,1.8,")),
        ],
    ),
    Reader(
        "Recorded detections: OpenPCDet", "`result.pkl`: a list with a dict per frame.",
        "result.pkl", _detections, pickle.dumps([_openpcdet()]),
        [
            Case("pickle protocol 2", pickle.dumps([_openpcdet()], protocol=2)),
            Case("float32", pickle.dumps([_openpcdet(
                boxes_lidar=BOXES.astype(np.float32), score=_SCORES.astype(np.float32))])),
            Case("a frame without boxes besides", pickle.dumps([_openpcdet(), _openpcdet(
                frame_id="000002", name=_NAMES[:0], score=_SCORES[:0], boxes_lidar=BOXES[:0],
            )]), other=True),
            Case("a key is missing", pickle.dumps([_without(_openpcdet(), "score")])),
            Case("no frame_id", pickle.dumps([_without(_openpcdet(), "frame_id")])),
            Case("fewer scores than boxes", pickle.dumps([_openpcdet(score=_SCORES[:1])])),
            Case("NaN", pickle.dumps([_openpcdet(boxes_lidar=_changed((0, 0), np.nan))])),
            Case("a pickle that would run code", b"cos\nsystem\n(S'true'\ntR."),
            Case("not a pickle", b"boxes"),
        ],
    ),
    Reader(
        "Recorded detections: mmdetection3d",
        "Pickle or JSON: a list with bboxes_3d, scores_3d and labels_3d per frame; "
        "`detector.options.classes` names the labels.",
        "results.json", _read_numbered, json.dumps([_mmdet3d()]),
        [
            *text_cases(json.dumps([_mmdet3d()])),
            Case("a pickle", pickle.dumps([_mmdet3d()]), name="results.pkl"),
            Case("9 numbers per box: velocities", json.dumps([_mmdet3d(
                bboxes_3d=[[*box, 0.0, 0.0] for box in _mmdet3d()["bboxes_3d"]])])),
            Case("boxes_3d without `version`", json.dumps([_old_mmdet3d()])),
            Case("boxes_3d of 0.x with `version`", json.dumps([_old_mmdet3d()]),
                 options={"version": "0.x"}),
            Case("bboxes_3d, which 0.x does not write, with `version`", json.dumps([_mmdet3d()]),
                 options={"version": "0.x"}),
            Case("boxes in the camera's frame", json.dumps([_mmdet3d(box_type_3d="Camera")])),
            Case("a label without a class", json.dumps([_mmdet3d(labels_3d=[0, 7])])),
            Case("fewer scores than boxes", json.dumps([_mmdet3d(scores_3d=[0.9])])),
            Case("no frame and no `frame_list`", json.dumps([_without(_mmdet3d(), "frame_id")])),
        ],
    ),
    Reader(
        "Recorded detections: ST3D and MS3D",
        "`ps_label_e0.pkl`: a dict of frames; `detector.options.classes` names the categories.",
        "ps_label_e0.pkl", _read_numbered, _st3d(),
        [
            Case("scores in cls_scores", _st3d(
                gt_boxes=np.column_stack([BOXES, [1, 2]]), cls_scores=_SCORES)),
            Case("a box with a negative category is left out, with a warning", _st3d(
                gt_boxes=np.vstack([_st3d_rows(), _st3d_rows()[:1] * [*[1.0] * 7, -1, 1]]))),
            Case('such boxes with `ignored = "keep"`', _st3d(
                gt_boxes=_st3d_rows() * [*[1.0] * 7, -1, 1]), options={"ignored": "keep"}),
            Case("boxes moved by SHIFT_COOR with `shift`", _st3d(
                gt_boxes=_st3d_rows() + np.float64([0, 0, 1.6, 0, 0, 0, 0, 0, 0])),
                options={"shift": (0.0, 0.0, 1.6)}),
            Case("no scores", _st3d(gt_boxes=_st3d_rows()[:, :8])),
            Case("a category without a class", _st3d(gt_boxes=_st3d_rows() + 2 * np.eye(9)[7])),
            Case("fewer scores than boxes", _st3d(
                gt_boxes=_st3d_rows()[:, :8], cls_scores=_SCORES[:1])),
        ],
    ),
    Reader(
        "Recorded detections: nuScenes", "The results of the detection task, as JSON.",
        "results_nusc.json", _read_nuscenes, _nuscenes(),
        [
            *text_cases(_nuscenes()),
            Case("a key is missing", _nuscenes().replace("translation", "location")),
            Case("a rotation that is not a rotation", _nuscenes(rotation=[0.0] * 4)),
            Case("a score above 1", _nuscenes(detection_score=7.0)),
            Case("the box of another sample", _nuscenes(sample_token="000002")),  # noqa: S106
        ],
    ),
    Reader(
        "Review: review.csv", "The table of decisions; spreadsheets may change its form.",
        "review.csv", lambda path: read_table(path.parent, _SHEET), _TABLE,
        [
            *text_cases(_TABLE),
            Case("semicolons between the values", _TABLE.replace(",", ";")),
            Case("frames without leading zeros", _TABLE.replace("000001", "1")),
            Case("capital letters: ACCEPT", _TABLE.replace("accept", "ACCEPT")),
            Case("a table of curate 0.1: column `box`, from 1", _OLD_TABLE),
            Case("another word", _TABLE.replace("accept", "good")),
            Case("a label that was not shown", _TABLE.replace(",0,yes", ",7,yes")),
            Case("a frame that was not shown", _TABLE.replace("000001", "000009")),
            Case("a whole frame is rejected", _TABLE.replace(",0,yes", ",all,").replace(
                "accept", "reject")),
            Case("no column decision", _TABLE.replace("decision", "verdict")),
        ],
    ),
    Reader(
        "Review: KITTI", "`label_2/FRAME.txt` after editing.",
        "label_2/000001.txt", _edited("kitti", 1), _KITTI_BOXES,
        [
            *text_cases(_KITTI_BOXES),
            Case("16 fields in every line", _KITTI_BOXES.replace("\n", " 0.5\n")),
            Case("a line with 12 fields", " ".join(_KITTI_BOXES.split()[:12]) + "\n"),
            Case("an unknown category", _KITTI_BOXES.replace("Car", "Tram")),
            Case("a side of 60 m", _KITTI_BOXES.replace(" 4.0 ", " 60.0 ")),
            Case("a frame that was not shown", _KITTI_BOXES, name="label_2/000009.txt"),
        ],
    ),
    Reader(
        "Review: labelCloud", "`labels/FRAME.json` in the format centroid_abs.",
        "labels/000001.json", _edited("labelcloud", 1), _label_cloud(),
        [
            *text_cases(_label_cloud()),
            Case("a yaw of more than a turn", _label_cloud(
                rotations={"x": 0.0, "y": 0.0, "z": 365.73})),
            Case("rotated about x", _label_cloud(rotations={"x": 9.0, "y": 0.0, "z": 5.73})),
            Case("a number as text", _label_cloud(centroid={"x": "10", "y": 1.0, "z": -1.0})),
            Case("no name", _label_cloud(name=None)),
            Case("an unknown category", _label_cloud(name="Tram")),
            Case("no objects in the file", '{"folder": "pointclouds"}'),
            Case("a frame that was not shown", _label_cloud(), name="labels/000009.json"),
        ],
    ),
    Reader(
        "Review: CVAT", "Datumaro 3D 1.0: annotations.zip, or the JSON in it.",
        "annotations.zip", _edited("cvat", 0), _cvat(),
        [
            *text_cases(_cvat()),
            Case("annotations of other types besides are skipped", _cvat().replace(
                '"annotations": [', '"annotations": [{"type": "label", "label_id": 0}, ')),
            Case("rotated about x", _cvat(rotation=[0.2, 0.0, 0.1])),
            Case("a label that the file does not list", _cvat(label_id=9)),
            Case("two numbers for a position", _cvat(position=[10.0, 1.0])),
            Case("no items", '{"categories": {}}'),
            Case("a damaged archive", b"PK\x03\x04" + bytes(30)),
        ],
    ),
)  # fmt: skip


def readers() -> tuple[Reader, ...]:
    """Return all readers; those of Arrow files need pyarrow, those of models need onnx."""
    return (*READERS, _parquet_reader(), _argoverse2_reader(), *model_readers())


def _parquet_reader() -> Reader:
    return Reader(
        "Recorded detections: Parquet",
        "The columns of the CSV file; those of the views may be left out.",
        "detections.parquet", _detections, _parquet(),
        [
            Case("single precision", _parquet(score=_SCORES.astype(np.float32))),
            Case("a further column", _parquet(note=["a", "b"])),
            Case("a column is missing", _parquet(yaw=None)),
            Case("numbers as text", _parquet(score=["0.9", "0.5"])),
            Case("null", _parquet(x=[10.0, None])),
            Case("NaN", _parquet(x=[10.0, float("nan")])),
            Case("a score above 1", _parquet(score=[9.0, 0.5])),
            Case("two rows of one box", _parquet(frame=["000001"] * 2, **_twice())),
            Case("a damaged page", _parquet()[:60] + bytes(20) + _parquet()[80:]),
            Case("a damaged footer", _parquet()[:-300] + bytes(200) + _parquet()[-100:]),
            Case("the file ends early", _parquet()[:-40]),
            Case("not Parquet", b"PAR1" + bytes(20)),
        ],
    )  # fmt: skip


def _twice() -> dict[str, Any]:
    names = ("x", "y", "z", "length", "width", "height", "yaw")
    columns = {name: [number] * 2 for name, number in zip(names, BOXES[0], strict=True)}
    return {"category": ["Car"] * 2, "score": [0.9] * 2, **columns}


def _feather(**changes: Any) -> bytes:
    import pyarrow as pa
    from pyarrow import feather

    names = ("tx_m", "ty_m", "tz_m", "length_m", "width_m", "height_m")
    half = BOXES[:, 6] / 2
    columns = {
        **dict(zip(names, BOXES.T, strict=False)),
        "qw": np.cos(half), "qx": np.zeros(2), "qy": np.zeros(2), "qz": np.sin(half),
        "score": _SCORES, "log_id": ["a"] * 2, "timestamp_ns": [1] * 2,
        "category": _NAMES.tolist(),
    } | changes  # fmt: skip
    buffer = io.BytesIO()
    table = pa.table({name: column for name, column in columns.items() if column is not None})
    feather.write_feather(table, buffer)
    return buffer.getvalue()


def _read_feather(path: Path, **options: Any) -> Any:
    detector = RecordedDetector(path, frame_ids=["a_1"], **options)
    return [detector.predict(frame(name)) for name in detector.frame_ids()]


def _argoverse2_reader() -> Reader:
    return Reader(
        "Recorded detections: Argoverse 2", "Feather: a row per box in the frame of the vehicle.",
        "detections.feather", _read_feather, _feather(),
        [
            Case("a further column", _feather(track_uuid=["t", "u"])),
            Case("single precision", _feather(score=_SCORES.astype(np.float32))),
            Case("frames named by a pattern in `frame_name`", _feather(),
                 options={"frame_name": "{log_id}_{timestamp_ns}"}),
            Case("a pattern without the time", _feather(), options={"frame_name": "{log_id}"}),
            Case("a column is missing", _feather(qw=None)),
            Case("a rotation that is not a rotation", _feather(qw=np.zeros(2), qz=np.zeros(2))),
            Case("null", _feather(tx_m=[10.0, None])),
            Case("a score above 1", _feather(score=[9.0, 0.5])),
            Case("the file ends early", _feather()[:-40]),
            Case("not Feather", b"FEA1" + bytes(20)),
        ],
    )  # fmt: skip
