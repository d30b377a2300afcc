"""Recorded results in the formats of other projects: the same boxes in every format."""

import json
import logging
import pickle
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.toys import toy_calibration

from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.labels import from_detections, write_objects
from curate.detections import Detections, as_categories
from curate.detectors.recorded import RecordedDetector
from curate.errors import ConfigError, DataError
from curate.frames import Calibration, Frame
from curate.geometry.similarity import Similarity

BOXES = np.array([
    [12.0, 4.2, -0.8, 3.9, 1.6, 1.5, -3.0],
    [20.0, -5.0, -0.6, 0.8, 0.6, 1.8, 0.4],
])  # fmt: skip
FOUND = Detections(BOXES, np.array([0.9, 0.25]), as_categories(["Car", "Pedestrian"]))
CLASSES = ("Pedestrian", "Cyclist", "Car")
TO_MAP = Rotation.from_euler("zyx", [2.0, 0.02, -0.03])
MAP_ORIGIN = np.array([600.0, 1600.0, 1.8])
FRAMES = {"000001": FOUND, "000002": Detections.empty()}


def tilted_calibration():
    """Return a camera apart from the LiDAR, so that a missing transform shows."""
    plain = toy_calibration()
    moved = plain.lidar_to_camera.copy()
    moved[:3, 3] = [0.3, -0.1, -0.27]
    pose = np.eye(4)
    pose[:3, :3] = TO_MAP.as_matrix()
    pose[:3, 3] = MAP_ORIGIN
    return Calibration(plain.projection, moved, pose)


def frame(frame_id):
    """Return a frame with a name and a calibration."""
    return Frame(frame_id, np.zeros((0, 4), np.float32), tilted_calibration(), (120, 40))


def write_kitti(folder, frames=FRAMES):
    """Write KITTI result files."""
    folder.mkdir()
    for frame_id, found in frames.items():
        objects = from_detections(found, tilted_calibration(), (120, 40))
        write_objects(folder / f"{frame_id}.txt", objects)
    return folder


def write_openpcdet(path, frames=FRAMES):
    """Write OpenPCDet's result.pkl."""
    entries = [
        {
            "frame_id": frame_id,
            "name": found.categories,
            "score": found.scores.astype(np.float32),
            "boxes_lidar": found.boxes.astype(np.float32),
            "alpha": np.zeros(len(found)),
        }
        for frame_id, found in frames.items()
    ]
    path.write_bytes(pickle.dumps(entries))
    return path


def mmdetection3d(frames=FRAMES):
    """Return mmdetection3d's entries: z at the bottom."""
    down = np.array([0, 0, 0.5, 0, 0, 0, 0])
    return {
        frame_id: {
            "boxes_3d": found.boxes - down * found.boxes[:, 5:6],
            "scores_3d": found.scores,
            "labels_3d": np.array([CLASSES.index(name) for name in found.categories], dtype=int),
        }
        for frame_id, found in frames.items()
    }


def write_mmdetection3d(path, frames=FRAMES):
    """Write a pickle of arrays without names, with the frame order beside it."""
    path.write_bytes(pickle.dumps(list(mmdetection3d(frames).values())))
    (path.parent / "order.txt").write_text("\n".join(frames) + "\n")
    return path


def write_inferencer(folder, frames=FRAMES):
    """Write the folder of the inferencer."""
    folder.mkdir()
    for frame_id, entry in mmdetection3d(frames).items():
        content = {key: value.tolist() for key, value in entry.items()}
        content["bboxes_3d"] = content.pop("boxes_3d")
        (folder / f"{frame_id}.json").write_text(json.dumps(content | {"box_type_3d": "LiDAR"}))
    return folder


