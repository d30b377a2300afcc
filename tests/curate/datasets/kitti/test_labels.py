"""KITTI's label format and its conversion to the LiDAR frame."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.rigs import TILTED, Rig, rigs
from support.toys import toy_calibration

from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.labels import (
    KittiObjects,
    from_annotations,
    from_detections,
    read_annotations,
    read_objects,
    to_annotations,
    to_detections,
    write_objects,
)
from curate.detections import Annotations, Detections, as_categories
from curate.errors import DataError
from curate.frames import calibration_without_camera
from curate.geometry.overlap import bev_iou

CAR = "Car 0.00 1 -1.33 597.59 176.18 720.90 261.14 1.47 1.60 3.66 -1.07 1.55 14.44 -1.25"
REGION = "DontCare -1 -1 -10 800.38 163.67 825.45 184.07 -1 -1 -1 -1000 -1000 -1000 -10"
IMAGE_SIZE = (1242, 375)


def numbers(low, high):
    """Draw finite floats of a range."""
    return st.floats(low, high, allow_nan=False)


def angles():
    """Draw yaws in (-pi, pi], the ends included."""
    return numbers(-np.pi, np.pi).map(lambda angle: np.pi if angle == -np.pi else angle)


@st.composite
def box_arrays(draw):
    """Draw (n, 7) boxes within 80 m of the LiDAR."""
    place, side = numbers(-80, 80), numbers(0.2, 15)
    box = st.tuples(place, place, numbers(-4, 4), side, side, side, angles())
    return np.array(draw(st.lists(box, max_size=5)), dtype=np.float64).reshape(-1, 7)


def write(path, *lines):
    """Write a text file of lines."""
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


def annotations_of(boxes):
    """Return annotations with plausible 2D values."""
    count = len(boxes)
    return Annotations(
        boxes,
        np.array(["Car"] * count, dtype=np.str_),
        np.zeros(count),
        np.zeros(count, dtype=np.int64),
        np.zeros(count),
        np.tile([1.0, 2, 30, 40], (count, 1)),
    )


def test_each_field_is_read(tmp_path):
    """A label line is split into KITTI's fields."""
    found = read_objects(write(tmp_path / "a.txt", CAR, REGION))
    assert found.categories.tolist() == ["Car", "DontCare"]
    assert found.truncated.tolist() == [0, -1]
    assert found.occluded.tolist() == [1, -1]
    assert found.alpha.tolist() == [-1.33, -10]
    assert found.boxes_2d[0].tolist() == [597.59, 176.18, 720.90, 261.14]
    assert found.dimensions[0].tolist() == [1.47, 1.60, 3.66]
    assert found.locations[0].tolist() == [-1.07, 1.55, 14.44]
    assert found.rotations_y.tolist() == [-1.25, -10]
    assert np.isnan(found.scores).all()


def test_scores_of_results_are_read(tmp_path):
    """The 16th field is the score."""
    path = write(tmp_path / "a.txt", f"{CAR} 0.5", "", f"{CAR} -3.25")
    assert read_objects(path, scored=True).scores.tolist() == [0.5, -3.25]


def test_files_of_other_systems_are_read_equally(tmp_path):
    """A byte order mark, carriage returns, tabs and extra spaces are ignored."""
    van = CAR.replace("Car", "Van")
    (tmp_path / "a.txt").write_text(f"{CAR}\n{van}\n")
    foreign = "".join(line.replace(" ", " \t ") + " \r\n" for line in (CAR, van))
    (tmp_path / "b.txt").write_bytes(b"\xef\xbb\xbf" + foreign.encode() + b"\r\n")
    ours, other = read_objects(tmp_path / "a.txt"), read_objects(tmp_path / "b.txt")
    assert other.categories.tolist() == ours.categories.tolist()
    assert other.locations.tolist() == ours.locations.tolist()


@pytest.mark.parametrize("text", ["", "\n", "  \n\n"])
def test_an_empty_file_has_no_objects(tmp_path, text):
    """The arrays have the usual shapes."""
    path = tmp_path / "a.txt"
    path.write_text(text)
    for found in (read_objects(path), read_objects(path, scored=True), KittiObjects.empty()):
        assert len(found) == 0
        assert found.boxes_2d.shape == (0, 4)
        assert found.occluded.dtype == np.int64
        assert len(to_annotations(found, toy_calibration())) == 0


