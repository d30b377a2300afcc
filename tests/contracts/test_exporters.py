"""The contract of every registered exporter."""

import copy
import csv
import json
import pickle
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from contracts.samples import assert_one_line, sample_of
from scipy.spatial.transform import Rotation
from support.exported import block, label, rows_of, truth, truth_block, with_rows
from support.toys import SIZES

from curate.detections import CATEGORIES
from curate.errors import ConfigError, DataError, LeakageError
from curate.exporters.base import (
    BOX_COLUMNS,
    FrameFiles,
    LabelFileDescription,
    LabelSet,
)
from pipelines.registry import EXPORTERS

# Pose of the LiDAR in a map, for formats that need one.
MAP_POSE = np.eye(4)
MAP_POSE[:3, :3] = Rotation.from_euler("zyx", [2.0, 0.02, -0.03]).as_matrix()
MAP_POSE[:3, 3] = [600.0, 1600.0, 1.8]

# Labels by frame: category, x, y, z, length, width, height, yaw, weight, in the order of k.
Written = Mapping[str, list[tuple]]


def read_sqlite(path: Path) -> Written:
    """Read the view of a label file, with the unlabeled frames that have no label."""
    query = (
        "SELECT frame, category, x, y, z, length, width, height, yaw, weight "
        "FROM weighted_labels ORDER BY frame, k"
    )
    with closing(sqlite3.connect(path)) as connection:
        frames = connection.execute("SELECT frame FROM frame WHERE split = 'unlabeled'")
        found: dict[str, list[tuple]] = {frame: [] for (frame,) in frames}
        for frame, *row in connection.execute(query):
            found[frame].append(tuple(row))
    return found


def read_kitti(path: Path) -> Written:
    """Read the label files and the folder `weight` beside them."""
    found = {}
    for file in (path / "weight").iterdir():
        rows = [line.split() for line in file.read_text().splitlines()]
        found[file.stem] = [(row[0], *map(float, row[3:]), float(row[1])) for row in rows]
    return found


def read_csv(path: Path) -> Written:
    """Read the rows of the file; only frames with labels are in it."""
    found: dict[str, list[tuple]] = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            numbers = tuple(float(row[name]) for name in (*BOX_COLUMNS, "weight"))
            found.setdefault(row["frame"], []).append((row["category"], *numbers))
    return found


def read_coco(path: Path) -> Written:
    """Read the annotations of the unlabeled images, and which of them are background."""
    document = json.loads(path.read_text())
    names = {category["id"]: category["name"] for category in document["categories"]}
    images = {image["id"]: image for image in document["images"] if image["split"] == "unlabeled"}
    found: dict[str, list[tuple]] = {image["frame"]: [] for image in images.values()}
    annotations = [*document["annotations"], *document["background"]]
    assert all(each["weight"] == 0 for each in document["background"])
    for each in sorted(annotations, key=lambda each: each["k"]):
        if each["image_id"] in images:
            row = (names[each["category_id"]], *each["box_3d"], each["weight"])
            found[images[each["image_id"]]["frame"]].append(row)
    return found


def read_openpcdet(path: Path) -> Written:
    """Read the annos of the unlabeled frames."""
    infos = pickle.loads((path / "kitti_infos_train.pkl").read_bytes())
    found = {}
    for info in infos:
        annos, name = info["annos"], info["image"]["image_idx"]
        rows = np.column_stack([annos["gt_boxes_lidar"], annos["weight"]]).tolist()
        found[name] = [(c, *row) for c, row in zip(annos["category"], rows, strict=True)]
    return {name: rows for name, rows in found.items() if name != "000000"}