def nuscenes(frames=FRAMES):
    """Return nuScenes' results: the task's names, width before length, in the map."""
    names = {"Car": "car", "Pedestrian": "pedestrian"}
    return {
        frame_id: [
            {
                "sample_token": frame_id,
                "translation": (MAP_ORIGIN + TO_MAP.apply(box[:3])).tolist(),
                "size": [box[4], box[3], box[5]],
                "rotation": np.roll(
                    (TO_MAP * Rotation.from_euler("z", box[6])).as_quat(), 1
                ).tolist(),
                "velocity": [0.0, 0.0],
                "detection_name": names[category],
                "detection_score": score,
                "attribute_name": "",
            }
            for box, score, category in zip(
                found.boxes.tolist(), found.scores.tolist(), found.categories, strict=True
            )
        ]
        for frame_id, found in frames.items()
    }


def write_nuscenes(path, frames=FRAMES):
    """Write one JSON file."""
    path.write_text(json.dumps({"meta": {"use_lidar": True}, "results": nuscenes(frames)}))
    return path


FORMATS = {
    "kitti": (write_kitti, {}),
    "openpcdet.pkl": (write_openpcdet, {}),
    "mmdetection3d.pkl": (
        write_mmdetection3d,
        {"classes": CLASSES, "frame_list": "order.txt", "version": "1.x"},
    ),
    "preds": (write_inferencer, {"classes": CLASSES}),
    "nuscenes.json": (write_nuscenes, {}),
}


@pytest.fixture(params=FORMATS)
def written(request, tmp_path):
    """Return path, writer and the required options of every format."""
    write, options = FORMATS[request.param]
    return write(tmp_path / request.param), write, options


def test_every_format_gives_the_same_boxes(written):
    """The origin is the centre in the LiDAR frame; values agree to the decimals of the file."""
    path, _, options = written
    record = RecordedDetector(path, **options)
    found = record.predict(frame("000001"))
    np.testing.assert_allclose(found.boxes, BOXES, atol=1e-4)
    np.testing.assert_allclose(found.scores, FOUND.scores, atol=1e-6)
    assert found.categories.tolist() == ["Car", "Pedestrian"]
    assert record.predict(frame("000002")).boxes.shape == (0, 7)
    assert record.frame_ids() == ("000001", "000002")


def test_low_scores_are_dropped_and_names_translated(written):
    """As the options specify."""
    path, _, options = written
    record = RecordedDetector(path, 0.5, rename={"Car": "car"}, **options)
    assert record.predict(frame("000001")).categories.tolist() == ["car"]


def test_every_format_knows_its_names(written):
    """Of all frames, before the first one is predicted; renamed like the boxes."""
    path, _, options = written
    assert RecordedDetector(path, **options).category_names() == {"Car", "Pedestrian"}
    renamed = RecordedDetector(path, rename={"Car": "car"}, **options)
    assert renamed.category_names() == {"car", "Pedestrian"}


def test_a_damaged_result_file_does_not_hide_the_names_of_others(tmp_path):
    """As long as its frame is not in the data set; otherwise the record is rejected."""
    folder = write_kitti(tmp_path / "results")
    (folder / "000003.txt").write_bytes(b"\xff\xfe 1 2\n\nDontCare 1\n")
    found = RecordedDetector(folder, frame_ids=tuple(FRAMES))
    assert found.category_names() == {"Car", "Pedestrian"}
    with pytest.raises(DataError, match=r"000003\.txt"):
        RecordedDetector(folder)


def test_the_names_of_further_passes_count(tmp_path):
    """A name that occurs only in an augmented copy is compared too."""
    van = Detections(BOXES, FOUND.scores, as_categories(["Car", "Van"]))
    plain = write_openpcdet(tmp_path / "plain.pkl")
    write_openpcdet(tmp_path / "flipped.pkl", {"000001": van})
    record = RecordedDetector(plain, passes=[{"path": "flipped.pkl", "flip_y": True}])
    assert record.category_names() == {"Car", "Pedestrian", "Van"}


