"""Variations of every input file: what a reader does with them is on the page Input formats.

A row of a table is one `Case`. Its outcome is not written here: `make docs` reads the file and
writes what happened, and a test compares that with the page. Add a case as one line.
"""

import io
import json
import pickle
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from curate.datasets.folder import FolderDataset
from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.images import read_image
from curate.datasets.frame_names import match_frame_list
from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.labels import read_objects
from curate.datasets.kitti.raw import read_raw_calibration
from curate.detectors.recorded import RecordedDetector
from curate.errors import CurateError
from curate.frames import Calibration, Frame
from curate.review.edits import check_boxes
from curate.review.sheet import Sheet, ShownBox, ShownFrame
from curate.review.table import read_table
from curate.segmenters.instances import InstanceSegmenter
from curate.segmenters.saved import SavedSegmenter
from pipelines.registry import EDITORS
from pipelines.workspace.config import read_config

Content = bytes | str


@dataclass(frozen=True)
class Case:
    """A variation of a file.

    Attributes:
        variation: what is different from the plain file.
        content: of the file.
        other: whether the file holds something else than the plain file, such as no objects.
        name: of the file; "" for the reader's.
    """

    variation: str
    content: Content
    other: bool = False
    name: str = ""


@dataclass(frozen=True)
class Reader:
    """A reader with the variations of its file.

    Attributes:
        title: of its section on the page.
        about: sentences above the table.
        name: of the file, with its folder.
        read: reads the file.
        plain: content of a valid file.
        cases: the variations.
        beside: other files that the reader needs, by name.
    """

    title: str
    about: str
    name: str
    read: Callable[[Path], Any]
    plain: Content
    cases: Sequence[Case]
    beside: Sequence[tuple[str, Content]] = ()

    def outcome(self, case: Case) -> tuple[str, str]:
        """Return "read" or "rejected", and the message.

        Raises:
            AssertionError: if the file was read, but not as the plain file.
        """
        found = self._attempt(case.content, case.name or self.name)
        if isinstance(found, str):
            return "rejected", found
        if not case.other:
            plain = self._attempt(self.plain, self.name)
            if isinstance(plain, str) or plain != found:
                raise AssertionError(f"{self.title}: {case.variation}: {found}, expected {plain}")
        return "read", ""

    def _attempt(self, content: Content, name: str) -> str | list[str]:
        """Return the message without the folder, or the result as text in a list."""
        with tempfile.TemporaryDirectory() as folder:
            for other, text in (*self.beside, (name, content)):
                path = Path(folder) / other
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(text if isinstance(text, bytes) else text.encode())
            try:
                return [repr(_plain(self.read(Path(folder) / name)))]
            except CurateError as error:
                return str(error).replace(f"{folder}/", "").replace(folder, "ROOT")


def _plain(value: Any) -> Any:
    """Return arrays and objects as lists, numbers with six digits."""
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(each) for each in value]
    if hasattr(value, "__dataclass_fields__"):
        return [_plain(getattr(value, name)) for name in value.__dataclass_fields__]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _text_cases(text: str) -> list[Case]:
    """Return variations that editors and programs of other systems make of any text file."""
    return [
        Case("byte order mark", f"\ufeff{text}"),
        Case("Windows line ends", text.replace("\n", "\r\n")),
        Case("no newline at the end", text.rstrip("\n")),
        Case("empty lines at the end", f"{text}\n\n"),
        Case("blanks at the ends of lines", text.replace("\n", "  \n")),
        Case("not UTF-8", b"\xff\xfe\xfa" + text.encode()),
        Case("UTF-16", text.encode("utf-16")),
    ]


_CAR = "Car 0.00 0 1.55 614.24 181.78 727.31 284.77 1.57 1.73 4.15 1.00 1.75 13.22 1.62"
_WALKER = "Pedestrian 0.10 1 -0.20 712.40 143.00 810.73 307.92 1.89 0.48 1.20 1.84 1.47 8.41 0.01"
_LABELS = f"{_CAR}\n{_WALKER}\n"
_RESULTS = f"{_CAR} 0.9\n{_WALKER} 0.5\n"
_CALIBRATION = """\
P2: 700 0 600 40 0 700 180 0.2 0 0 1 0.003
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3
"""
_VELODYNE = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.1 -0.3\n"
_CAMERAS = "R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: 700 0 600 40 0 700 180 0 0 0 1 0\n"