def read_st3d(path: Path) -> Written:
    """Read boxes of single precision; the sign of the category marks ignored ones."""
    found = {}
    for name, frame in pickle.loads((path / "ps_label_e0.pkl").read_bytes()).items():
        boxes, weights = frame["gt_boxes"], frame["weight"]
        assert ((boxes[:, 7] < 0) == (weights == 0)).all()  # background is left out
        categories = [CATEGORIES[int(abs(number)) - 1] for number in boxes[:, 7]]
        rows = np.column_stack([boxes[:, :7].astype(float), weights]).tolist()
        found[name] = [(c, *row) for c, row in zip(categories, rows, strict=True)]
    return found


def read_mmdet3d(path: Path) -> Written:
    """Read the instances of the unlabeled frames, transformed from camera to LiDAR frame."""
    infos = pickle.loads((path / "kitti_infos_train.pkl").read_bytes())["data_list"]
    found = {}
    for info in infos:
        back = np.linalg.inv(np.array(info["images"]["CAM2"]["lidar2cam"]))
        rows = []
        for each in info["instances"]:
            x, y, z, length, height, width, rotation_y = each["bbox_3d"]
            centre = (back @ [x, y - height / 2, z, 1])[:3].tolist()
            yaw = (-rotation_y - np.pi / 2) % (2 * np.pi)
            yaw = float(yaw - 2 * np.pi if yaw > np.pi else yaw)
            box = (*centre, length, width, height, yaw)
            rows.append((each["category"], *box, each["weight"]))
        found[info["frame"]] = rows
    return {name: rows for name, rows in found.items() if name != "000000"}


def read_parquet(path: Path) -> Written:
    """Read the rows of the file; only frames with labels are in it."""
    from pyarrow import parquet

    found: dict[str, list[tuple]] = {}
    for row in parquet.read_table(path).to_pylist():
        numbers = tuple(row[name] for name in (*BOX_COLUMNS, "weight"))
        found.setdefault(row["frame"], []).append((row["category"], *numbers))
    return found


def read_nuscenes(path: Path) -> Written:
    """Read results and ignored or background boxes, transformed from map to LiDAR frame."""
    document = json.loads(path.read_text())
    found = {}
    for name, results in document["results"].items():
        assert all(box["weight"] > 0 for box in results)
        nothing = document["ignored"][name] + document["background"][name]
        assert all(box["weight"] == 0 for box in nothing)
        rows = []
        for box in sorted(results + nothing, key=lambda box: box["k"]):
            w, *xyz = box["rotation"]
            turn = Rotation.from_quat([*xyz, w])
            back = MAP_POSE[:3, :3].T @ (np.array(box["translation"]) - MAP_POSE[:3, 3])
            ahead = MAP_POSE[:3, :3].T @ turn.apply([1.0, 0, 0])
            width, length, height = box["size"]
            yaw = float(np.arctan2(ahead[1], ahead[0]))
            category = {"car": "Car", "pedestrian": "Pedestrian", "bicycle": "Cyclist"}
            name_of = category[box["detection_name"]]
            rows.append((name_of, *back.tolist(), length, width, height, yaw, box["weight"]))
        found[name] = rows
    return found


# Reads an export back.
SAMPLES: Mapping[str, Callable[[Path], Written]] = {
    "sqlite": read_sqlite,
    "kitti": read_kitti,
    "csv": read_csv,
    "coco": read_coco,
    "openpcdet": read_openpcdet,
    "st3d": read_st3d,
    "mmdet3d": read_mmdet3d,
    "parquet": read_parquet,
    "nuscenes": read_nuscenes,
}
# Formats whose readers have no notion of background leave background labels out.
LEAVE_OUT_BACKGROUND = {"st3d"}
# Packages of extras; without them an exporter is not tested.
NEEDS = {"parquet": "pyarrow"}


@pytest.fixture(params=sorted(EXPORTERS.classes))
def exporter(request: pytest.FixtureRequest):
    """Return every registered exporter with its default settings."""
    if request.param in NEEDS:
        pytest.importorskip(NEEDS[request.param], reason=f"{NEEDS[request.param]} is an extra")
    return EXPORTERS.build(request.param, offered={}, options={})