def test_a_second_pass_gives_views(written):
    """Its boxes stay in the frame of the copy; without one there are no views, and a warning."""
    path, write, options = written
    similarity = Similarity(flip_y=True, rotation_rad=0.1, scale=1.02)
    moved = Detections(similarity.apply_to_boxes(BOXES), FOUND.scores, FOUND.categories)
    second = write(path.with_name(f"second{path.suffix}"), {**FRAMES, "000001": moved})
    passes = [{"path": second.name, "flip_y": True, "rotation_rad": 0.1, "scale": 1.02}]
    record = RecordedDetector(
        path, passes=passes, calibration=lambda _: tilted_calibration(), **options
    )
    [(found_similarity, found)] = record.views("000001")
    assert found_similarity == similarity
    np.testing.assert_allclose(similarity.invert_boxes(found.boxes), BOXES, atol=2e-4)


def test_a_missing_second_pass_is_reported_once(tmp_path, caplog):
    """All weights would be 0 without an explanation."""
    record = RecordedDetector(write_openpcdet(tmp_path / "a.pkl"))
    with caplog.at_level(logging.WARNING):
        assert list(record.views("000001")) == list(record.views("000002")) == []
    assert len(caplog.messages) == 1
    assert "no second pass" in caplog.messages[0]


@pytest.mark.parametrize(
    ("one", "message"),
    [
        ({"path": "a.pkl"}, "state how the points were transformed"),
        ({"flip_y": True}, "takes path"),
        ({"path": "a.pkl", "flip": True}, "takes path"),
        ({"path": "a.pkl", "scale": "big"}, "could not convert"),
        ({"path": "a.pkl", "scale": -1}, "positive scale"),
    ],
)
def test_a_pass_must_specify_its_augmentation(tmp_path, one, message):
    """Exactly, or it is rejected."""
    with pytest.raises(ConfigError, match=message):
        RecordedDetector(write_openpcdet(tmp_path / "a.pkl"), passes=[one])


def test_a_frame_without_result_is_an_error(written):
    """It becomes a failed frame."""
    path, _, options = written
    with pytest.raises(DataError, match="no recorded detections for frame 000007"):
        RecordedDetector(path, **options).predict(frame("000007"))


def test_results_for_unknown_frames_are_reported(written, caplog):
    """Some: a warning that lists them. All: an error that shows example frame names."""
    path, _, options = written
    with caplog.at_level(logging.WARNING):
        RecordedDetector(path, frame_ids=("000001", "000007"), **options)
    assert "1 of 2 results are for frames that the data set does not have (000002)" in caplog.text
    message = r"frames that do not exist \(000001, 000002\); the nearest are '00000[78]' and '00000"
    with pytest.raises(DataError, match=message):
        RecordedDetector(path, frame_ids=("000007", "000008"), **options)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"boxes_lidar": BOXES * [1, 1, 1, 1, -1, 1, 1]}, "box 0: length, width or height"),
        ({"boxes_lidar": BOXES * np.nan}, "box 0: a number is NaN"),
        ({"boxes_lidar": BOXES[:, :5]}, r"boxes \[2, 5\]"),
        ({"boxes_lidar": BOXES[:1]}, r"boxes \[1, 7\]"),
        ({"boxes_lidar": "far"}, "must be numbers"),
    ],
)
def test_impossible_results_are_reported(tmp_path, change, message):
    """With the entry and the frame."""
    entry = {"frame_id": "7", "name": FOUND.categories, "score": FOUND.scores, "boxes_lidar": BOXES}
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps([entry | change]))
    with pytest.raises(DataError, match=message) as caught:
        RecordedDetector(path)
    assert f"{path}: entry 0 (frame 7)" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numbered_labels_need_class_names(tmp_path):
    """The order of classes is the model's; a wrong order would not be noticed."""
    path = write_mmdetection3d(tmp_path / "a.pkl")
    declared = {"frame_list": "order.txt", "version": "1.x"}
    with pytest.raises(ConfigError, match=r"set detector\.options\.classes"):
        RecordedDetector(path, frame_list="order.txt")
    with pytest.raises(DataError, match="label 2, but"):
        RecordedDetector(path, classes=["Pedestrian", "Cyclist"], **declared)
    with pytest.raises(ConfigError, match="frame_list"):
        RecordedDetector(path, classes=CLASSES)
    (tmp_path / "order.txt").write_text("000001\n")
    with pytest.raises(DataError, match="1 frame ids for 2"):
        RecordedDetector(path, classes=CLASSES, **declared)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", {"a": 1}, "contains a dict, not a list of frames"),
        ("a.json", [], "contains no frames"),
        ("a.json", [{"a": 1}], r"entries of an unknown format \(a\)"),
        ("a.json", [3], r"entries of an unknown format \(int\)"),
        ("a.json", [{"boxes_lidar": []}], "no frame_id, name, score"),
        ("a.xml", [], "not a supported format of detections; expected a .csv or .parquet file"),
    ],
)
def test_unsupported_contents_are_rejected(tmp_path, name, content, message):
    """The error lists what can be read."""
    (tmp_path / name).write_text(json.dumps(content))
    with pytest.raises(DataError, match=message):
        RecordedDetector(tmp_path / name)


