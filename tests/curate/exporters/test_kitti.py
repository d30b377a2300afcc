"""Weighted labels as KITTI label files."""

import json

import numpy as np
import pytest
from support.toys import IMAGE_SIZE, toy_calibration

from curate.datasets.kitti.labels import read_objects, to_detections
from curate.detections import Detections
from curate.errors import ConfigError, DataError
from curate.exporters.kitti import WeightedFrame, export_kitti

BOXES = np.array(
    [[20.0, 0, 0, 4, 2, 1.5, 0.1], [10, -2, 0, 0.8, 0.6, 1.7, 3], [9, 2, 0, 4, 2, 1, 1]]
)


def weighted_frame(name="000001", weights=(0.75, 0.0, 0.5), zero_weight="ignore"):
    """Return three labels; the second has weight 0."""
    count = len(weights)
    labels = Detections(
        BOXES[:count],
        np.array([0.9, 0.3, 0.6])[:count],
        np.array(["Car", "Pedestrian", "Car"])[:count],
    )
    weights = np.array(weights)
    nothing = (weights == 0) & (zero_weight == "ignore")
    return WeightedFrame(name, labels, weights, nothing, toy_calibration(), IMAGE_SIZE)


def files(directory):
    """Return every file below a folder, by relative path."""
    paths = [path for path in directory.rglob("*") if path.is_file()]
    return {str(path.relative_to(directory)): path.read_text() for path in paths}


def test_labels_are_kitti_lines_with_their_weight(tmp_path):
    """The reader of result files gets boxes, categories, and the weight in place of the score."""
    assert export_kitti(tmp_path / "out", [weighted_frame()]) == 3
    objects = read_objects(tmp_path / "out" / "label_2" / "000001.txt", scored=True)
    assert objects.categories.tolist() == ["Car", "DontCare", "Car"]
    assert objects.scores.tolist() == [0.75, 0.0, 0.5]
    kept = to_detections(objects, toy_calibration())
    assert kept.boxes == pytest.approx(BOXES[[0, 2]], abs=1e-3)


def test_a_label_of_weight_0_is_an_ignored_region(tmp_path):
    """Its line keeps only the rectangle; category and 3D box are in the folder `weight`."""
    export_kitti(tmp_path / "out", [weighted_frame()])
    lines = (tmp_path / "out" / "label_2" / "000001.txt").read_text().splitlines()
    fields = lines[1].split()
    assert fields[:4] == ["DontCare", "-1", "-1", "-10"]
    left, top, right, bottom = map(float, fields[4:8])
    assert 0 <= left < right <= IMAGE_SIZE[0]
    assert 0 <= top < bottom <= IMAGE_SIZE[1]
    assert fields[8:15] == ["-1", "-1", "-1", "-1000", "-1000", "-1000", "-10"]
    sidecar = (tmp_path / "out" / "weight" / "000001.txt").read_text().splitlines()
    category, *numbers = sidecar[1].split()
    assert category == "Pedestrian"
    assert [float(number) for number in numbers] == pytest.approx([0.0, 0.3, *BOXES[1]])