def test_a_label_file_that_was_written_twice_is_rejected(tmp_path, caplog):
    """A converter that appends writes all lines twice. Regions and results may repeat."""
    van = CAR.replace("Car", "Van")
    path = write(tmp_path / "a.txt", CAR, van, "", CAR, van)
    with pytest.raises(DataError, match=r"a\.txt:4: the Car has the same 3D box as in line 1, and"):
        read_objects(path)
    path = write(tmp_path / "b.txt", CAR, van, CAR)
    assert len(read_objects(path)) == 3
    assert "b.txt:3: the Car has the same 3D box as in line 1; remove one of them" in caplog.text
    region = "DontCare -1 -1 -10 1 2 30 40 -1 -1 -1 -1000 -1000 -1000 -10"
    assert len(read_objects(write(path, region, CAR, region))) == 3
    assert len(read_objects(write(path, f"{CAR} 0.5", f"{CAR} 0.4"), scored=True)) == 2


@pytest.mark.parametrize(
    ("line", "scored", "message"),
    [
        ("9.4 3.3 -0.9 4.1 1.7 1.2 0.0 Car", False, "OpenPCDet is in the LiDAR frame, and must be"),
        (CAR.rsplit(" ", 1)[0], False, "14 fields, but label lines have 15"),
        (f"{CAR} 0.5 0.5", False, "17 fields, but label lines have 15, or 16 with a score"),
        (f"{CAR} 436 2018_03_07 0002 ", False, "; keep the first 15, without 436 2018_03_07 0002"),
        (f"0 -1 {CAR} 0.0 33 True", False, "20 fields, but label lines have 15, or 16 with"),
        (f"0 -1 {CAR} 0.0 33 True", False, "as in KITTI tracking: keep fields 3 to 17, in"),
        (f"0 7 {CAR} 0.5", True, "as in KITTI tracking: keep fields 3 to 18, in a file per frame"),
        (CAR, True, "15 fields: the score is missing; result lines end with it"),
        (f"{CAR} 0.5 0.5", True, "17 fields, but result lines have 16"),
        ("Car", False, "1 fields"),
        (CAR.replace("Car", "car"), False, "unknown category 'car'; use one of Car, Cyclist,"),
        (CAR.replace("14.44", "far"), False, "'far' is not a number"),
        (CAR.replace("14.44", "nan"), False, "'nan' is not a finite number"),
        (f"{CAR} NaN", True, "'NaN' is not a finite number"),
        (f"{CAR} -inf", True, "'-inf' is not a finite number"),
        (CAR.replace("1.60 3.66", "-1.60 3.66"), False, "are 1.47 -1.60 3.66, but must be pos"),
        (CAR.replace("1.60 3.66", "0 3.66"), False, "of the Car are 1.47 0 3.66, but must be"),
    ],
)
def test_an_invalid_line_gives_one_line_with_its_position(tmp_path, line, scored, message):
    """The error contains file, line and reason."""
    good = f"{CAR} 0.5" if scored else CAR
    path = write(tmp_path / "a.txt", good, "", line, good)
    with pytest.raises(DataError) as caught:
        read_objects(path, scored=scored)
    assert str(caught.value).startswith(f"{path}:3: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_first_of_several_invalid_lines_is_reported(tmp_path):
    """Whatever the kind of error."""
    path = write(tmp_path / "a.txt", CAR, CAR.replace("Car", "Dog"), "Car 1", "x y z")
    with pytest.raises(DataError, match=r"a\.txt:2: unknown category 'Dog'"):
        read_objects(path)


def test_the_known_categories_can_be_changed(tmp_path):
    """`known` replaces KITTI's own categories; None accepts any."""
    path = write(tmp_path / "a.txt", CAR.replace("Car", "Dog"))
    assert read_objects(path, categories=None).categories.tolist() == ["Dog"]
    assert read_objects(path, categories={"Dog"}).categories.tolist() == ["Dog"]
    with pytest.raises(DataError, match="use one of Cat"):
        read_objects(path, categories=["Cat"])


@pytest.mark.parametrize("scored", [False, True])
def test_a_missing_or_binary_file_is_rejected(tmp_path, scored):
    """A missing file, a folder, or bytes that are not text."""
    with pytest.raises(DataError, match=r"missing\.txt: no such label file"):
        read_objects(tmp_path / "missing.txt", scored=scored)
    with pytest.raises(DataError, match="cannot be read"):
        read_objects(tmp_path, scored=scored)
    (tmp_path / "binary.txt").write_bytes(b"Car \xff\xfe")
    with pytest.raises(DataError, match=r"binary\.txt:1: not UTF-8 text \(byte 0xff\)"):
        read_objects(tmp_path / "binary.txt", scored=scored)


def test_a_box_computed_by_hand():
    """A car ahead: the camera at the LiDAR's origin looks along x, rotation_y -pi/2 is yaw 0."""
    objects = KittiObjects(
        np.array(["Car"]), np.zeros(1), np.zeros(1, np.int64), np.zeros(1), np.zeros((1, 4)),
        np.array([[1.5, 1.8, 4.0]]), np.array([[-3.0, 1.7, 20.0]]), np.array([-np.pi / 2]),
        np.array([0.5]),
    )  # fmt: skip
    box = to_detections(objects, toy_calibration()).boxes[0]
    assert box == pytest.approx([20, 3, -1.7 + 0.75, 4.0, 1.8, 1.5, 0])


def test_a_positive_rotation_y_turns_clockwise_seen_from_above():
    """KITTI's y points down: the heading of rotation_y 0 is the camera's x, the LiDAR's -y."""
    objects = KittiObjects(
        np.array(["Car"] * 2), np.zeros(2), np.zeros(2, np.int64), np.zeros(2), np.zeros((2, 4)),
        np.ones((2, 3)), np.zeros((2, 3)), np.array([0.0, 0.3]), np.full(2, np.nan),
    )  # fmt: skip
    yaws = to_annotations(objects, toy_calibration()).boxes[:, 6]
    assert yaws == pytest.approx([-np.pi / 2, -np.pi / 2 - 0.3])


def test_a_tilted_camera_neither_moves_nor_turns_a_box():
    """The camera looks 12 degrees down: a box stands upright on the point that it stood on."""
    box = np.array([[12.0, 3.0, -0.95, 4.1, 1.7, 1.5, 0.4]])
    objects = from_annotations(annotations_of(box), TILTED.calibration)
    bottom = TILTED.turn.apply([12.0, 3.0, -1.7]) + TILTED.origin
    assert objects.locations[0] == pytest.approx(bottom)
    assert objects.rotations_y[0] == pytest.approx(-0.4 - np.pi / 2)
    assert to_annotations(objects, TILTED.calibration).boxes == pytest.approx(box)


def test_labels_of_a_camera_that_looks_down_are_rejected(tmp_path):
    """Its optical axis is vertical, so rotation_y is not a heading."""
    path = write(tmp_path / "a.txt", CAR)
    down = Rig(pitch=np.pi / 2).calibration
    with pytest.raises(DataError, match=r"a\.txt: the camera's y axis is 0\.0 degrees"):
        read_annotations(path, down)
    by_formula = read_annotations(path, replace(down, rotation_y="openpcdet"))
    assert by_formula.boxes[0, 6] == pytest.approx(1.25 - np.pi / 2)


@given(box_arrays(), rigs)
@settings(max_examples=60)
def test_the_conversions_are_inverse_to_each_other(boxes, rig):
    """LiDAR to camera and back gives the boxes, with yaw in (-pi, pi], for every mounting."""
    calibration = rig.calibration
    objects = from_annotations(annotations_of(boxes), calibration)
    back = to_annotations(objects, calibration)
    assert back.boxes == pytest.approx(boxes, abs=1e-9)
    assert ((back.boxes[:, 6] > -np.pi) & (back.boxes[:, 6] <= np.pi)).all()
    again = from_annotations(back, calibration)
    assert again.locations == pytest.approx(objects.locations, abs=1e-9)
    assert again.rotations_y == pytest.approx(objects.rotations_y, abs=1e-9)


@given(boxes=box_arrays(), rig=rigs)
@settings(max_examples=40)
def test_a_file_keeps_boxes_to_a_millimetre(tmp_path_factory, boxes, rig):
    """LiDAR, file, LiDAR: no coordinate is off by more than 1e-3, for every mounting."""
    calibration = rig.calibration
    path = tmp_path_factory.mktemp("labels") / "a.txt"
    annotations = annotations_of(boxes)
    # With scores, because label files must not contain a box twice.
    scored = replace(from_annotations(annotations, calibration), scores=np.full(len(boxes), 0.5))
    write_objects(path, scored)
    back = to_annotations(read_objects(path, scored=len(boxes) > 0), calibration)
    difference = back.boxes - boxes
    difference[:, 6] = np.angle(np.exp(1j * difference[:, 6]))
    assert np.abs(difference).max(initial=0) < 1e-3
    assert back.boxes_2d == pytest.approx(annotations.boxes_2d)


def test_dontcare_regions_have_no_box(tmp_path):
    """NaN in the LiDAR frame, no detection, and KITTI's own line in a file."""
    objects = read_objects(write(tmp_path / "a.txt", REGION, CAR))
    annotations = to_annotations(objects, toy_calibration())
    assert np.isnan(annotations.boxes[0]).all()
    assert np.isfinite(annotations.boxes[1]).all()
    assert to_detections(objects, toy_calibration()).categories.tolist() == ["Car"]
    write_objects(tmp_path / "b.txt", from_annotations(annotations, toy_calibration()))
    assert (tmp_path / "b.txt").read_text().splitlines()[0] == REGION


def test_results_keep_their_scores(tmp_path):
    """A file with scores has 16 fields."""
    boxes = np.array([[20.0, 0, 0, 4, 2, 1.5, 0.1], [-20, 0, 0, 4, 2, 1.5, 0.1]])
    detections = Detections(boxes, np.array([0.123456, 1.0]), np.array(["Car", "Cyclist"]))
    path = tmp_path / "a.txt"
    write_objects(path, from_detections(detections, toy_calibration(), IMAGE_SIZE))
    back = to_detections(read_objects(path, scored=True), toy_calibration())
    assert back.scores.tolist() == [0.123456, 1.0]
    assert back.categories.tolist() == ["Car", "Cyclist"]
    assert back.boxes == pytest.approx(boxes, abs=1e-3)


def test_detections_get_a_rectangle_and_an_observation_angle():
    """Straight ahead alpha is rotation_y; behind the camera the rectangle has no height."""
    boxes = np.array([[20.0, 0, 0, 4, 2, 1.5, 0.1], [-20, 0, 0, 4, 2, 1.5, 0.1]])
    detections = Detections(boxes, np.ones(2), np.array(["Car", "Car"]))
    objects = from_detections(detections, toy_calibration(), (120, 40))
    assert objects.alpha[0] == pytest.approx(objects.rotations_y[0])
    left, top, right, bottom = objects.boxes_2d[0]
    assert 0 < left < 60 < right < 119
    assert 0 < top < 20 < bottom < 39
    assert objects.boxes_2d[1].tolist() == [-1, -1, -1, -1]
    assert objects.truncated.tolist() == [-1, -1]
    assert objects.occluded.tolist() == [-1, -1]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("locations", np.array([[np.nan, 0, 1]]), r"a\.txt:1: cannot write"),
        ("scores", np.array([np.inf]), r"a\.txt:1: cannot write"),
    ],
)
def test_numbers_that_are_not_finite_are_not_written(tmp_path, field, value, message):
    """No file is left."""
    path = tmp_path / "a.txt"
    fields = dict(vars(read_objects(write(tmp_path / "b.txt", CAR)))) | {field: value}
    with pytest.raises(DataError, match=message):
        write_objects(path, KittiObjects(**fields))
    assert not path.exists()