def _label_cases(text: str) -> Iterable[Case]:
    first, second = text.splitlines()
    return [
        *_text_cases(text),
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
        *_text_cases(text),
        Case("lines in another order", "\n".join(reversed(lines)) + "\n"),
        Case("further lines", f"{text}P9: 1 2 3\ncalib_time: 15-Mar-2012 11:37:16\n"),
        Case("keys without colon", text.replace(":", "")),
        Case("numbers with exponents", text.replace("0.1 ", "1.0e-01 ")),
        Case("a line is missing", "\n".join(lines[1:]) + "\n"),
        Case("too few numbers", f"{lines[0].rsplit(' ', 1)[0]}\n" + "\n".join(lines[1:]) + "\n"),
        Case("a word in place of a number", text.replace("-0.3", "front")),
        Case("NaN", text.replace("-0.3", "nan")),
    ]


_POINTS = np.array([[10, 1, -1, 0.5], [20, -2, 0, 0.25], [30, 3, 1, 1]], dtype="<f4")
_ROWS = "\n".join(" ".join(f"{number:g}" for number in row) for row in _POINTS.tolist())
_PCD = (
    "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    "WIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\n"
)
_PCD_BYTES = f"{_PCD}DATA binary\n".encode() + _POINTS.tobytes()
_PLY = "ply\nformat {} 1.0\nelement vertex 3\n" + "".join(
    f"property float {name}\n" for name in ("x", "y", "z", "intensity")
)
_PLY_TEXT = f"{_PLY.format('ascii')}end_header\n{_ROWS}\n"


def _npy(table: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, table)
    return buffer.getvalue()


def _with_nan(points: np.ndarray) -> np.ndarray:
    return np.vstack([points, np.full((1, 4), np.nan, dtype="<f4")])


_PIXELS = np.arange(40 * 120 * 3, dtype=np.uint32).reshape(40, 120, 3).astype(np.uint8)
_MAP = np.tile(np.repeat(np.array([0, 3, 1], dtype=np.uint8), 40), (40, 1))
_SIZE = (120, 40)
_CLASSES = {"Car": (3,), "Pedestrian": (1,)}


def _encoded(pixels: np.ndarray, suffix: str = ".png") -> bytes:
    return bytes(cv2.imencode(suffix, pixels)[1].tobytes())


def _frame(name: str = "000001") -> Frame:
    projection = np.array([[60.0, 0, 60, 0], [0, 60, 20, 0], [0, 0, 1, 0]])
    lidar_to_camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    image = np.zeros((40, 120, 3), dtype=np.uint8)
    calibration = Calibration(projection, lidar_to_camera)
    return Frame(name, np.zeros((0, 4), np.float32), calibration, _SIZE, image)


def _read_map(path: Path) -> Any:
    return SavedSegmenter(path.parent, _CLASSES).segment(_frame()).class_ids


def _read_masks(path: Path) -> Any:
    return InstanceSegmenter(path, _CLASSES).segment(_frame()).class_ids


_MASK = {"size": [40, 120], "counts": [400, 100, 4300]}
_POLYGON = [[10.0, 0.0, 12.5, 0.0, 12.5, 40.0, 10.0, 40.0]]


def _masks(segmentation: Any = _MASK, **changes: Any) -> str:
    entry = {"image_id": 1, "category_id": 3, "score": 0.9, "segmentation": segmentation} | changes
    images = [{"id": 1, "file_name": "000001.png"}]
    return json.dumps({"images": images, "annotations": [entry]})


_LIST = "000001\n000002\n"
_FOLDER = """\
points = "lidar"
images = "camera"
[calibration]
projection = [[700.0, 0, 60, 0], [0, 700, 20, 0], [0, 0, 1, 0]]
lidar_to_camera = [[0.0, -1, 0, 0], [0, 0, -1, -0.1], [1, 0, 0, -0.3]]
"""
_CONFIG = '[dataset]\nroot = "data"\n'


def _read_folder(path: Path) -> Any:
    dataset = FolderDataset(path.parent)
    return [dataset.read(name) for name in dataset.frame_ids()]


def _toml_cases(text: str, key: str, value: str) -> Iterable[Case]:
    return [
        *_text_cases(text),
        Case("comments", f"# a comment\n{text}"),
        Case("a misspelled key", text.replace(key, f"{key}s")),
        Case("a number in place of a text", text.replace(value, "3")),
        Case("a key twice", text.replace(f"{key} =", f"{key} = {value}\n{key} =")),
        Case("a text without closing quote", text.replace(value, value[:-1])),
    ]


