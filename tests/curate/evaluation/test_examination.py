"""The checks of one frame."""

from dataclasses import replace

import numpy as np
import pytest
from support.rigs import FORWARD, LEFT, TILTED, UPSIDE_DOWN, Rig
from support.toys import toy_calibration

from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.labels import from_annotations, to_annotations
from curate.detections import CATEGORIES, Annotations, Detections, as_categories
from curate.detectors.recorded import RecordedDetector
from curate.evaluation.camera_examination import examine_camera
from curate.evaluation.examination import examine_detections, examine_frame
from curate.evaluation.label_examination import examine_labels
from curate.frames import Calibration, Frame
from curate.geometry.projection import image_rectangles, in_view

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
    assert {one.state for one in [*examine_frame(frame), *examine_camera(frame)]} == {"ok"}
    assert set(states(frame, detections(BOXES)).values()) == {"ok"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: b + QUARTER, "turned by 90 degrees"),
        (
            lambda b: b[:, [0, 1, 2, 4, 3, 5, 6]],
            "length and width are swapped: Car boxes are 1.6 m",
        ),
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
        (
            lambda b: np.column_stack(
                [b[:, 2] - b[:, 5] / 2, -b[:, 0], -b[:, 1], b[:, 3:6], -b[:, 6] - np.pi / 2]
            ),
            "read in the LiDAR frame: location and rotation_y of their files are in the LiDAR",
        ),
    ],
)
def test_a_wrong_convention_is_reported(change, message):
    """Each of the common ones."""
    finding = convention(street(), detections(BOXES), change(BOXES))
    assert finding.state == "wrong"
    assert message in finding.message


@pytest.mark.parametrize(
    ("order", "message"),
    [
        ([4, 3, 5], "length and width are swapped: Car boxes are 1.6 m long, 4.0 m wide and 1.5 m"),
        ([5, 3, 4], "length and width are swapped: Car boxes are 1.5 m long, 4.0 m wide and 1.6 m"),
        ([3, 5, 4], "height and width are swapped: Pedestrian boxes are 0.8 m long, 1.7 m wide"),
    ],
)
def test_sizes_in_another_order_are_reported(order, message):
    """Some orders show in cars, others only in pedestrians."""
    boxes = np.vstack([BOXES, [[15.0, 0, -0.8, 0.8, 0.6, 1.7, 0.2]]])
    boxes = boxes[:, [0, 1, 2, *order, 6]]
    found = detections(boxes, ("Car", "Car", "Car", "Pedestrian"))
    finding = convention(street(), found, boxes)
    assert (finding.state, message in finding.message) == ("wrong", True), finding.message


def test_a_detector_that_curate_trains_has_no_other_convention():
    """Boxes beside the points come from its weights, or from other data than it was trained on."""
    raised = detections(BOXES - BOXES[:, 5:6] / 2 * [0, 0, 1, 0, 0, 0, 0])
    found = examine_detections(street(), raised, CATEGORIES, trainable=True)
    assert (found[-1].check, found[-1].state) == ("placement", "suspect")
    assert "hardly been trained, or for another LiDAR" in found[-1].message
    found = examine_detections(street(), detections(BOXES), CATEGORIES, trainable=True)
    assert {each.state for each in found} == {"ok"}


def test_more_frames_decide_where_one_cannot():
    """Boxes along the street look the same if their yaw is negated."""
    straight = BOXES * [1, 1, 1, 1, 1, 1, 0]
    negated = BOXES * [1, 1, 1, 1, 1, 1, -1]
    alone = examine_detections(street(straight), detections(straight), CATEGORIES)
    assert alone[-1].state == "ok"
    others = [(street(seed=seed), detections(negated)) for seed in (1, 2)]
    found = examine_detections(street(straight), detections(straight), CATEGORIES, others)
    assert found[-1].state == "wrong"
    assert "with the highest scores of 3 frames" in found[-1].message