def test_scores_for_some_objects_only_are_rejected(tmp_path):
    """A file has scores for all objects or for none."""
    objects = read_objects(write(tmp_path / "a.txt", CAR, CAR.replace("Car", "Van")))
    objects.scores[0] = 0.5
    with pytest.raises(DataError, match="1 of 2 objects have no score"):
        write_objects(tmp_path / "b.txt", objects)


def test_selection_keeps_all_fields_together(tmp_path):
    objects = read_objects(write(tmp_path / "a.txt", CAR, REGION, CAR.replace("Car", "Van")))
    chosen = objects.select(np.array([2, 0]))
    assert chosen.categories.tolist() == ["Van", "Car"]
    for name, values in vars(chosen).items():
        np.testing.assert_array_equal(values, getattr(objects, name)[[2, 0]])


def test_real_labels_survive_the_conversion(kitti_root):
    """Every object of the 24 KITTI frames keeps the digits of its file."""
    dataset = KittiDataset(kitti_root)
    for frame_id in dataset.frame_ids():
        files = dataset.files(frame_id)
        calibration = read_calibration(files.calibration)
        objects = read_objects(files.label)
        back = from_annotations(to_annotations(objects, calibration), calibration)
        for name, values in vars(objects).items():
            if values.dtype.kind == "f":
                np.testing.assert_allclose(getattr(back, name), values, atol=1e-9)