def test_boxes_in_the_camera_frame_are_rejected(tmp_path):
    """mmdetection3d marks them in its files."""
    entry = {"frame_id": "1", "bboxes_3d": [], "scores_3d": [], "labels_3d": []}
    (tmp_path / "a.json").write_text(json.dumps([entry | {"box_type_3d": "Camera"}]))
    with pytest.raises(DataError, match="of type Camera, not LiDAR"):
        RecordedDetector(tmp_path / "a.json", classes=CLASSES)


def test_the_format_can_be_specified(tmp_path):
    """An unknown name is rejected, and so is a folder without results."""
    path = write_openpcdet(tmp_path / "a.pkl")
    assert len(RecordedDetector(path, kind="openpcdet").frame_ids()) == 2
    with pytest.raises(
        ConfigError, match="'yolo': use one of auto, csv, parquet, kitti, openpcdet"
    ):
        RecordedDetector(path, kind="yolo")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="contains no KITTI result files"):
        RecordedDetector(tmp_path / "empty")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("Car 0 0", "3 fields"),
        ("Car 0 0 0 1 1 9 9 0 0 0 0 0 0 0 0.5", "no 3D box: height, width and length of the Car"),
        ("Car 0 0 0 1 1 9 9 1.5 0 4 0 0 0 0 0.5", "height, .* are 1.5 0 4, but must be pos"),
    ],
)
def test_an_invalid_result_file_is_found_when_the_results_are_opened(tmp_path, line, message):
    """Before any frame is worked on, as in all other formats."""
    folder = write_kitti(tmp_path / "results")
    (folder / "000003.txt").write_text(f"{line}\n")
    with pytest.raises(DataError, match=rf"000003\.txt:1: {message}"):
        RecordedDetector(folder)


def written_results(tmp_path, boxes):
    """Return a file with these results of frame 000001."""
    (tmp_path / "a.json").write_text(json.dumps({"meta": {}, "results": {"000001": boxes}}))
    return tmp_path / "a.json"