def test_a_turn_that_points_cannot_show_is_not_reported():
    """Narrow boxes gain and lose points at random if they are turned by one degree."""
    cos, sin = np.cos(np.radians(1)), np.sin(np.radians(1))
    turned = np.array([[cos, sin, 0, 0], [-sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    calibration = toy_calibration()
    calibration = replace(calibration, lidar_to_camera=calibration.lidar_to_camera @ turned)
    frame = replace(street(), calibration=calibration)
    boxes = BOXES + np.array([0, 0, 0, 0, 0, 0, np.radians(1)])
    boxes[:, 4] *= 0.3
    finding = checks([(frame, labels(boxes, frame))])["label boxes"]
    assert "turned by the yaw of the camera" not in finding.message


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
    for factor in (0, 1 / 255):
        dark = frame.with_points(frame.points * np.float32([1, 1, 1, factor]))
        found = {one.check: one for one in examine_frame(dark)}["intensity"]
        assert found.state == "suspect"
        assert ("dataset.intensity_scale" in found.message) == (factor > 0)
    upright = frame.with_points(frame.points[:, [2, 1, 0, 3]])
    upright = replace(upright, points=upright.points * np.float32([1, 0.1, 1, 1]))
    assert {one.check: one.state for one in examine_frame(upright)}["points"] == "suspect"


def labels(boxes, frame=None):
    """Return annotations with the 2D boxes of correct ones."""
    count = len(boxes)
    frame = frame or street()
    rectangles = image_rectangles(BOXES, frame.calibration, frame.image_size)
    return Annotations(
        np.array(boxes),
        as_categories(["Car"] * count),
        np.zeros(count),
        np.zeros(count, dtype=np.int64),
        np.zeros(count),
        rectangles[:count],
    )


def checks(labeled):
    """Return the finding of each check of labels."""
    return {one.check: one for one in examine_labels(labeled)}


def test_correct_labels_pass():
    """Of one frame and of several."""
    for labeled in ([(street(), labels(BOXES))], [(street(), labels(BOXES))] * 3):
        found = checks(labeled)
        assert list(found) == ["labels", "label boxes", "label image"]
        assert {one.state for one in found.values()} == {"ok"}
    assert "labeled boxes of 3 frames" in found["label boxes"].message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda o: {"dimensions": o.dimensions[:, [0, 2, 1]]}, "length and width are swapped"),
        (
            lambda o: {"locations": o.locations - o.dimensions[:, :1] / 2 * [0, 1, 0]},
            "lowered by half their height: their location is the centre of the box",
        ),
        (
            lambda o: {"locations": o.locations + o.dimensions[:, :1] / 2 * [0, 1, 0]},
            "raised by half their height: their location is too low",
        ),
        (lambda o: {"rotations_y": o.rotations_y + np.pi / 2}, "turned by 90 degrees"),
        (lambda o: {"rotations_y": -o.rotations_y - np.pi}, "yaw is negated"),
    ],
    ids=["swapped", "centre", "low", "turned", "negated"],
)
def test_labels_in_a_wrong_convention_are_reported(change, message):
    """As a converter writes them to KITTI's files."""
    frame = street()
    objects = from_annotations(labels(BOXES), frame.calibration)
    wrong = to_annotations(replace(objects, **change(objects)), frame.calibration)
    found = checks([(frame, wrong)])["label boxes"]
    assert found.state == "wrong"
    assert message in found.message


@pytest.mark.parametrize(
    ("read", "written"), [("calibration", "openpcdet"), ("mmdetection3d", "calibration")]
)
def test_another_meaning_of_rotation_y_is_reported(read, written):
    """The camera looks aside, and the data set declares the wrong meaning."""
    aside = replace(Rig(yaw=0.6).calibration, rotation_y=read)
    frame = replace(street(), calibration=aside)
    objects = from_annotations(labels(BOXES), replace(aside, rotation_y=written))
    found = checks([(frame, to_annotations(objects, aside))])["label boxes"]
    assert found.state == "wrong"
    assert "turned by the yaw of the camera: rotation_y has another meaning" in found.message
    right = replace(aside, rotation_y=written)
    frame = replace(frame, calibration=right)
    assert checks([(frame, to_annotations(objects, right))])["label boxes"].state == "ok"


@pytest.mark.parametrize(("yaw_degrees", "state"), [(107, "wrong"), (20, "wrong"), (1, "ok")])
def test_another_meaning_of_rotation_y_of_results_is_reported(yaw_degrees, state):
    """OpenPCDet's result files, read with the meaning of the calibration."""
    aside = Rig(yaw=np.deg2rad(yaw_degrees)).calibration
    objects = from_annotations(labels(BOXES), replace(aside, rotation_y="openpcdet"))
    boxes = to_annotations(objects, aside).boxes
    finding = convention(replace(street(), calibration=aside), detections(BOXES), boxes)
    assert finding.state == state
    assert ("set detector.options.rotation_y" in finding.message) == (state == "wrong")


def test_labels_without_points_are_reported():
    """All of them, or many; a single one may be hidden."""
    frame, far = street(), BOXES + np.array([60, 0, 0, 0, 0, 0, 0])
    found = checks([(frame, labels(far))])["labels"]
    assert found.state == "wrong"
    assert found.message.startswith("3 of 3 labeled boxes contain no points (frame 000001): do ")
    assert checks([(frame, labels([BOXES[0], far[1], far[2]]))])["labels"].state == "suspect"
    assert checks([(frame, labels([BOXES[0], BOXES[1], far[2]]))])["labels"].state == "ok"
    assert checks([(frame, Annotations.empty())])["labels"].message.startswith("no labeled objects")


def scaled(factor):
    """Return the calibration of an image that is larger by a factor."""
    toy = toy_calibration()
    return Calibration(np.diag([factor, factor, 1]) @ toy.projection, toy.lidar_to_camera)


