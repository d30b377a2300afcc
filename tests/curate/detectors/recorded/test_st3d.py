"""Pseudo-labels of ST3D as recorded detections."""

import logging
import pickle

import numpy as np
import pytest
from support.exported import BOXES, CATEGORIES, SCORES, toy_labels
from support.toys import empty_frame

from curate.detectors.recorded import RecordedDetector
from curate.errors import ConfigError, DataError
from curate.exporters.st3d import ST3DExporter

CLASSES = ("Car", "Pedestrian", "Cyclist")
BOX = [10.0, 2.0, -1.0, 4.0, 2.0, 1.5, 0.5]


def write(path, rows, **more):
    """Write a frame with such gt_boxes, and an empty one."""
    empty = {"gt_boxes": np.zeros((0, 9), np.float32), "cls_scores": None, "iou_scores": None}
    frame = {"gt_boxes": np.array(rows), "cls_scores": None, "iou_scores": None} | more
    path.write_bytes(pickle.dumps({"000001": frame, "000002": empty}))
    return path


def read(path, **options):
    """Return the detections of the first frame."""
    record = RecordedDetector(path, **({"classes": CLASSES} | options))
    return record.predict(empty_frame("000001"))


def test_boxes_categories_and_scores_are_read(tmp_path):
    """Categories count from 1; a frame without boxes is a result."""
    path = write(tmp_path / "ps_label_e0.pkl", [[*BOX, 1, 0.9], [*BOX, 3, 0.4]])
    found = read(path)
    assert found.boxes.tolist() == [BOX, BOX]
    assert found.categories.tolist() == ["Car", "Cyclist"]
    assert found.scores.tolist() == [0.9, 0.4]
    assert np.isnan(found.iou).all()
    record = RecordedDetector(path, classes=CLASSES)
    assert len(record.predict(empty_frame("000002"))) == 0


def test_an_empty_file_and_missing_frames_are_shown(tmp_path):
    """Self-training that found nothing writes an empty dict."""
    path = write(tmp_path / "ps_label_e0.pkl", [[*BOX, 1, 0.9]])
    record = RecordedDetector(path, classes=CLASSES, frame_ids=("000001", "000002", "000003"))
    assert record.missing_frames(["000003", "000001", "000002"]) == ("000003",)
    path.write_bytes(pickle.dumps({}))
    with pytest.raises(DataError, match="contains no frames"):
        read(path)


def test_the_detectors_own_estimates_are_kept(tmp_path):
    """iou_scores, and cls_scores where gt_boxes has no scores."""
    more = {"cls_scores": np.float32([0.75, 0.5]), "iou_scores": np.float32([0.25, 0.5])}
    found = read(write(tmp_path / "a.pkl", [[*BOX, 1], [*BOX, 2]], **more))
    assert found.scores.tolist() == [0.75, 0.5]
    assert found.iou.tolist() == [0.25, 0.5]


def test_ignored_boxes_are_left_out_with_a_warning(tmp_path, caplog):
    """ST3D's -1 does not say which class it was."""
    path = write(tmp_path / "a.pkl", [[*BOX, 1, 0.9], [*BOX, -1, 0.3], [*BOX, -2, 0.2]])
    with caplog.at_level(logging.WARNING):
        assert read(path).scores.tolist() == [0.9]
    [message] = caplog.messages
    assert message.startswith(f"{path}: 2 of 3 boxes have a negative category")
    found = read(path, ignored="keep")
    assert found.categories.tolist() == ["Car", "Car", "Pedestrian"]
    with pytest.raises(ConfigError, match=r"detector.options.ignored 'all': use drop or keep"):
        read(path, ignored="all")


def test_a_shift_of_the_coordinates_is_undone(tmp_path):
    """SHIFT_COOR was added to the points before the detector saw them."""
    path = write(tmp_path / "a.pkl", [[*BOX, 1, 0.9]])
    assert read(path, shift=[0.0, 0.5, 1.6]).boxes[0, :3].tolist() == [10.0, 1.5, -2.6]
    with pytest.raises(ConfigError, match=r"expected \[x, y, z\] in metres"):
        read(path, shift=[1.6])


@pytest.mark.parametrize(
    ("rows", "more", "message"),
    [
        ([[*BOX, 4, 0.9]], {}, "category 4, but detector.options.classes lists 3 classes, 1 to 3"),
        ([[*BOX, 0, 0.9]], {}, "category 0, but"),
        ([[*BOX, 1.5, 0.9]], {}, "category 1.5, but"),
        ([[*BOX, np.nan, 0.9]], {}, "category nan, but"),
        ([BOX], {}, r"gt_boxes \[1, 7\]; expected \[n, 9\]"),
        ([[*BOX, 1]], {}, "has neither a ninth column of scores nor cls_scores"),
        ([[*BOX, 1, 1.5]], {}, "scores up to 1.5 are not in"),
        ([[*BOX, 1, 0.5]], {"iou_scores": [0.5, 0.5]}, "iou_scores are not 1 numbers from 0 to 1"),
        ([["a"] * 9], {}, "gt_boxes must be numbers"),
    ],
)
def test_impossible_pseudo_labels_are_rejected(tmp_path, rows, more, message):
    """With file and frame."""
    path = write(tmp_path / "a.pkl", rows, **more)
    with pytest.raises(DataError, match=message) as caught:
        read(path)
    assert "frame 000001: " in str(caught.value)


def test_classes_are_needed(tmp_path):
    """The numbers have no names in the file."""
    with pytest.raises(ConfigError, match=r"set detector\.options\.classes in the order"):
        read(write(tmp_path / "a.pkl", [[*BOX, 1, 0.9]]), classes=())


def test_other_pickles_are_rejected(tmp_path):
    """A dict of something else, or a list where the kind is declared."""
    for content in ({}, {"a": 1}, [{"gt_boxes": []}]):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
        with pytest.raises(DataError, match=r"a\.pkl"):
            RecordedDetector(tmp_path / "a.pkl", classes=CLASSES)
    with pytest.raises(DataError, match="not ST3D's pseudo-labels; expected a dict of frames"):
        RecordedDetector(tmp_path / "a.pkl", classes=CLASSES, kind="st3d")


def test_our_own_export_is_read_back(tmp_path):
    """As float32; labels of weight 0 that are regions to ignore come back with `keep`."""
    labels = toy_labels()
    ST3DExporter().write(tmp_path / "labels", labels)
    path = tmp_path / "labels" / "ps_label_e0.pkl"
    classes = labels.description.categories
    record = RecordedDetector(path, classes=classes, ignored="keep")
    assert record.frame_ids() == ("000001",)
    found = record.predict(empty_frame("000001"))
    assert found.categories.tolist() == list(CATEGORIES)
    np.testing.assert_allclose(found.boxes, BOXES, rtol=1e-6)
    np.testing.assert_allclose(found.scores, SCORES, rtol=1e-6)