BOX = nuscenes()["000001"][0]


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        ([BOX | {"size": BOX["size"][:2]}], "box 0: translation, size, rotation and"),
        ([BOX | {"translation": [1, "far", 2]}], "box 0: translation, size, rotation and"),
        ([BOX | {"detection_name": [1]}], "box 0: its detection_name is not text"),
        ([BOX | {"translation": [10**400, 0, 0]}], "box 0: translation|integer overflow"),
        ([BOX | {"detection_score": None}], "box 0: translation, size, rotation and"),
        ([{"translation": [0, 0, 0]}], "box 0: no size, rotation, detection_name"),
        ([BOX | {"sample_token": "other"}], "box 0: its sample_token is other, but it is listed"),
        ([BOX | {"rotation": [2, 0, 0, 0]}], r"box 0: rotation .* is not a unit quaternion"),
        ([BOX | {"rotation": [0, 0, 0.6, 0.8]}], "box 0 would be tilted by .* w, x, y, z, not x"),
        ([BOX | {"size": [3.9, 1.6, 1.5]}] * 10, "10 of 10 boxes of .* wider than long"),
        ({"a": 1}, "expected a list of boxes, not dict"),
    ],
)
def test_common_mistakes_in_nuscenes_results_are_reported(tmp_path, boxes, message):
    """At once, with frame and box."""
    path = written_results(tmp_path, boxes)
    with pytest.raises(DataError, match=message) as caught:
        RecordedDetector(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_nuscenes_results_in_the_lidar_frame_are_rejected(tmp_path):
    """They would be hundreds of metres from the vehicle."""
    path = written_results(tmp_path, [BOX | {"translation": [12.0, 4.0, -0.8]}])
    with pytest.raises(DataError, match="are these in the LiDAR or vehicle frame") as caught:
        RecordedDetector(path).predict(frame("000001"))
    assert "results of 000001" in str(caught.value)
    path = written_results(tmp_path, [BOX | {"translation": [5000.0, 4.0, -0.8]}])
    with pytest.raises(DataError, match=r"vehicle, which is at \[600.0, 1600.0\] in the map"):
        RecordedDetector(path).predict(frame("000001"))


def test_nuscenes_results_need_poses(tmp_path):
    """KITTI has none."""
    record = RecordedDetector(write_nuscenes(tmp_path / "a.json"))
    bare = Frame("000001", np.zeros((0, 4), np.float32), toy_calibration(), (120, 40))
    with pytest.raises(ConfigError, match="need the vehicle's poses"):
        record.predict(bare)


@pytest.fixture(params=["ijson", "json"])
def json_reader(request, monkeypatch):
    """Run the test with ijson, if it is installed, and without."""
    if request.param == "ijson":
        pytest.importorskip("ijson")
    else:
        monkeypatch.setitem(sys.modules, "ijson", None)


@pytest.mark.usefixtures("json_reader")
def test_streaming_and_whole_reading_agree(tmp_path):
    """A key in the meta that is called results is not mistaken for the results."""
    path = write_nuscenes(tmp_path / "a.json")
    content = json.loads(path.read_text())
    path.write_text(json.dumps({"meta": {"results": {"a": 1}}, **content, "more": [{}]}))
    record = RecordedDetector(path)
    assert record.frame_ids() == tuple(sorted(nuscenes()))
    path.write_text(json.dumps({"meta": {}, "results": {}}))
    assert RecordedDetector(path).frame_ids() == ()


@pytest.mark.usefixtures("json_reader")
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"results": {"000001": [', "cannot be read as JSON"),
        ('{"results": {"000001": []}} {}', "cannot be read as JSON"),
        ('{"results": {"000001": [1e}}', "cannot be read as JSON"),
        ('{"results": {"a\\nb": {}}}', "results of a b: expected a list of boxes"),
        ('{"results": 3}', "results is a int, not an object of sample tokens"),
        ('{"results": null}', "results is a NoneType, not an object of sample tokens"),
        ('{"meta": {}}', "contains a dict, not a list of frames and not nuScenes results"),
    ],
)
def test_damaged_results_are_rejected_in_one_line(tmp_path, text, message):
    """By both readers."""
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        RecordedDetector(tmp_path / "a.json")
    assert len(str(caught.value).splitlines()) == 1


def test_a_file_that_is_not_a_nuscenes_result_is_rejected(tmp_path):
    """If the format was specified."""
    (tmp_path / "a.json").write_text("[]")
    with pytest.raises(
        DataError, match="not nuScenes results; expected a JSON object with meta and results"
    ):
        RecordedDetector(tmp_path / "a.json", kind="nuscenes")
    with pytest.raises(DataError, match=r"results is a \w+, not an object of sample tokens"):
        (tmp_path / "a.json").write_text('{"meta": {}, "results": []}')
        RecordedDetector(tmp_path / "a.json")


@pytest.mark.kitti
def test_real_results_in_kitti_format_equal_the_record(kitti_root, tmp_path):
    """A real detector's boxes, written as result files with the real calibration, are read back."""
    dataset = KittiDataset(kitti_root)
    record = RecordedDetector(kitti_root / "recorded" / "pointgnn_T0.csv")
    (tmp_path / "results").mkdir()
    frames = [dataset.read(name, points=False) for name in record.frame_ids()]
    for each in frames:
        objects = from_detections(record.predict(each), each.calibration, each.image_size)
        write_objects(tmp_path / "results" / f"{each.frame_id}.txt", objects)
    read = RecordedDetector(tmp_path / "results", frame_ids=dataset.frame_ids())
    for each in frames:
        expected, found = record.predict(each), read.predict(each)
        np.testing.assert_allclose(found.boxes[:, :6], expected.boxes[:, :6], atol=2e-4)
        turn = np.abs(np.sin((found.boxes[:, 6] - expected.boxes[:, 6]) / 2))
        assert turn.max(initial=0) < 1e-4


@pytest.mark.parametrize("kind", [*FORMATS, "a.csv", "a.parquet"])
def test_scores_before_the_sigmoid_are_converted_where_that_is_declared(tmp_path, kind):
    """By the same option in every format, which the message names where it is missing."""
    logits = np.array([6.5, 2.1, -0.4, -2.6])
    boxes = np.repeat(BOXES[:1], 4, axis=0) + np.arange(4)[:, None] * [0, 3, 0, 0, 0, 0, 0]
    frames = {"000001": Detections(boxes, logits, as_categories(["Car"] * 4))}
    write, options = FORMATS.get(kind, (write_table, {}))
    path = write(tmp_path / kind, frames)
    found = RecordedDetector(path, sigmoid=True, **options).predict(frame("000001"))
    np.testing.assert_allclose(found.scores, [0.9985, 0.8909, 0.4013, 0.0691], atol=5e-5)
    kept = RecordedDetector(path, 0.4, sigmoid=True, **options).predict(frame("000001"))
    assert len(kept) == 3
    message = r"scores from -2.6 to 6.5 are not in \[0, 1\]; set detector\.options\.sigmoid = true"
    with pytest.raises(DataError, match=message):
        RecordedDetector(path, **options).predict(frame("000001"))
    percent = {
        "000001": Detections(boxes, np.array([99.0, 80, 20, 5]), frames["000001"].categories)
    }
    path = write(tmp_path / f"percent-{kind}", percent)
    with pytest.raises(DataError, match=r"scores up to 99 .*; divide them by 100 if they are"):
        RecordedDetector(path, **options).predict(frame("000001"))


def write_table(path, frames):
    """Write the columns of a CSV or Parquet record."""
    pd = pytest.importorskip("pandas")
    names = ("x", "y", "z", "length", "width", "height", "yaw")
    tables = [
        pd.DataFrame(found.boxes, columns=names).assign(
            frame=name, category=found.categories, score=found.scores,
            view=0, flip_y=0, rotation_rad=0.0, scale=1.0,
        )
        for name, found in frames.items()
    ]  # fmt: skip
    table = pd.concat(tables)
    table.to_csv(path, index=False) if path.suffix == ".csv" else table.to_parquet(path)
    return path


def renamed(write, path, frames, names):
    """Write a record whose frames have other names."""
    return write(path, dict(zip(names, frames.values(), strict=True)))


TWO = {"000001": FOUND, "000002": Detections(BOXES[:1], FOUND.scores[:1], FOUND.categories[:1])}
SPELLINGS = {
    "numbers": ("1", "2"),
    "padded otherwise": ("0001", "0002"),
    "numbers and names": ("1", "000002"),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("kind", [*FORMATS, "a.csv", "a.parquet"])
def test_frames_are_matched_in_every_spelling(tmp_path, kind, spelling):
    """In every format; two spellings of one frame are rejected."""
    write, options = FORMATS.get(kind, (write_table, {}))
    path = renamed(write, tmp_path / kind, TWO, SPELLINGS[spelling])
    detector = RecordedDetector(path, frame_ids=("000001", "000002", "000003"), **options)
    assert [len(detector.predict(frame(name))) for name in TWO] == [2, 1]
    with pytest.raises(DataError, match="no recorded detections for frame 000003"):
        detector.predict(frame("000003"))
    path = renamed(write, tmp_path / f"twice-{kind}", TWO, ("1", "000001"))
    with pytest.raises(DataError, match="are both frame 000001; remove one"):
        RecordedDetector(path, frame_ids=("000001", "000002"), **options)
    with pytest.raises(DataError, match=r"1' could be 'a_1' or 'b_1'; write the whole frame id"):
        RecordedDetector(path, frame_ids=("a_1", "b_1"), **options)


@pytest.mark.parametrize(
    "names",
    [
        (1, 2),
        (np.int64(1), np.int64(2)),
        ("000001.bin", "000002.bin"),
        ("training/velodyne/000001.bin", "training/velodyne/000002.bin"),
        ("C:\\kitti\\velodyne\\000001.bin", "C:\\kitti\\velodyne\\000002.bin"),
    ],
)
@pytest.mark.parametrize("key", ["frame_id", "sample_idx", "lidar_path"])
def test_mmdetection3d_names_frames_by_number_or_path(tmp_path, key, names):
    """As its versions do."""
    entries = [
        {key: name, "box_type_3d": "LiDAR", **entry}
        for name, entry in zip(names, mmdetection3d().values(), strict=True)
    ]
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(entries))
    detector = RecordedDetector(
        tmp_path / "a.pkl",
        classes=CLASSES,
        version="1.x",
        frame_ids=("000001", "000002", "000011"),
    )
    assert [len(detector.predict(frame(name))) for name in FRAMES] == [2, 0]


def test_a_path_is_matched_by_its_last_part_without_a_data_set(tmp_path):
    entry = {"lidar_path": "a/000001.bin", "box_type_3d": "LiDAR", **mmdetection3d()["000001"]}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([entry]))
    detector = RecordedDetector(tmp_path / "a.pkl", classes=CLASSES, version="1.x")
    assert len(detector.predict(frame("000001"))) == 2