_BOXES = np.array([[10.0, 1, -1, 4, 1.8, 1.6, 0.1], [15.0, -2, -1, 0.8, 0.6, 1.7, 0.5]])
_SCORES, _NAMES = np.array([0.9, 0.5]), np.array(["Car", "Pedestrian"])
_COLUMNS = "frame,view,flip_y,rotation_rad,scale,category,score,x,y,z,length,width,height,yaw"
_CSV = f"{_COLUMNS}\n" + "".join(
    f"000001,0,0,0,1,{name},{score:g},{','.join(f'{number:g}' for number in box)}\n"
    for name, score, box in zip(_NAMES, _SCORES, _BOXES, strict=True)
)


def _detections(path: Path, **options: Any) -> Any:
    detector = RecordedDetector(path, **options)
    return [detector.predict(_frame(name)) for name in detector.frame_ids()]


def _read_record(path: Path) -> Any:
    return _detections(path)


def _read_numbered(path: Path) -> Any:
    return _detections(path, classes=("Car", "Pedestrian"))


def _read_results(path: Path) -> Any:
    return _detections(path.parent)


def _openpcdet(**changes: Any) -> dict[str, Any]:
    return {
        "frame_id": "000001", "name": _NAMES, "score": _SCORES, "boxes_lidar": _BOXES,
    } | changes  # fmt: skip


def _mmdet3d(**changes: Any) -> dict[str, Any]:
    boxes = _BOXES - np.array([0, 0, 0.5, 0, 0, 0, 0]) * _BOXES[:, 5:6]
    return {
        "frame_id": "000001", "bboxes_3d": boxes.tolist(), "scores_3d": _SCORES.tolist(),
        "labels_3d": [0, 1],
    } | changes  # fmt: skip


def _without(entry: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key != name}


def _changed(place: tuple[int, int], value: float) -> np.ndarray:
    boxes = _BOXES.copy()
    boxes[place] = value
    return boxes


def _parquet(**changes: Any) -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    names = ("x", "y", "z", "length", "width", "height", "yaw")
    columns = {
        "frame": ["000001"] * 2, "category": _NAMES.tolist(), "score": _SCORES,
        **dict(zip(names, _BOXES.T, strict=True)),
    } | changes  # fmt: skip
    buffer = io.BytesIO()
    table = pa.table({name: column for name, column in columns.items() if column is not None})
    parquet.write_table(table, buffer)
    return buffer.getvalue()


_NUSCENES_POSE = np.eye(4)


def _read_nuscenes(path: Path) -> Any:
    detector = RecordedDetector(path)
    calibration = replace(_frame().calibration, lidar_to_map=_NUSCENES_POSE)
    return [
        detector.predict(replace(_frame(name), calibration=calibration))
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
        for k, (name, box) in enumerate(zip(_NAMES, _BOXES, strict=True))
    )),),
)  # fmt: skip
_TABLE = "frame,k,asked,category,score,weight,decision\n000001,0,yes,Car,0.6,0.5,accept\n"
_OLD_TABLE = "frame,box,asked,category,score,weight,decision\n000001,1,yes,Car,0.6,0.5,accept\n"


