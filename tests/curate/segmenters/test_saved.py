"""Saved semantic maps."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.toys import toy_calibration

from curate.errors import ConfigError, DataError, ModelError
from curate.frames import Frame
from curate.segmenters.classes import class_map
from curate.segmenters.saved import SavedSegmenter

FRAME = Frame("000001", np.zeros((0, 4), np.float32), toy_calibration(), (12, 5))
CLASSES = {"Car": (7,)}


def save(directory, class_ids):
    """Save a map of the frame."""
    cv2.imwrite(str(directory / "000001.png"), class_ids)


def test_it_reads_the_map_of_a_frame(tmp_path):
    """The pixels of the PNG are the class ids; the image is not needed."""
    class_ids = np.random.default_rng(0).integers(0, 255, (5, 12), dtype=np.uint8)
    save(tmp_path, class_ids)
    segmenter = SavedSegmenter(tmp_path, CLASSES)
    found = segmenter.segment(FRAME)
    np.testing.assert_array_equal(found.class_ids, class_ids)
    assert found.category_classes == CLASSES
    assert not segmenter.needs_image


@pytest.mark.parametrize(
    ("class_ids", "message"),
    [
        (np.zeros((5, 11), np.uint8), "the map is 11 x 5 pixels, the image of the frame is 12 x 5"),
        (np.zeros((5, 12, 3), np.uint8), "expected one channel of 8 bits"),
        (np.zeros((5, 12), np.uint16), "expected one channel of 8 bits"),
    ],
)
def test_a_map_that_does_not_fit_is_rejected(tmp_path, class_ids, message):
    """Wrong size, colours or depth: the error contains the file."""
    save(tmp_path, class_ids)
    with pytest.raises(DataError, match=message) as caught:
        SavedSegmenter(tmp_path, CLASSES).segment(FRAME)
    assert "000001.png" in str(caught.value)


def test_instance_ids_are_divided_by_the_divisor(tmp_path):
    """Cityscapes' instanceIds: class * 1000 + instance, classes without instances as they are."""
    values = np.array([26001, 26999, 24000, 7, 255, 33001], np.uint16)
    save(tmp_path, np.tile(values, (5, 2)))
    classes = class_map("cityscapes-label-ids")
    found = SavedSegmenter(tmp_path, classes, divisor=1000).segment(FRAME)
    assert found.class_ids.dtype == np.uint8
    assert found.class_ids[0, :6].tolist() == [26, 26, 24, 7, 255, 33]
    with pytest.raises(DataError, match="class 330 with divisor 100"):
        SavedSegmenter(tmp_path, classes, divisor=100).segment(FRAME)
    with pytest.raises(ConfigError, match="divisor 1: expected an integer above 1"):
        SavedSegmenter(tmp_path, classes, divisor=1)


@pytest.mark.parametrize(
    ("declared", "present", "message"),
    [
        (
            "cityscapes",
            26,
            "class 26, .* cityscapes are 0 to 18; .* uses cityscapes-label-ids",
        ),
        ("voc", 33, "class 33, .* voc are 0 to 20; .* uses cityscapes-label-ids"),
        (
            "simulated",
            13,
            "class 13, .* simulated are 0 to 3; .* uses voc or cityscapes or",
        ),
        ("cityscapes-label-ids", 90, "class 90, .* cityscapes-label-ids are 0 to 33$"),
    ],
)
def test_maps_of_another_class_set_are_rejected(tmp_path, declared, present, message):
    """Cityscapes' label ids read as train ids would make every car a bus or nothing."""
    class_ids = np.zeros((5, 12), np.uint8)
    class_ids[0, :2] = present, 255
    save(tmp_path, class_ids)
    with pytest.raises(DataError, match=message):
        SavedSegmenter(tmp_path, class_map(declared)).segment(FRAME)
    assert SavedSegmenter(tmp_path, class_map("coco")).segment(FRAME).class_ids[0, 0] == present


def test_missing_and_unreadable_maps_are_reported(tmp_path):
    """No map, invalid bytes, and no folder."""
    segmenter = SavedSegmenter(tmp_path, CLASSES)
    with pytest.raises(DataError, match=r"000001\.png: no such image file"):
        segmenter.segment(FRAME)
    (tmp_path / "000001.png").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"000001\.png: not a readable PNG or JPEG image"):
        segmenter.segment(FRAME)
    with pytest.raises(DataError, match="no such folder of semantic maps"):
        SavedSegmenter(tmp_path / "missing", CLASSES)
    with pytest.raises(ConfigError, match="an id is an integer from 0 to 255"):
        SavedSegmenter(tmp_path, {"Car": (300,)})


@pytest.mark.parametrize("name", ["1.png", "0001.png", "000001.PNG", "sub/000001.png"])
def test_maps_are_matched_with_frames_in_every_spelling(tmp_path, name):
    """A number, other leading zeros, a subfolder."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    cv2.imwrite(str(tmp_path / name), np.full((5, 12), 7, np.uint8))
    found = SavedSegmenter(tmp_path, CLASSES, frame_ids=("000000", "000001")).segment(FRAME)
    assert (found.class_ids == 7).all()


def test_maps_of_no_frame_are_rejected(tmp_path):
    """When the segmenter is opened, with the nearest frames."""
    save(tmp_path, np.zeros((5, 12), np.uint8))
    message = r"such as '000001\.png'; the nearest are '0000\d\d' and"
    with pytest.raises(DataError, match=message):
        SavedSegmenter(tmp_path, CLASSES, frame_ids=("000010", "000021"))


def test_several_cameras_have_a_folder_each(tmp_path):
    """The map of a camera is not taken for that of another, nor for that of the only one."""
    for i, camera in enumerate(("front", "back"), start=1):
        (tmp_path / camera).mkdir()
        save(tmp_path / camera, np.full((5, 12), i, np.uint8))
    segmenter = SavedSegmenter(tmp_path, CLASSES)
    assert segmenter.segment(replace(FRAME, camera="front")).class_ids.max() == 1
    assert segmenter.segment(replace(FRAME, camera="back")).class_ids.min() == 2
    with pytest.raises(DataError, match=r"000001\.png: no such image"):
        segmenter.segment(FRAME)
    with pytest.raises(ModelError, match="000001 has no camera"):
        segmenter.segment(replace(FRAME, image_size=None, camera="front"))