def test_a_second_pass_may_spell_frames_differently(tmp_path):
    path = write_openpcdet(tmp_path / "a.pkl", TWO)
    renamed(write_openpcdet, tmp_path / "b.pkl", TWO, ("1", "2"))
    passes = [{"path": "b.pkl", "flip_y": True}]
    detector = RecordedDetector(path, passes=passes, frame_ids=tuple(TWO))
    assert [len(found) for _, found in detector.views("000002")] == [1]


def test_other_text_files_beside_results_are_left_out(tmp_path, caplog):
    """KITTI's tools write statistics beside the folder data, other programs a log."""
    folder = write_kitti(tmp_path / "results")
    (folder / "log.txt").write_text("epoch 12\n")
    detector = RecordedDetector(folder, frame_ids=tuple(FRAMES))
    assert len(detector.predict(frame("000001"))) == 2
    assert "1 of 3 results are for frames that the data set does not have (log)" in caplog.text
    (tmp_path / "kit").mkdir()
    write_kitti(tmp_path / "kit" / "data")
    (tmp_path / "kit" / "stats_car_detection.txt").write_text("0.1 0.2\n")
    assert RecordedDetector(tmp_path / "kit").frame_ids() == tuple(FRAMES)


def test_result_files_of_drives_are_in_subfolders(tmp_path):
    drive = "2011_09_26_drive_0001_sync"
    (tmp_path / "results").mkdir()
    write_kitti(tmp_path / "results" / drive)
    frames = [f"{drive}_{number:010d}" for number in range(4)]
    detector = RecordedDetector(tmp_path / "results", frame_ids=frames)
    assert [len(detector.predict(frame(name))) for name in frames[1:3]] == [2, 0]