@pytest.fixture
def read_back(exporter) -> Callable[[Path], Written]:
    """Return the function that reads back an export of the current exporter."""
    return sample_of(SAMPLES, exporter.name, "a function that reads an export back, see `Written`")


@pytest.fixture(params=["background", "ignore"])
def labels(request: pytest.FixtureRequest, frames) -> LabelSet:
    """Return a labeled frame with one object, and two unlabeled frames with five labels each."""
    rng = np.random.default_rng(0)
    frames = [
        replace(frame, calibration=replace(frame.calibration, lidar_to_map=MAP_POSE))
        for frame in frames
    ]
    names = [frame.frame_id for frame in frames]
    rows = []
    for name in names[1:]:
        for k in range(5):
            category = CATEGORIES[k % 3]
            box = (*rng.uniform([6, -4, -1], [30, 4, 0]).tolist(), *SIZES[category], float(k - 2))
            # All special cases: without counterpart, without priors, weights zero and one.
            loss, points = (None, None) if k == 0 else (0.5, 12)
            own = {"category": category, "loss": loss, "points": points, "weight": k / 4}
            rows.append(label(name, k, box, score=0.7, **own))
    return LabelSet(
        description=LabelFileDescription(
            "kitti", Path("/data"), CATEGORIES, 1, "pspsl", "1", request.param
        ),
        frames=[
            FrameFiles(name, "unlabeled" if k else "labeled", "p", "i", "c")
            for k, name in enumerate(names)
        ],
        ground_truth=truth_block([truth(names[0], box=(10.0, 0.0, -0.8, 4.0, 1.8, 1.6, 0.0))]),
        labels=[block(rows[:7]), block(rows[7:])],
        read={frame.frame_id: frame for frame in frames}.__getitem__,
        read_points={frame.frame_id: frame for frame in frames}.__getitem__,
    )


def place(exporter, folder: Path) -> Path:
    """Return a path for an export, in a folder that does not exist yet."""
    return folder / "new" / f"labels{exporter.suffix}"


def files(path: Path) -> dict[str, bytes]:
    """Return the contents of the export and of everything beside it."""
    found = [file for file in path.parent.rglob("*") if file.is_file()]
    return {str(file.relative_to(path.parent)): file.read_bytes() for file in found}


def with_weight(labels: LabelSet, weight: float) -> LabelSet:
    """Return the same labels with another weight of the last one."""
    rows = rows_of(labels)
    return with_rows(labels, [*rows[:-1], rows[-1] | {"weight": weight}])


def exported_labels(exporter, labels: LabelSet) -> list[dict]:
    """Return the labels that are in an export."""
    leaves_out = exporter.name in LEAVE_OUT_BACKGROUND
    least = 0 if leaves_out and labels.description.zero_weight == "background" else -1
    return [row for row in rows_of(labels) if row["weight"] > least]


def test_it_has_its_registered_name(exporter, request) -> None:
    assert exporter.name == request.node.callspec.params["exporter"]
    assert exporter.suffix == "" or exporter.suffix.startswith(".")


def test_every_label_is_exported_with_its_weight(exporter, read_back, labels, tmp_path) -> None:
    """Boxes of all unlabeled frames agree to a millimetre, weights to a millionth."""
    path, wanted = place(exporter, tmp_path), exported_labels(exporter, labels)
    assert len(wanted) >= 8
    assert exporter.write(path, labels) == len(wanted)
    assert path.is_file() == bool(exporter.suffix)
    found = read_back(path)
    assert sorted(found) == sorted({row["frame"] for row in wanted})
    for name, rows in found.items():
        expected = [row for row in wanted if row["frame"] == name]
        assert [row[0] for row in rows] == [row["category"] for row in expected]
        numbers = [[row[column] for column in (*BOX_COLUMNS, "weight")] for row in expected]
        np.testing.assert_allclose([row[1:] for row in rows], numbers, atol=2e-6)