def test_labels_of_an_image_of_another_size_are_reported():
    """The image was reduced after the labeling, or only the calibration was scaled."""
    frame = street()
    small = replace(frame, image_size=(60, 20))
    found = checks([(small, labels(BOXES))])["label image"]
    assert found.state == "wrong"
    assert "the image is 60 x 20: was it resized after it was labeled?" in found.message
    large = replace(frame, calibration=scaled(8), image_size=(960, 320))
    assert (
        "2D boxes are 1.00 times" in checks([(large, labels(BOXES, large))])["label image"].message
    )
    close = [(replace(large, calibration=scaled(4)), labels(BOXES, large))]
    found = checks(close)["label image"]
    assert found.state == "suspect"
    assert "2D boxes are 2.0" in found.message
    placeholders = replace(labels(BOXES), boxes_2d=np.tile([0.0, 0, 50, 30], (3, 1)))
    found = checks([(close[0][0], placeholders)])["label image"]
    assert found.state == "suspect"
    assert found.message.startswith("all 3 2D boxes are 0 0 50 30, a placeholder: difficulty, ")
    nothing = replace(labels(BOXES), boxes_2d=np.zeros((3, 4)))
    assert checks([(large, nothing)])["label image"].message.startswith("no 2D boxes; the proj")
    aside = labels(BOXES, large)
    aside = replace(aside, boxes_2d=aside.boxes_2d + np.array([200, 0, 200, 0]))
    found = checks([(replace(large, image_size=(1200, 320)), aside)])["label image"]
    assert found.state == "suspect"
    assert "but their IoU is only 0." in found.message


@pytest.mark.parametrize(
    ("size", "state"),
    [((120, 40), "ok"), ((60, 20), "wrong"), ((240, 80), "wrong"), ((96, 32), "suspect"),
     ((120, 30), "ok"), ((150, 44), "ok"), ((50, 40), "suspect")],
)  # fmt: skip
def test_an_image_of_another_scale_than_the_calibration_is_reported(size, state):
    """Half, double, 80 percent; a cropped image keeps its scale, unless the crop is odd."""
    found = {one.check: one for one in examine_camera(replace(street(), image_size=size))}["scale"]
    assert found.state == state
    assert f"principal point (60, 20) in an image of {size[0]} x {size[1]}" in found.message
    assert ("was the image resized" in found.message) == (state != "ok")


@pytest.mark.parametrize("rig", [FORWARD, TILTED, LEFT, UPSIDE_DOWN])
def test_the_mounting_and_the_heights_are_shown(rig):
    """The LiDAR is 1.6 m above the ground of the street, the camera elsewhere."""
    frame = replace(street(), calibration=rig.calibration)
    found = {one.check: one for one in examine_camera(frame)}["camera"]
    yaw, pitch, roll = np.rad2deg([rig.yaw, rig.pitch, rig.roll])
    height = 1.6 + rig.turn.inv().apply(-np.array(rig.origin))[2]
    assert found.state == "ok"
    assert found.message == (
        f"yaw {yaw:.1f}, pitch {pitch:.1f}, roll {roll:.1f} degrees against the LiDAR; "
        f"{height:.2f} m above the ground, the LiDAR 1.60 m"
    )


def test_a_camera_that_looks_down_is_suspect():
    """rotation_y is not a heading there; without ground nearby its height is unknown."""
    frame = replace(street(), calibration=Rig(pitch=1.55).calibration)
    far = frame.with_points(frame.points[frame.points[:, 0] > 20])
    found = {one.check: one for one in examine_camera(far)}["camera"]
    assert found.state == "suspect"
    assert "no ground found near it: KITTI's rotation_y is undefined" in found.message


@pytest.mark.kitti
def test_real_labels_pass(kitti_root):
    """Every frame by itself and five at a time."""
    dataset = KittiDataset(kitti_root)
    labeled = [(dataset.read(name), dataset.annotations(name)) for name in dataset.frame_ids()]
    fives = [labeled[i : i + 5] for i in range(0, 20, 5)]
    for group in [[each] for each in labeled] + fives:
        found = [*examine_frame(group[0][0]), *examine_camera(group[0][0]), *examine_labels(group)]
        assert {one.state for one in found} == {"ok"}, found
    half = np.array([0, 0, 1, 0, 0, 0, 0])
    changes = {
        "length and width are swapped": lambda b: b[:, [0, 1, 2, 4, 3, 5, 6]],
        "turned by 90 degrees": lambda b: b + QUARTER,
        "raised by half their height": lambda b: b - b[:, 5:6] / 2 * half,
        "lowered by half their height": lambda b: b + b[:, 5:6] / 2 * half,
    }
    for message, change in changes.items():
        for group in fives:
            wrong = [(frame, replace(truth, boxes=change(truth.boxes))) for frame, truth in group]
            assert message in examine_labels(wrong)[1].message
    mirrored = [(f, replace(t, boxes=t.boxes * [1, 1, 1, 1, 1, 1, -1])) for f, t in labeled]
    assert "yaw is negated" in examine_labels(mirrored)[1].message


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
