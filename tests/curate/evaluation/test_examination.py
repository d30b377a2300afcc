"""The checks of one frame."""

from dataclasses import replace

import numpy as np
import pytest
from support.toys import toy_calibration

from curate.datasets.kitti.dataset import KittiDataset
from curate.detections import CATEGORIES, Detections, as_categories
from curate.detectors.recorded import RecordedDetector
from curate.evaluation.examination import examine_detections, examine_frame
from curate.frames import Frame
from curate.geometry.projection import in_view

BOXES = np.array([
    [12.0, 4.0, -0.8, 3.9, 1.6, 1.5, 0.5],
    [20.0, -5.0, -0.8, 4.1, 1.7, 1.6, -0.7],
    [25.0, 2.0, -0.8, 4.0, 1.6, 1.5, 2.0],
])  # fmt: skip

QUARTER = np.array([0, 0, 0, 0, 0, 0, np.pi / 2])


def street(boxes=BOXES, seed=0):
    """Return a frame with points in boxes and on the ground."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform([2, -20], [40, 20], (2000, 2)), np.full(2000, -1.6)])
    points = [ground]
    for box in boxes:
        inside = rng.uniform(-0.5, 0.5, (80, 3)) * box[3:6]
        cos, sin = np.cos(box[6]), np.sin(box[6])
        inside[:, :2] = inside[:, :2] @ np.array([[cos, sin], [-sin, cos]])
        points.append(inside + box[:3])
    cloud = np.concatenate(points)
    cloud = np.column_stack([cloud, np.full(len(cloud), 0.4)]).astype(np.float32)
    return Frame("000001", cloud, toy_calibration(), (120, 40))


def detections(boxes, names=("Car", "Car", "Car")):
    """Return detections."""
    return Detections(np.array(boxes), np.linspace(0.9, 0.5, len(boxes)), as_categories(names))


def states(frame, found):
    """Return the state of each check."""
    return {one.check: one.state for one in examine_detections(frame, found, CATEGORIES)}


def convention(frame, found, boxes):
    """Return the message of the convention check for other boxes."""
    found = examine_detections(frame, replace(found, boxes=boxes), CATEGORIES)
    return next(one for one in found if one.check == "convention")


def test_a_correct_frame_passes():
    """Every check, of data and of boxes."""
    frame = street()
    assert {one.state for one in examine_frame(frame)} == {"ok"}
    assert set(states(frame, detections(BOXES)).values()) == {"ok"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: b + QUARTER, "turned by 90 degrees"),
        (lambda b: b[:, [0, 1, 2, 4, 3, 5, 6]], "turned by 90 degrees"),
        (lambda b: b * [1, 1, 1, 1, 1, 1, -1], "yaw is negated"),
        (lambda b: b * [1, 1, 1, 1, 1, 1, -1] - [0, 0, 0, 0, 0, 0, np.pi / 2], "rotation_y"),
        (lambda b: b - b[:, 5:6] / 2 * [0, 0, 1, 0, 0, 0, 0], "z is the bottom of the box"),
        (lambda b: b + b[:, 5:6] / 2 * [0, 0, 1, 0, 0, 0, 0], "z is the top of the box"),
        (
            lambda b: np.column_stack(
                [-b[:, 1], -b[:, 2] + b[:, 5] / 2, b[:, 0], b[:, 3:6], -b[:, 6] - np.pi / 2]
            ),
            "converted from the camera frame",
        ),
    ],
)
def test_a_wrong_convention_is_reported(change, message):
    """Each of the common ones."""
    finding = convention(street(), detections(BOXES), change(BOXES))
    assert finding.state == "wrong"
    assert message in finding.message


def test_names_points_and_projections_are_checked():
    """All wrong, some wrong."""
    frame = street()
    assert states(frame, detections(BOXES, ("car",) * 3))["names"] == "wrong"
    assert states(frame, detections(BOXES, ("Car", "Car", "Van")))["names"] == "suspect"
    far = BOXES + np.array([200, 0, 0, 0, 0, 0, 0])
    assert states(frame, detections(far))["boxes"] == "wrong"
    assert states(frame, detections(BOXES * [-1, 1, 1, 1, 1, 1, 1]))["image"] == "wrong"
    mixed = np.vstack([BOXES[:1], far[:2]])
    assert states(frame, detections(mixed))["boxes"] == "suspect"
    assert states(frame, Detections.empty()) == {"detections": "suspect"}


def test_impossible_data_is_reported():
    """No points, a camera that looks elsewhere, intensities of 255, z not up."""
    frame = street()
    assert [one.state for one in examine_frame(frame.with_points(frame.points[:0]))] == ["wrong"]
    behind = frame.with_points(frame.points * np.float32([-1, 1, 1, 1]))
    assert {one.check: one.state for one in examine_frame(behind)}["calibration"] == "wrong"
    bright = frame.with_points(frame.points * np.float32([1, 1, 1, 255]))
    assert {one.check: one.state for one in examine_frame(bright)}["intensity"] == "suspect"
    upright = frame.with_points(frame.points[:, [2, 1, 0, 3]])
    upright = replace(upright, points=upright.points * np.float32([1, 0.1, 1, 1]))
    assert {one.check: one.state for one in examine_frame(upright)}["points"] == "suspect"


@pytest.mark.kitti
def test_real_boxes_pass_and_wrong_ones_fail(kitti_root):
    """A weak detector's cars on real sweeps: correct, rotated, too low and too high."""
    dataset = KittiDataset(kitti_root)
    record = RecordedDetector(kitti_root / "recorded" / "pointgnn_T0.csv")
    changes = {
        "right": lambda boxes: boxes,
        "turned": lambda boxes: boxes + QUARTER,
        "bottom": lambda boxes: boxes - boxes[:, 5:6] * np.array([0, 0, 0.5, 0, 0, 0, 0]),
        "high": lambda boxes: boxes + boxes[:, 5:6] * np.array([0, 0, 0.5, 0, 0, 0, 0]),
    }
    messages = {name: [] for name in changes}
    for name in record.frame_ids():
        frame = dataset.read(name)
        frame = frame.with_points(
            frame.points[in_view(frame.points, frame.calibration, frame.image_size)]
        )
        found = record.predict(frame)
        for what, change in changes.items():
            if len(found) >= 3:
                messages[what].append(convention(frame, found, change(found.boxes)))
    assert len(messages["right"]) >= 12
    assert {one.state for one in messages["right"]} == {"ok"}
    assert all(
        "90 degrees" in one.message or "rotation_y" in one.message for one in messages["turned"]
    )
    assert np.mean(["bottom" in one.message for one in messages["bottom"]]) > 0.75
    assert np.mean(["top of the box" in one.message for one in messages["high"]]) > 0.65
