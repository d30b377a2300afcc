"""Tests of saved semantic maps."""

import cv2
import numpy as np
import pytest
from toys import toy_calibration

from curate.errors import ConfigError, DataError
from curate.frames import Frame
from curate.segmenters.saved import SavedSegmenter

FRAME = Frame("000001", np.zeros((0, 4), np.float32), toy_calibration(), (12, 5))
CLASSES = {"Car": (7,)}


def save(directory, class_ids):
    """A map of the frame."""
    cv2.imwrite(str(directory / "000001.png"), class_ids)


def test_reads_the_map_of_a_frame(tmp_path):
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
        (np.zeros((5, 11), np.uint8), "the map is 11 x 5 pixels, the image of the frame 12 x 5"),
        (np.zeros((5, 12, 3), np.uint8), "expected one channel of 8 bits"),
        (np.zeros((5, 12), np.uint16), "expected one channel of 8 bits"),
    ],
)
def test_a_map_that_does_not_fit_is_refused(tmp_path, class_ids, message):
    """Wrong size, colours or depth: the error names the file."""
    save(tmp_path, class_ids)
    with pytest.raises(DataError, match=message) as caught:
        SavedSegmenter(tmp_path, CLASSES).segment(FRAME)
    assert "000001.png" in str(caught.value)


def test_missing_and_unreadable_maps_are_named(tmp_path):
    """No map, bytes that are none, and no folder."""
    segmenter = SavedSegmenter(tmp_path, CLASSES)
    with pytest.raises(DataError, match=r"000001\.png: no such image file"):
        segmenter.segment(FRAME)
    (tmp_path / "000001.png").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"000001\.png: no readable image"):
        segmenter.segment(FRAME)
    with pytest.raises(DataError, match="no such folder of semantic maps"):
        SavedSegmenter(tmp_path / "missing", CLASSES)
    with pytest.raises(ConfigError, match="an id is 0 to 255"):
        SavedSegmenter(tmp_path, {"Car": (300,)})