def test_the_same_labels_make_the_same_files(exporter, labels, tmp_path) -> None:
    """Byte for byte, in another folder, and when an earlier export is replaced."""
    one, other = place(exporter, tmp_path / "one"), place(exporter, tmp_path / "other")
    exporter.write(one, labels)
    exporter.write(other, with_weight(labels, 0.125))
    assert files(one) != files(other)
    exporter.write(other, labels)
    assert files(one) == files(other)


def test_an_export_without_labels_works(exporter, read_back, labels, tmp_path) -> None:
    """With labeled frames only, and with no frames; an unlabeled frame may have no labels."""
    path = place(exporter, tmp_path)
    for frames in (labels.frames, labels.frames[:1], []):
        own = labels.ground_truth if frames else truth_block()
        bare = replace(labels, labels=[], frames=frames, ground_truth=own)
        assert exporter.write(path, bare) == 0
        assert sum(map(len, read_back(path).values())) == 0


@pytest.mark.parametrize("weight", [1.5, -0.1, float("nan")])
def test_a_failed_export_leaves_the_earlier_one_unchanged(
    exporter, labels, tmp_path, weight: float
) -> None:
    """An impossible weight gives a one-line error, and no partial file remains."""
    path = place(exporter, tmp_path)
    with pytest.raises(DataError):
        exporter.write(path, with_weight(labels, weight))
    assert not path.exists()
    exporter.write(path, labels)
    before = files(path)
    with pytest.raises(DataError, match="weight") as caught:
        exporter.write(path, with_weight(labels, weight))
    assert_one_line(caught.value)
    assert files(path) == before


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_files_that_are_not_an_earlier_export_are_not_overwritten(
    exporter, labels, tmp_path, kind: str
) -> None:
    """The error contains the path of the file or folder."""
    path = place(exporter, tmp_path)
    precious = path if kind == "file" else path / "thesis.tex"
    precious.parent.mkdir(parents=True)
    precious.write_text("precious")
    with pytest.raises(ConfigError, match=path.name) as caught:
        exporter.write(path, labels)
    assert_one_line(caught.value)
    assert files(path) == {str(precious.relative_to(path.parent)): b"precious"}


@pytest.mark.parametrize("kind", ["dangling", "loop", "former"])
def test_a_link_is_not_overwritten(exporter, labels, tmp_path, kind: str) -> None:
    """An export in its place would leave the target of the link outdated."""
    path = place(exporter, tmp_path)
    path.parent.mkdir(parents=True, exist_ok=True)
    target = path if kind == "loop" else path.with_name(f"real{exporter.suffix}")
    if kind == "former":
        exporter.write(target, labels)
    path.symlink_to(target)
    before = sorted(path.parent.iterdir())
    with pytest.raises(ConfigError, match=f"{path.name}: is a symbolic link") as caught:
        exporter.write(path, labels)
    assert_one_line(caught.value)
    assert path.is_symlink()
    assert sorted(path.parent.iterdir()) == before


def test_the_labels_are_not_modified(exporter, labels, tmp_path) -> None:
    before = copy.deepcopy((labels.frames, labels.ground_truth, labels.labels))
    exporter.write(place(exporter, tmp_path), labels)
    assert (labels.frames, labels.ground_truth, labels.labels) == before


def test_background_labels_are_not_objects_in_the_export(exporter, labels, tmp_path) -> None:
    """A reader of objects finds no label of weight 0 if weight 0 means background."""
    background = replace(labels, description=replace(labels.description, zero_weight="background"))
    path = place(exporter, tmp_path)
    exporter.write(path, background)
    weights = weights_of_objects(exporter.name, path)
    assert bool(weights) == (exporter.name in OBJECT_WEIGHTS)
    assert 0 not in weights


def weights_of_objects(name: str, path: Path) -> list[float]:
    """Return the weights of all objects that a reader without weights finds in unlabeled frames."""
    return OBJECT_WEIGHTS[name](path) if name in OBJECT_WEIGHTS else []