def entry_of(**changes):
    """Return an mmdetection3d entry of a car 4 m long and 2 m wide that points along x, in 1.x."""
    boxes = [[10.0, 2.0, -1.0, 4.0, 2.0, 1.5, 0.0]]
    return {"frame_id": "1", "boxes_3d": boxes, "scores_3d": [0.5], "labels_3d": [0]} | changes


def mmdetection3d_box(path, entry, **options):
    """Return the box of the only entry."""
    path.write_bytes(pickle.dumps([entry]))
    record = RecordedDetector(path, classes=["Car"], **options)
    return record.predict(frame("1")).boxes[0].round(9).tolist()


def test_the_version_of_mmdetection3d_is_declared_where_the_file_does_not_show_it(tmp_path):
    """The same numbers are another box in 0.x; the message names both readings."""
    new, old = [10, 2, -0.25, 4, 2, 1.5, 0], [10, 2, -0.25, 2, 4, 1.5, round(-np.pi / 2, 9)]
    entry, path = entry_of(), tmp_path / "a.pkl"
    with pytest.raises(ConfigError, match=r"1\.x \(length, width.* or 0\.x \(width, length.*; set"):
        mmdetection3d_box(path, entry)
    assert mmdetection3d_box(path, entry, version="1.x") == new
    assert mmdetection3d_box(path, entry, version="0.x") == old
    with pytest.raises(ConfigError, match=r"options\.version '2': use 0\.x or 1\.x"):
        mmdetection3d_box(path, entry, version="2")
    numbers = {key: entry[key] for key in ("boxes_3d", "scores_3d", "labels_3d")}
    renamed = {key: value for key, value in entry.items() if key != "boxes_3d"}
    for shows_it in (
        {"frame_id": "1", "pred_instances_3d": numbers},
        renamed | {"bboxes_3d": entry["boxes_3d"]},
        entry | {"box_type_3d": "LiDAR"},
    ):
        assert mmdetection3d_box(path, shows_it) == new
        with pytest.raises(ConfigError, match=r"which mmdetection3d 0\.x does not write; remove"):
            mmdetection3d_box(path, shows_it, version="0.x")


