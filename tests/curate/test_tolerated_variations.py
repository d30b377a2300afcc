"""Every reader of text takes the same variations of a file, and rejects the same ones."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.exported import toy_labels
from support.reviews import small_sheet
from support.toys import toy_calibration

from curate.datasets.folder import FolderDataset
from curate.datasets.frame_names import match_frame_list
from curate.datasets.kitti.calibration import (
    read_calibration,
    read_raw_calibration,
    write_calibration,
)
from curate.datasets.kitti.dataset import KittiDataset, read_drives
from curate.datasets.kitti.labels import read_objects
from curate.datasets.kitti.oxts import read_oxts
from curate.datasets.kitti.oxts import read_times as read_timestamps
from curate.datasets.motion import read_pose, read_times
from curate.datasets.nuscenes.tables import read_table
from curate.detectors.recorded import RecordedDetector
from curate.errors import CurateError
from curate.evaluation.kitti_folders import read_folders
from curate.exporters.comma_separated import CsvExporter
from curate.exporters.data_frames import read_labels
from curate.frames import Frame
from curate.review.editors.cvat import CvatEditor
from curate.review.editors.kitti import KittiEditor
from curate.review.editors.labelcloud import LabelCloudEditor
from curate.review.sheet import MANIFEST, read_sheet, write_sheet
from curate.review.table import TABLE, write_table
from curate.review.table import read_table as read_review_table
from curate.segmenters.instances import InstanceSegmenter
from pipelines.workspace.config import Config, read_config
from pipelines.workspace.config_file import change_settings, write_config

FRAME = Frame("000001", np.zeros((0, 4), np.float32), toy_calibration(), (120, 40))
LABEL = "Car 0.00 0 1.55 614.24 181.78 727.31 284.77 1.57 1.73 4.15 1.00 1.75 1.322E+01 1.62\n"
RESULT = LABEL.replace("\n", " 0.5\n")
LABELS = f"{LABEL}DontCare -1 -1 -10 5 229.89 214 367 -1 -1 -1 -1000 -1000 -1000 -10\n"
HEADER = "frame,view,flip_y,rotation_rad,scale,category,score,x,y,z,length,width,height,yaw"
ROWS = (
    f"{HEADER}\n000001,0,0,0.0,1.0,Car,0.9,1,2,3,4,2,1.5,0.5\n"
    "000002,0,0,0,1,Car,0.4,1,2,3,4,2,1,0\n"
)
ENTRY = {"bboxes_3d": [[1.0, 2, 0, 4, 2, 1.5, 0]], "scores_3d": [0.5], "labels_3d": [0]}
BOX = {
    "translation": [1, 2, 3],
    "size": [2, 4, 1.5],
    "rotation": [1, 0, 0, 0],
    "detection_name": "car",
    "detection_score": 0.5,
}
MASK = {"category_id": 1, "segmentation": [[10, 5, 30, 5, 30, 25]], "image_id": 1}


def pretty(value: object) -> str:
    """Return JSON over several lines, so that line ends matter."""
    return json.dumps(value, indent=1) + "\n"


def predicted(path: Path, **options: Any) -> object:
    """Return the recorded boxes of a frame."""
    detector = RecordedDetector(path, frame_ids=("000001", "000002"), **options)
    found = detector.predict(FRAME)
    return detector.frame_ids(), found.boxes.tolist(), found.scores.tolist()


def objects(path: Path, **options: Any) -> object:
    """Return the numbers of a label file."""
    found = read_objects(path, **options)
    return found.categories.tolist(), found.locations.tolist(), str(found.scores)


def matrices(path: Path) -> object:
    """Return the matrices of a calibration file."""
    found = read_calibration(path)
    return found.projection.tolist(), found.lidar_to_camera.tolist()


@dataclass(frozen=True)
class Reader:
    """A reader of text.

    Attributes:
        name: of the file.
        read: returns something comparable.
        content: of the file; None if `prepare` writes it.
        prepare: writes what else is needed into the folder of the file.
    """

    name: str
    read: Callable[[Path], object]
    content: str | None = None
    prepare: Callable[[Path], None] = lambda folder: None

    def write(self, folder: Path) -> Path:
        """Write the valid file and what it needs."""
        self.prepare(folder)
        path = folder / self.name
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.content is not None:
            path.write_text(self.content, newline="")
        return path


def raw_cameras(folder: Path) -> None:
    (folder / "calib_cam_to_cam.txt").write_text(
        "R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: 60 0 60 0 0 60 20 0 0 0 1 0\n"
    )


def results_of_frame_1(folder: Path) -> None:
    (folder / "results").mkdir()
    (folder / "results" / "1.txt").write_text(RESULT)


def review(folder: Path) -> None:
    sheet = small_sheet()
    write_sheet(folder, sheet)
    write_table(folder, sheet)
    table = folder / TABLE
    table.write_text(
        table.read_text().replace("1,1,yes,Car,0.600,0.500,", "1,1,yes,Car,0.6,1,accept")
    )


def edited(editor: Any, suffix: str) -> Callable[[Path], object]:
    """Return a function that reads the boxes of an edited file."""

    def read(path: Path) -> object:
        folder = path if suffix == "file" else path.parent
        found = editor.read(folder, small_sheet(), lambda name: FRAME)
        return {name: [(box.category, box.box) for box in boxes] for name, boxes in found.items()}

    return read


def dataset_toml(folder: Path) -> None:
    (folder / "lidar").mkdir()
    FRAME.points.tofile(folder / "lidar" / "000001.bin")


def described(path: Path) -> object:
    """Return what dataset.toml says."""
    frame = FolderDataset(path.parent).read("000001")
    return frame.image_size, frame.calibration.projection.tolist()


def evaluated(path: Path) -> object:
    """Return the labels and results of two folders."""
    ids, truth, found = read_folders(path.parent, path.parent / "results")
    return ids, truth[0].locations.tolist(), found[0].scores.tolist()


def changed_setting(path: Path) -> object:
    """Change a setting, then read all of them."""
    change_settings(path, "train", {"preset": "small"})
    return read_config(path)


def exported_csv(folder: Path) -> None:
    CsvExporter().write(folder / "labels.csv", toy_labels())


def config(folder: Path) -> None:
    write_config(folder / "curate.toml", Config.model_validate({"dataset": {"root": "data"}}))


def two_frames(folder: Path) -> None:
    (folder / "training" / "velodyne").mkdir(parents=True)
    for name in ("000000", "000001"):
        (folder / "training" / "velodyne" / f"{name}.bin").touch()


CLOUD = {
    "name": "Car",
    "centroid": {"x": 1, "y": 2, "z": 0},
    "dimensions": {"length": 4, "width": 2, "height": 1.5},
    "rotations": {"x": 0, "y": 0, "z": 90},
}
CUBOID = {
    "type": "cuboid_3d",
    "label_id": 0,
    "position": [1, 2, 0],
    "rotation": [0, 0, 0],
    "scale": [4, 2, 1],
}
READERS: Mapping[str, Reader] = {
    "labels": Reader("a.txt", objects, LABELS),
    "results": Reader("a.txt", lambda path: objects(path, scored=True), RESULT),
    "evaluated labels": Reader("000001.txt", evaluated, LABELS, results_of_frame_1),
    "recorded kitti results": Reader("1.txt", lambda path: predicted(path.parent), RESULT),
    "edited labels": Reader("label_2/1.txt", edited(KittiEditor(), "folder"), LABELS),
    "calibration": Reader(
        "a.txt",
        matrices,
        None,
        lambda folder: write_calibration(folder / "a.txt", toy_calibration()),
    ),
    "raw calibration": Reader(
        "calib_velo_to_cam.txt",
        lambda path: read_raw_calibration(path.parent).lidar_to_camera.tolist(),
        "calib_time: 15-Mar-2012 11:37:16\nR: 0 -1 0 0 0 -1 1 0 0\nT: 1.5E-1 0 0\n",
        raw_cameras,
    ),
    "drives": Reader(
        "train_mapping.txt",
        lambda path: read_drives(path.parent),
        "2011_09_26 drive_5 0000000109\n2011_09_26 drive_9 0000000130\n",
        lambda folder: (folder / "train_rand.txt").write_text("2,1") and None,
    ),
    "oxts": Reader(
        "0000.txt",
        lambda path: read_oxts(path).tolist(),
        "49.0 8.4 110 0 0 1.5 0 0\n49.1 8.4 110 0 0 1.5\n",
    ),
    "timestamps": Reader(
        "timestamps.txt", read_timestamps, "2011-09-26 13:02:25.59\n2011-09-26 13:02:25.69\n"
    ),
    "times": Reader("times.txt", read_times, "a_0 0.5\na_1 1e2\n"),
    "pose": Reader("a_0.txt", lambda path: read_pose(path).tolist(), "1 0 0 5\n0 1 0 6\n0 0 1 7\n"),
    "frame list": Reader(
        "a.txt", lambda path: match_frame_list(path, ("000001", "000002")), "000001\n2\n"
    ),
    "ImageSets": Reader(
        "ImageSets/train.txt",
        lambda path: KittiDataset(path.parent.parent).splits()["train"],
        "000001\n0\n",
        two_frames,
    ),
    "frame_list": Reader(
        "order.txt",
        lambda path: predicted(path.parent / "a.json", classes=["Car"], frame_list="order.txt"),
        "1\n2\n",
        lambda folder: (folder / "a.json").write_text(pretty([ENTRY, ENTRY])) and None,
    ),
    "dataset.toml": Reader(
        "dataset.toml",
        described,
        'points = "lidar"\nimage_size = [120, 40]\n[calibration]\n'
        "projection = [[60, 0, 60, 0],\n[0, 60, 20, 0], [0, 0, 1, 0]]\n"
        "lidar_to_camera = [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]\n",
        dataset_toml,
    ),
    "curate.toml": Reader("curate.toml", read_config, None, config),
    "changed curate.toml": Reader("curate.toml", changed_setting, None, config),
    "recorded csv": Reader("a.csv", predicted, ROWS),
    "exported csv": Reader(
        "labels.csv", lambda path: read_labels(path).to_csv(), None, exported_csv
    ),
    "review.csv": Reader(
        TABLE, lambda path: read_review_table(path.parent, small_sheet()), None, review
    ),
    "review.json": Reader(MANIFEST, lambda path: read_sheet(path.parent), None, review),
    "recorded json": Reader(
        "a.json",
        lambda path: predicted(path, classes=["Car"]),
        pretty([{"sample_idx": 1, **ENTRY}]),
    ),
    "recorded nuscenes": Reader(
        "a.json",
        lambda path: RecordedDetector(path).frame_ids(),
        pretty({"meta": {}, "results": {"a": [BOX], "b": []}}),
    ),
    "masks": Reader(
        "a.json",
        lambda path: InstanceSegmenter(path, {"Car": (1,)}).segment(FRAME).class_ids.tolist(),
        pretty([MASK]),
    ),
    "masks per frame": Reader(
        "000001.json",
        lambda path: (
            InstanceSegmenter(path.parent, {"Car": (1,)}).segment(FRAME).class_ids.tolist()
        ),
        pretty([MASK]),
    ),
    "nuscenes table": Reader("a.json", read_table, pretty([{"token": "a"}, {"token": "b"}])),
    "labelcloud": Reader(
        "labels/1.json", edited(LabelCloudEditor(), "folder"), pretty({"objects": [CLOUD]})
    ),
    "cvat": Reader(
        "default.json",
        edited(CvatEditor(), "file"),
        pretty(
            {
                "categories": {"label": {"labels": [{"name": "Car"}]}},
                "items": [{"id": "pointcloud/1", "annotations": [CUBOID]}],
            }
        ),
    ),
}
CSV = ("recorded csv", "exported csv", "review.csv")
JSON = (
    "review.json", "recorded json", "recorded nuscenes", "masks", "masks per frame",
    "nuscenes table", "labelcloud", "cvat",
)  # fmt: skip

TOLERATED: Mapping[str, Callable[[bytes], bytes]] = {
    "byte order mark": lambda content: b"\xef\xbb\xbf" + content,
    "CR LF": lambda content: content.replace(b"\n", b"\r\n"),
    "CR": lambda content: content.replace(b"\n", b"\r"),
    "mark and CR LF": lambda content: b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n"),
    "trailing blanks": lambda content: content.replace(b"\n", b" \t\n"),
    "no newline at the end": lambda content: content.rstrip(b"\n"),
    "empty lines at the end": lambda content: content + b"\n  \n\n",
}
REJECTED: Mapping[str, tuple[Callable[[bytes], bytes], str]] = {
    "UTF-16 with mark": (
        lambda content: content.decode().encode("utf-16"),
        r"saved as UTF-16 \(Windows' \"Unicode\"\); save the file as UTF-8",
    ),
    "UTF-16 without mark": (
        lambda content: content.decode().encode("utf-16-le"),
        "saved as UTF-16 .*; save the file as UTF-8",
    ),
    "Latin-1": (lambda content: content + b"\xe9\n", "not UTF-8"),
}


@pytest.mark.parametrize("variation", TOLERATED)
@pytest.mark.parametrize("reader", READERS)
def test_every_reader_takes_the_same_variations(tmp_path, reader, variation):
    """The result is that of the plain file."""
    path = READERS[reader].write(tmp_path)
    plain = path.read_bytes()
    assert b"\n" in plain
    expected = READERS[reader].read(path)
    path.write_bytes(TOLERATED[variation](plain))
    assert READERS[reader].read(path) == expected


@pytest.mark.parametrize("kind", REJECTED)
@pytest.mark.parametrize("reader", READERS)
def test_every_reader_rejects_other_encodings_by_name(tmp_path, reader, kind):
    """In one line with the file and the remedy."""
    path = READERS[reader].write(tmp_path)
    change, message = REJECTED[kind]
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(CurateError, match=message) as caught:
        READERS[reader].read(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def _columns(text: str, delimiter: str = ",") -> list[list[str]]:
    return [line.split(delimiter) for line in text.splitlines()]


def _joined(rows: list[list[str]], delimiter: str = ",") -> str:
    return "".join(f"{delimiter.join(row)}\n" for row in rows)


CSV_VARIATIONS: Mapping[str, Callable[[str], str]] = {
    "semicolons": lambda text: text.replace(",", ";"),
    "tabs": lambda text: text.replace(",", "\t"),
    "spaces after commas": lambda text: text.replace(",", ", "),
    "quotes": lambda text: _joined([[f'"{field}"' for field in row] for row in _columns(text)]),
    "spaces before quotes": lambda text: _joined(
        [[f' "{field}"' for field in row] for row in _columns(text)]
    ),
    "trailing commas": lambda text: text.replace("\n", ",\n"),
    "trailing commas without a header": lambda text: text.replace("\n", ",,\n").replace(
        ",,\n", "\n", 1
    ),
    "empty rows of a spreadsheet": lambda text: text.replace("\n", "\n,,,\n"),
    "empty lines first": lambda text: "\n \n" + text,
    "columns in another order": lambda text: _joined([row[::-1] for row in _columns(text)]),
    "header in capitals": lambda text: text.partition("\n")[0].upper() + text[text.index("\n") :],
}


@pytest.mark.parametrize("variation", CSV_VARIATIONS)
@pytest.mark.parametrize("reader", CSV)
def test_every_csv_reader_takes_the_same_variations(tmp_path, reader, variation):
    path = READERS[reader].write(tmp_path)
    expected = READERS[reader].read(path)
    path.write_text(CSV_VARIATIONS[variation](path.read_text()))
    assert READERS[reader].read(path) == expected


@pytest.mark.parametrize("reader", CSV)
def test_every_csv_reader_rejects_what_could_be_misread(tmp_path, reader):
    """A column twice, a row of another width, a missing column, decimal commas."""
    path = READERS[reader].write(tmp_path)
    plain = path.read_text()
    head, _, rest = plain.partition("\n")
    for text, message in (
        (f"{head},frame\n{rest}", "frame occurs twice in the header|fields, the header has"),
        (f"{head}\n1,2\n{rest}", r":2: 2 fields, the header has"),
        (plain.replace("frame", "picture", 1), "no column frame|not exported labels"),
    ):
        path.write_text(text)
        with pytest.raises(CurateError, match=message) as caught:
            READERS[reader].read(path)
        assert str(caught.value).startswith(str(path))


def test_decimal_commas_are_rejected_with_advice(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(ROWS.replace(",", ";").replace("0.9", "0,9"))
    with pytest.raises(
        CurateError, match=r"a\.csv:2: '0,9' is not a number; write a decimal point"
    ):
        RecordedDetector(path)


@pytest.mark.parametrize("constant", ["NaN", "Infinity", "-Infinity"])
@pytest.mark.parametrize("reader", JSON)
def test_every_json_reader_rejects_numbers_that_are_not_json(tmp_path, reader, constant):
    """With line and column, also in a value that is not used."""
    path = READERS[reader].write(tmp_path)
    text = path.read_text()
    place = text.index("{") + 1
    path.write_text(f'{text[:place]}"note": "NaN", "x":\n {constant}, {text[place:]}')
    line = text.count("\n", 0, place) + 2
    with pytest.raises(
        CurateError, match=rf":{line}: {constant} at column 2 is not JSON"
    ) as caught:
        READERS[reader].read(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("reader", JSON)
def test_every_json_reader_rejects_a_second_document(tmp_path, reader):
    """As in JSON Lines, of which a reader would take the first line alone."""
    path = READERS[reader].write(tmp_path)
    path.write_text(path.read_text() + "{}\n")
    with pytest.raises(
        CurateError, match="cannot be read as JSON: a second document; put the docu"
    ):
        READERS[reader].read(path)


@pytest.mark.parametrize("reader", JSON)
def test_every_json_reader_rejects_a_repeated_key(tmp_path, reader):
    """Python would keep the last one. Of nuScenes' results, which are streamed, tokens count."""
    path = READERS[reader].write(tmp_path)
    text = path.read_text()
    place = text.index("{", text.index('"results"') if reader == "recorded nuscenes" else 0) + 1
    path.write_text(f'{text[:place]}"same": [], "same": [], {text[place:]}')
    with pytest.raises(CurateError, match=r"same'? occurs? twice"):
        READERS[reader].read(path)