def test_projected_labels_match_the_labelled_rectangles(kitti_root):
    """For fully visible cars, the projected 3D box and KITTI's 2D box agree."""
    dataset = KittiDataset(kitti_root)
    overlaps = []
    for frame_id in dataset.frame_ids():
        frame, truth = dataset.read(frame_id), dataset.annotations(frame_id)
        seen = truth.select(
            (truth.categories == "Car") & (truth.truncated == 0) & (truth.occluded == 0)
        )
        detections = Detections(seen.boxes, np.ones(len(seen)), seen.categories)
        projected = from_detections(detections, frame.calibration, frame.image_size)
        overlaps += [
            rectangle_iou(a, b) for a, b in zip(projected.boxes_2d, seen.boxes_2d, strict=True)
        ]
        assert projected.alpha == pytest.approx(seen.alpha, abs=0.06)
    assert len(overlaps) > 10
    assert np.mean(overlaps) > 0.85
    assert np.min(overlaps) > 0.6


def test_recorded_detections_match_labelled_cars(kitti_root):
    """Confident detections of a real detector overlap labelled cars, in 3D and in the image."""
    from curate.detectors.recorded import RecordedDetector

    dataset = KittiDataset(kitti_root)
    detector = RecordedDetector(kitti_root / "recorded" / "pointgnn_T1.csv", 0.9)
    found = 0
    for frame_id in dataset.frame_ids():
        frame, truth = dataset.read(frame_id), dataset.annotations(frame_id)
        cars = truth.select(np.isin(truth.categories, ["Car", "Van"]))
        sure = detector.predict(frame)
        projected = from_detections(sure, frame.calibration, frame.image_size)
        iou = bev_iou(sure.boxes, cars.boxes)
        for k, match in zip(*np.nonzero(iou > 0.7), strict=True):
            found += 1
            if cars.truncated[match] == 0:
                assert rectangle_iou(projected.boxes_2d[k], cars.boxes_2d[match]) > 0.6
    assert found > 20


def rectangle_iou(a, b):
    """Return the IoU of two rectangles (left, top, right, bottom)."""
    sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    common = np.prod(np.maximum(sides, 0))
    return common / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - common)


def test_without_a_camera_there_are_no_2d_boxes():
    """Not the projection by a placeholder; everything else is kept."""
    boxes = np.array([[10.0, 2.0, -1.0, 4.0, 1.8, 1.5, 0.3]])
    found = Detections(boxes, np.array([0.5]), as_categories(["Car"]))
    calibration = calibration_without_camera()
    objects = from_detections(found, calibration, None)
    assert objects.boxes_2d.tolist() == [[0, 0, 0, 0]]
    assert np.allclose(to_detections(objects, calibration).boxes, boxes)