def test_boxes_of_openpcdet_before_0_3_are_rejected(tmp_path):
    """Their sizes begin with the width; the lengths in the camera frame show it."""
    box = [10.0, 2.0, -1.0, 4.0, 2.0, 1.5, 0.0]
    entry = {"frame_id": "1", "name": ["Car"], "score": [0.5], "boxes_lidar": np.array([box])}
    path = tmp_path / "result.pkl"
    path.write_bytes(pickle.dumps([entry | {"dimensions": np.array([[4.0, 1.5, 2.0]])}]))
    assert RecordedDetector(path).predict(frame("1")).boxes.tolist() == [box]
    path.write_bytes(pickle.dumps([entry | {"dimensions": np.array([[2.0, 1.5, 4.0]])}]))
    with pytest.raises(DataError, match=r"boxes_lidar begin with the width, as in OpenPCDet befo"):
        RecordedDetector(path)


def test_camera_boxes_without_lidar_boxes_are_rejected_with_a_way_out(tmp_path):
    """As mmdetection3d formats results for KITTI's evaluation."""
    entry = {"name": ["Car"], "location": [[1, 2, 3]], "rotation_y": [0.1], "score": [0.5]}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([entry]))
    with pytest.raises(DataError, match="without boxes_lidar; write them as KITTI result files"):
        RecordedDetector(tmp_path / "a.pkl")