def kitti_objects(path: Path) -> list[float]:
    """Read the lines of label_2, which have no weights.

    Those beyond the labels above 0 count as 0.
    """
    weights = [row[-1] for rows in read_kitti(path).values() for row in rows]
    lines = "".join(file.read_text() for file in (path / "label_2").iterdir()).splitlines()
    objects = [line for line in lines if not line.startswith("DontCare")]
    kept = [weight for weight in weights if weight > 0]
    return kept + [0.0] * (len(objects) - len(kept))


def openpcdet_objects(path: Path) -> list[float]:
    """Read the annos with a name that is learned."""
    infos = pickle.loads((path / "kitti_infos_train.pkl").read_bytes())
    pairs = [zip(i["annos"]["weight"], i["annos"]["name"], strict=True) for i in infos]
    return [weight for pair in pairs for weight, shown in pair if shown in CATEGORIES]


def mmdet3d_objects(path: Path) -> list[float]:
    """Read the instances with a label."""
    infos = pickle.loads((path / "kitti_infos_train.pkl").read_bytes())["data_list"]
    instances = [each for info in infos for each in info["instances"]]
    return [each["weight"] for each in instances if each["bbox_label_3d"] >= 0]


# SQLite, CSV and Parquet are tables of weights, with readers that cannot overlook them.
OBJECT_WEIGHTS: Mapping[str, Callable[[Path], list[float]]] = {
    "kitti": kitti_objects,
    "coco": lambda path: [
        each["weight"]
        for each in json.loads(path.read_text())["annotations"]
        if not each["iscrowd"]
    ],
    "openpcdet": openpcdet_objects,
    "st3d": lambda path: [
        weight
        for frame in pickle.loads((path / "ps_label_e0.pkl").read_bytes()).values()
        for weight in frame["weight"].tolist()
    ],
    "mmdet3d": mmdet3d_objects,
    "nuscenes": lambda path: [
        box["weight"] for boxes in json.loads(path.read_text())["results"].values() for box in boxes
    ],
}


@pytest.mark.parametrize("broken_field", ["weight", "labeled frame"])
def test_an_export_iterates_over_the_labels_once(
    exporter, labels, tmp_path, broken_field: str
) -> None:
    """An error in the last block is found in the same pass."""
    walks = []

    class Walked:
        """Blocks that count how often they are iterated over."""

        def __init__(self, blocks) -> None:
            self.blocks = blocks

        def __iter__(self):
            walks.append(1)
            return iter(self.blocks)

    rows = rows_of(labels)
    wrong = {"weight": {"weight": "much"}, "labeled frame": {"frame": labels.frames[0].frame}}
    bad = [block(rows[:-1]), block([rows[-1] | wrong[broken_field]])]
    path = place(exporter, tmp_path)
    exporter.write(path, replace(labels, labels=Walked(labels.labels)))
    before = files(path)
    with pytest.raises(DataError, match=r"weight|outside the unlabeled split") as caught:
        exporter.write(path, replace(labels, labels=Walked(bad)))
    assert_one_line(caught.value)
    assert len(walks) == 2
    assert files(path) == before


def test_no_exporter_accepts_ground_truth_of_unlabeled_frames(exporter, labels, tmp_path) -> None:
    """The label set rejects it, as well as other splits and labels of labeled frames."""
    first, second, *_ = [each.frame for each in labels.frames]
    with pytest.raises(LeakageError, match=second):
        replace(labels, ground_truth=labels.ground_truth | {"frame": [second]})
    with pytest.raises(LeakageError, match="000777"):
        replace(labels, frames=[*labels.frames, FrameFiles("000777", "val", "p", "i", "c")])
    rows = rows_of(labels)
    misplaced = with_rows(labels, [rows[0] | {"frame": first}, *rows[1:]])
    with pytest.raises(DataError, match=first):
        exporter.write(place(exporter, tmp_path), misplaced)