def _edited(editor: str, depth: int) -> Callable[[Path], Any]:
    """Return a function that reads edited boxes; the folder is `depth` levels above the file."""

    def read(path: Path) -> Any:
        found = EDITORS.build(editor, offered={}, options={}).read(
            path.parents[depth], _SHEET, _frame
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
        [*_label_cases(_LABELS), Case("16 fields, the last is a score", _RESULTS, other=True)],
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
            Case("a box twice", _RESULTS + _RESULTS),
        ],
    ),
    Reader(
        "Calibration", '`calib/FRAME.txt` of KITTI, and `calibration = "FILE"` of a folder.',
        "calib/000001.txt", read_calibration, _CALIBRATION,
        [
            *_matrix_cases(_CALIBRATION),
            Case("R_rect and Tr_velo_cam, as in the tracking benchmark", _CALIBRATION.replace(
                "R0_rect", "R_rect").replace("velo_to_cam", "velo_cam")),
            Case("the matrices cannot be inverted", _CALIBRATION.replace("-1 -0.1", "0 -0.1")),
        ],
    ),
    Reader(
        "Calibration of KITTI raw", "`calib_velo_to_cam.txt` beside `calib_cam_to_cam.txt`.",
        "calib_velo_to_cam.txt", lambda path: read_raw_calibration(path.parent), _VELODYNE,
        _matrix_cases(_VELODYNE), [("calib_cam_to_cam.txt", _CAMERAS)],
    ),
    Reader(
        "Point clouds: .bin", "Rows of float32, little-endian: x, y, z, intensity.",
        "000001.bin", read_cloud, _POINTS.tobytes(),
        [
            Case("an empty file: no points", b"", other=True),
            Case("points that are NaN are dropped", _with_nan(_POINTS).tobytes()),
            Case("the file ends within a point", _POINTS.tobytes()[:-3]),
            Case("in millimetres", (_POINTS * [1000, 1000, 1000, 1]).astype("<f4").tobytes()),
            Case("another suffix", _POINTS.tobytes(), name="000001.dat"),
        ],
    ),
    Reader(
        "Point clouds: .npy", "An array (n, 4) of numbers, as `numpy.save` writes it.",
        "000001.npy", read_cloud, _npy(_POINTS),
        [
            Case("float64", _npy(_POINTS.astype(np.float64))),
            Case("big-endian", _npy(_POINTS.astype(">f4"))),
            Case("columns first in memory", _npy(np.asfortranarray(_POINTS))),
            Case("points that are NaN are dropped", _npy(_with_nan(_POINTS))),
            Case("no points", _npy(_POINTS[:0]), other=True),
            Case("five columns without `columns = 5`", _npy(np.hstack([_POINTS, _POINTS[:, :1]]))),
            Case("one dimension", _npy(_POINTS.ravel())),
            Case("an array of objects", _npy(np.array([{}, {}], dtype=object))),
            Case("the file ends early", _npy(_POINTS)[:-8]),
        ],
    ),
    Reader(
        "Point clouds: .pcd", "PCD 0.7: text, binary or binary_compressed.",
        "000001.pcd", read_cloud, _PCD_BYTES,
        [
            Case("text", f"{_PCD}DATA ascii\n{_ROWS}\n"),
            Case("Windows line ends in a text file", f"{_PCD}DATA ascii\n{_ROWS}\n".replace(
                "\n", "\r\n")),
            Case("a comment before the header", b"# .PCD v.7\n" + _PCD_BYTES),
            Case("no field x", _PCD_BYTES.replace(b"FIELDS x", b"FIELDS u")),
            Case("no line DATA", _PCD),
            Case("the file ends early", _PCD_BYTES[:-4]),
        ],
    ),
    Reader(
        "Point clouds: .ply", "PLY 1.0: text, or binary of either byte order.",
        "000001.ply", read_cloud, _PLY_TEXT,
        [
            Case("binary, little-endian", f"{_PLY.format('binary_little_endian')}end_header\n"
                 .encode() + _POINTS.tobytes()),
            Case("binary, big-endian", f"{_PLY.format('binary_big_endian')}end_header\n".encode()
                 + _POINTS.astype(">f4").tobytes()),
            Case("Windows line ends in a text file", _PLY_TEXT.replace("\n", "\r\n")),
            Case("a comment in the header", _PLY_TEXT.replace("element", "comment a\nelement")),
            Case("no property x", _PLY_TEXT.replace("float x", "float u")),
            Case("no end_header", _PLY_TEXT.replace("end_header\n", "")),
            Case("the file ends early", _PLY_TEXT[:-12]),
        ],
    ),
    Reader(
        "Images", "PNG or JPEG.", "000001.png", read_image, _encoded(_PIXELS),
        [
            Case("grey", _encoded(_PIXELS[..., 0]), other=True),
            Case("with transparency", _encoded(np.dstack([_PIXELS, _PIXELS[..., :1]]))),
            Case("16 bits per channel", _encoded(_PIXELS.astype(np.uint16) * 257)),
            Case("a JPEG file named .png", _encoded(_PIXELS, ".jpg"), other=True),
            Case("the file ends early", _encoded(_PIXELS)[:-40]),
            Case("an empty file", b""),
            Case("another format", b"GIF89a" + bytes(40)),
        ],
    ),
    Reader(
        "Semantic maps", "`FRAME.png` with a class id per pixel, for the segmenter `saved`.",
        "maps/000001.png", _read_map, _encoded(_MAP),
        [
            Case("16 bits per pixel without `divisor`", _encoded(_MAP.astype(np.uint16))),
            Case("three equal channels", _encoded(np.dstack([_MAP] * 3))),
            Case("another size", _encoded(_MAP[:20])),
            Case("the file ends early", _encoded(_MAP)[:-20]),
            Case("the map of another frame", _encoded(_MAP), name="maps/000002.png"),
        ],
    ),
    Reader(
        "Instance masks", "COCO's JSON with images, annotations and masks.",
        "masks.json", _read_masks, _masks(),
        [
            *_text_cases(_masks()),
            Case("a list of results, `image_id` is the frame", json.dumps([
                {"image_id": "000001", "category_id": 3, "score": 0.9, "segmentation": _MASK}])),
            Case("`image_id` is the number of the frame", json.dumps([
                {"image_id": 1, "category_id": 3, "score": 0.9, "segmentation": _MASK}])),
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
            *_text_cases(_LIST),
            Case("empty lines between", _LIST.replace("\n", "\n\n")),
            Case("blanks before the names", _LIST.replace("0000", "  0000")),
            Case("an empty file", "", other=True),
            Case("a path out of the data set", f"{_LIST}../000003\n"),
        ],
    ),
    Reader(
        "dataset.toml", "The description of a plain folder.",
        "dataset.toml", _read_folder, _FOLDER,
        [
            *_toml_cases(_FOLDER, "images", '"camera"'),
            Case("a missing key", _FOLDER.replace('points = "lidar"\n', "")),
            Case("a matrix with a missing row", _FOLDER.replace(", [0, 0, 1, 0]]", "]")),
        ],
        [("lidar/000001.bin", _POINTS.tobytes()), ("camera/000001.png", _encoded(_PIXELS))],
    ),
    Reader(
        "curate.toml", "The settings of a workspace.", "curate.toml", read_config, _CONFIG,
        [
            *_toml_cases(_CONFIG, "root", '"data"'),
            Case("a misspelled section", f"{_CONFIG}[detectr]\n"),
            Case("a number out of its range", f"{_CONFIG}[run]\nworkers = -1\n"),
        ],
    ),
    Reader(
        "Recorded detections: CSV", f"A header and a row per box: {_COLUMNS.replace(',', ', ')}.",
        "detections.csv", _read_record, _CSV,
        [
            *_text_cases(_CSV),
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
        "result.pkl", _read_record, pickle.dumps([_openpcdet()]),
        [
            Case("pickle protocol 2", pickle.dumps([_openpcdet()], protocol=2)),
            Case("float32", pickle.dumps([_openpcdet(
                boxes_lidar=_BOXES.astype(np.float32), score=_SCORES.astype(np.float32))])),
            Case("a frame without boxes besides", pickle.dumps([_openpcdet(), _openpcdet(
                frame_id="000002", name=_NAMES[:0], score=_SCORES[:0], boxes_lidar=_BOXES[:0],
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
            *_text_cases(json.dumps([_mmdet3d()])),
            Case("a pickle", pickle.dumps([_mmdet3d()]), name="results.pkl"),
            Case("9 numbers per box: velocities", json.dumps([_mmdet3d(
                bboxes_3d=[[*box, 0.0, 0.0] for box in _mmdet3d()["bboxes_3d"]])])),
            Case("a label without a class", json.dumps([_mmdet3d(labels_3d=[0, 7])])),
            Case("fewer scores than boxes", json.dumps([_mmdet3d(scores_3d=[0.9])])),
            Case("no frame and no `frame_list`", json.dumps([_without(_mmdet3d(), "frame_id")])),
        ],
    ),
    Reader(
        "Recorded detections: nuScenes", "The results of the detection task, as JSON.",
        "results_nusc.json", _read_nuscenes, _nuscenes(),
        [
            *_text_cases(_nuscenes()),
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
            *_text_cases(_TABLE),
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
            *_text_cases(_KITTI_BOXES),
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
            *_text_cases(_label_cloud()),
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
            *_text_cases(_cvat()),
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
    """Return all readers; that of Parquet files needs pyarrow."""
    return (*READERS, _parquet_reader())


def _parquet_reader() -> Reader:
    return Reader(
        "Recorded detections: Parquet",
        "The columns of the CSV file; those of the views may be left out.",
        "detections.parquet", _read_record, _parquet(),
        [
            Case("single precision", _parquet(score=_SCORES.astype(np.float32))),
            Case("a further column", _parquet(note=["a", "b"])),
            Case("a column is missing", _parquet(yaw=None)),
            Case("numbers as text", _parquet(score=["0.9", "0.5"])),
            Case("null", _parquet(x=[10.0, None])),
            Case("NaN", _parquet(x=[10.0, float("nan")])),
            Case("a score above 1", _parquet(score=[9.0, 0.5])),
            Case("the file ends early", _parquet()[:-40]),
            Case("not Parquet", b"PAR1" + bytes(20)),
        ],
    )  # fmt: skip
