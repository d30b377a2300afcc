"""One property for every editor: a box that nobody moved comes back where it was."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from oracles.camera_boxes import in_camera
from support.reviews import shown
from support.rigs import NAMES, Rig, assert_equal_boxes, detections, rigs

from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.labels import read_objects
from curate.detections import Detections
from curate.frames import Frame
from curate.review.sheet import Sheet, ShownFrame
from pipelines.registry import EDITORS


def sheet_of(found: Detections, editor: str) -> Sheet:
    """Return the detections as boxes under review."""
    boxes = tuple(
        shown(name, tuple(box), k)
        for k, (name, box) in enumerate(
            zip(found.categories.tolist(), found.boxes.tolist(), strict=True)
        )
    )
    return Sheet(1, "pspsl", editor, NAMES, (ShownFrame("000001", boxes),))


@pytest.mark.parametrize("name", sorted(EDITORS.classes))
@settings(max_examples=20)
@given(found=detections, rig=rigs)
def test_untouched_boxes_come_back(name: str, found: Detections, rig: Rig) -> None:
    """Whatever frame of reference the editor has, and whatever the mounting of the camera."""
    editor = EDITORS.build(name, offered={}, options={})
    sheet = sheet_of(found, name)

    def read(frame_id: str) -> Frame:
        return rig.frame(frame_id)

    with tempfile.TemporaryDirectory() as folder:
        editor.write(Path(folder), sheet, read)
        back = editor.read(Path(folder), sheet, read)["000001"]
    assert [each.category for each in back] == found.categories.tolist()
    assert_equal_boxes(np.array([each.box for each in back]), found.boxes, 1e-4)


@settings(max_examples=20)
@given(found=detections, rig=rigs)
def test_kitti_files_for_review_are_in_the_camera_frame(found: Detections, rig: Rig) -> None:
    """As computed with scipy, with the calibration that belongs to them."""
    editor = EDITORS.build("kitti", offered={}, options={})
    with tempfile.TemporaryDirectory() as folder:
        editor.write(Path(folder), sheet_of(found, "kitti"), rig.frame)
        objects = read_objects(Path(folder) / "label_2" / "000001.txt")
        calibration = read_calibration(Path(folder) / "calib" / "000001.txt")
    bottoms, rotations_y = in_camera(
        found.boxes, rig.turn, np.array(rig.origin), rig.yaw, upside_down=rig.upside_down
    )
    np.testing.assert_allclose(objects.locations, bottoms, atol=1e-4)
    turned = np.sin((objects.rotations_y - rotations_y) / 2)
    np.testing.assert_allclose(turned, 0, atol=1e-4)
    np.testing.assert_array_equal(calibration.lidar_to_camera, rig.calibration.lidar_to_camera)
