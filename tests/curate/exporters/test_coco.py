"""Weighted labels as COCO annotations."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.exported import SCORES, WEIGHTS, toy_frame, toy_labels
from support.toys import toy_calibration

from curate.errors import ConfigError
from curate.exporters.coco import CocoExporter
from curate.frames import Camera


def written(path, labels):
    """Return what a reader of the file gets."""
    CocoExporter().write(path, labels)
    return json.loads(path.read_text())


@pytest.fixture
def document(tmp_path):
    """Return the document with labels of weight 0 as ignored."""
    return written(tmp_path / "labels.json", toy_labels())


def of_image(document, frame):
    """Return the annotations of a frame's image."""
    image = next(image for image in document["images"] if image["frame"] == frame)
    return [each for each in document["annotations"] if each["image_id"] == image["id"]]


def test_ids_are_unique_and_references_exist(document):
    """Counted from 1, as COCO's own."""
    assert [each["id"] for each in document["annotations"]] == [1, 2, 3, 4, 5]
    assert [image["file_name"] for image in document["images"]] == [
        "image_2/000000.png", "image_2/000001.png",
    ]  # fmt: skip
    names = {each["id"]: each["name"] for each in document["categories"]}
    assert names == {1: "Car", 2: "Pedestrian", 3: "Cyclist", 4: "Van"}


def test_a_box_is_the_rectangle_around_its_corners(document):
    """An upright box straight ahead, by hand: the near face is the larger."""
    car = of_image(document, "000000")[0]
    # 10 m ahead, 4 m long: the near face at 8 m; 60 pixels of focal length about (60, 20).
    left, right = 60 - 60 * 0.9 / 8, 60 + 60 * 0.9 / 8
    top, bottom = 20 + 60 * 0.0 / 8, 20 + 60 * 1.6 / 8
    assert car["bbox"] == pytest.approx([left, top, right - left, bottom - top])
    assert car["area"] == pytest.approx(car["bbox"][2] * car["bbox"][3])
    assert (car["weight"], car["iscrowd"], "score" in car) == (1.0, 0, False)


def test_background_labels_are_not_annotations(tmp_path):
    """They are stored in a list of their own, which COCO's readers ignore; the info explains it."""
    document = written(tmp_path / "labels.json", toy_labels(zero_weight="background"))
    assert document["info"]["zero_weight"] == "background"
    labels = of_image(document, "000001")
    assert [each["weight"] for each in labels] == [WEIGHTS[0], WEIGHTS[2]]
    assert [each["iscrowd"] for each in labels] == [0, 1]  # the latter is not visible
    [left_out] = document["background"]
    assert (left_out["k"], left_out["weight"], left_out["iscrowd"]) == (1, 0.0, 0)
    assert [each["id"] for each in document["annotations"]] == [1, 2, 3, 4]


def test_weights_and_scores_are_stored_and_weight_0_is_a_crowd(document):
    """COCO ignores crowds; invisible labels have no size."""
    assert document["info"]["zero_weight"] == "ignore"
    assert document["background"] == []
    labels = of_image(document, "000001")
    assert [each["weight"] for each in labels] == list(WEIGHTS)
    assert [each["score"] for each in labels] == list(SCORES)
    assert [each["iscrowd"] for each in labels] == [0, 1, 1]
    assert labels[2]["bbox"] == [0, 0, 0, 0]
    assert np.all([each["area"] > 0 for each in labels[:2]])


def test_every_camera_has_an_image_with_the_labels_that_it_shows(tmp_path):
    """A label outside all images is with the first one, so that no label is lost."""
    labels = toy_labels(zero_weight="ignore")
    turned = toy_calibration().lidar_to_camera @ np.diag([-1.0, -1, 1, 1])

    def read(name):
        frame = toy_frame(name)
        back = Camera("back", replace(frame.calibration, lidar_to_camera=turned), (120, 40))
        return frame.with_cameras([Camera("front", frame.calibration, (120, 40)), back])

    frames = [replace(each, further_images=(f"back/{each.frame}.png",)) for each in labels.frames]
    document = written(tmp_path / "a.json", replace(labels, frames=frames, read=read))
    assert [(image["camera"], image["file_name"]) for image in document["images"]] == [
        ("front", "image_2/000000.png"), ("back", "back/000000.png"),
        ("front", "image_2/000001.png"), ("back", "back/000001.png"),
    ]  # fmt: skip
    one = written(tmp_path / "b.json", labels)
    camera_of = {image["id"]: image["camera"] for image in document["images"]}
    front = [each for each in document["annotations"] if camera_of[each["image_id"]] == "front"]
    seen = [each["bbox"] for each in one["annotations"] if each["area"] > 0]
    assert [each["bbox"] for each in front] == seen
    assert len(seen) < len(one["annotations"]) == len(document["annotations"])
    assert all(
        each["area"] > 0
        for each in document["annotations"]
        if camera_of[each["image_id"]] == "back"
    )


def test_a_data_set_without_images_is_rejected(tmp_path):
    """The message names a frame and other formats; nothing is written."""
    labels = toy_labels()
    frames = [replace(each, image=None) for each in labels.frames]
    with pytest.raises(ConfigError, match="frame 000000: COCO's annotations need images"):
        CocoExporter().write(tmp_path / "a.json", replace(labels, frames=frames))
    assert not (tmp_path / "a.json").exists()