def test_a_label_of_weight_0_that_is_background_has_no_line(tmp_path):
    """It is only in the folder `weight`, in its position; the marker explains why."""
    out = tmp_path / "out"
    frames = [weighted_frame(zero_weight="background")]
    assert export_kitti(out, frames, zero_weight="background") == 3
    objects = read_objects(out / "label_2" / "000001.txt", scored=True)
    assert objects.categories.tolist() == ["Car", "Car"]
    assert objects.scores.tolist() == [0.75, 0.5]
    lines = (out / "weight" / "000001.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["Car", "Pedestrian", "Car"]
    assert json.loads((out / "export.json").read_text())["zero_weight"] == "background"


@pytest.mark.parametrize(
    ("last_field", "scores"), [("weight", [0.75, 0, 0.5]), ("score", [0.9, 0.3, 0.6])]
)
def test_the_last_field_can_be_chosen(tmp_path, last_field, scores):
    """Weight or score in the 16th field."""
    export_kitti(tmp_path / "out", [weighted_frame()], last_field=last_field)
    objects = read_objects(tmp_path / "out" / "label_2" / "000001.txt", scored=True)
    assert objects.scores.tolist() == scores


def test_without_a_last_field_they_are_plain_label_files(tmp_path):
    """15 fields, as KITTI's own."""
    export_kitti(tmp_path / "out", [weighted_frame()], last_field="none")
    assert len(read_objects(tmp_path / "out" / "label_2" / "000001.txt")) == 3
    with pytest.raises(ConfigError, match="use one of weight, score, none"):
        export_kitti(tmp_path / "out", [], last_field="loss")


def test_frames_without_labels_get_empty_files(tmp_path):
    """A trainer then finds a file for every frame."""
    export_kitti(tmp_path / "out", [weighted_frame(weights=())])
    assert files(tmp_path / "out") == {
        "label_2/000001.txt": "",
        "weight/000001.txt": "",
        "export.json": (tmp_path / "out" / "export.json").read_text(),
    }


def test_a_later_export_removes_the_earlier_one(tmp_path):
    """Files of frames that no longer exist are removed, and no partial folder is left."""
    out = tmp_path / "out"
    export_kitti(out, [weighted_frame("000001"), weighted_frame("000002")])
    export_kitti(out, [weighted_frame("000003", (0.5,))])
    assert set(files(out)) == {"label_2/000003.txt", "weight/000003.txt", "export.json"}
    marker = json.loads((out / "export.json").read_text())
    assert (marker["frames"], marker["labels"], marker["last_field"]) == (1, 1, "weight")
    assert list(tmp_path.iterdir()) == [out]


def test_a_failed_export_leaves_the_earlier_one_unchanged(tmp_path):
    """If an error occurs between two frames."""
    out = tmp_path / "out"
    export_kitti(out, [weighted_frame()])
    former = files(out)

    def breaking():
        yield weighted_frame("000005")
        raise DataError("frame 000006 cannot be read")

    with pytest.raises(DataError, match="000006"):
        export_kitti(out, breaking())
    assert files(out) == former
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("marker", [None, "{}", "[]", "no json", '{"format": "other"}'])
def test_folders_that_are_not_an_earlier_export_are_not_overwritten(tmp_path, marker):
    """For example a dataset's own labels."""
    label = tmp_path / "training" / "label_2" / "000001.txt"
    label.parent.mkdir(parents=True)
    label.write_text("precious")
    if marker is not None:
        (tmp_path / "training" / "export.json").write_text(marker)
    with pytest.raises(ConfigError, match="not a previous export; choose another folder"):
        export_kitti(tmp_path / "training", [weighted_frame()])
    assert label.read_text() == "precious"


def test_a_file_in_place_of_the_folder_is_not_overwritten(tmp_path):
    (tmp_path / "out").write_text("precious")
    with pytest.raises(ConfigError, match="not a previous export"):
        export_kitti(tmp_path / "out", [weighted_frame()])


def test_an_empty_folder_is_used(tmp_path):
    """Nothing can be lost."""
    (tmp_path / "out").mkdir()
    export_kitti(tmp_path / "out", [weighted_frame()])
    assert "export.json" in files(tmp_path / "out")


@pytest.mark.parametrize("weights", [(0.5, np.nan, 0.5), (0.5, 1.1, 0.5), (0.5, -0.1, 0.5)])
def test_weights_out_of_range_are_rejected(tmp_path, weights):
    """The error contains the frame."""
    with pytest.raises(DataError, match="frame 000001: needs one weight in"):
        export_kitti(tmp_path / "out", [weighted_frame(weights=weights)])


def test_a_duplicate_frame_is_rejected(tmp_path):
    """Otherwise the first one would be lost silently."""
    with pytest.raises(DataError, match="frame 000001 occurs twice"):
        export_kitti(tmp_path / "out", [weighted_frame(), weighted_frame()])