@pytest.mark.parametrize("reader", ["labels", "evaluated labels", "edited labels"])
def test_every_label_reader_leaves_a_score_out(tmp_path, reader):
    """A 16th field, as the devkits of View of Delft and nuScenes write; in some lines or in all."""
    path = READERS[reader].write(tmp_path)
    expected = READERS[reader].read(path)
    path.write_text(LABELS.replace("\n", " 1\n", 1))
    assert READERS[reader].read(path) == expected
    path.write_text(LABELS.replace("\n", " 0\n"))
    assert READERS[reader].read(path) == expected


KITTI_TEXT = ("labels", "results", "evaluated labels", "recorded kitti results", "edited labels")
PLACEHOLDERS = ("0 0 0 0 0 0 0", "-1 -1 -1 -1000 -1000 -1000 -10", "0.00 0.00 0.00 1 1.5 20 0.1")


@pytest.mark.parametrize("numbers", PLACEHOLDERS)
@pytest.mark.parametrize("reader", KITTI_TEXT)
def test_every_reader_of_kitti_text_rejects_a_line_without_a_3d_box(tmp_path, reader, numbers):
    """By one check, with file and line."""
    path = READERS[reader].write(tmp_path)
    path.write_text(f"{path.read_text()}\nCar 0 0 0 1 1 9 9 {numbers} 0.5\n")
    line = len(path.read_text().splitlines())
    with pytest.raises(CurateError, match=rf":{line}: no 3D box: height, width and length of the"):
        READERS[reader].read(path)


@pytest.mark.parametrize("location", ["-1000 -1000 -1000 -10", "0 0 0 0", "0.00 -0.00 0 1.57"])
@pytest.mark.parametrize("reader", KITTI_TEXT)
def test_every_reader_of_kitti_text_rejects_a_box_without_a_location(tmp_path, reader, location):
    """Sizes of the category with a placeholder for the location would be a box in the camera."""
    path = READERS[reader].write(tmp_path)
    path.write_text(f"{path.read_text()}\nCar 0 0 0 1 1 9 9 1.5 1.7 4.1 {location} 0.5\n")
    line = len(path.read_text().splitlines())
    with pytest.raises(CurateError, match=rf":{line}: no 3D box: the Car is at "):
        READERS[reader].read(path)


@pytest.mark.parametrize("reader", ["results", "recorded kitti results"])
def test_every_reader_of_results_needs_the_score(tmp_path, reader):
    path = READERS[reader].write(tmp_path)
    path.write_text(LABEL)
    with pytest.raises(CurateError, match=":1: 15 fields: the score is missing; result lines end"):
        READERS[reader].read(path)
