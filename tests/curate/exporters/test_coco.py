"""Weighted labels as COCO annotations."""

import json

import numpy as np
import pytest
from support.exported import SCORES, WEIGHTS, toy_labels

from curate.exporters.coco import CocoExporter


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
