"""Proposals from masks and points, in scenes made by hand."""

import numpy as np
import pytest

from curate.evaluation.proposals import (
    ProposalSettings,
    candidate_masks,
    closest_angle,
    fit_box,
    largest_group,
    propose_objects,
)
from curate.frames import Calibration, Frame
from curate.geometry.overlap import bev_iou
from curate.geometry.projection import image_rectangles
from curate.segmenters.base import Segmenter, SemanticMap

CLASSES = {"Car": (1,), "Pedestrian": (2,), "Cyclist": (2, 3)}
SIZES = {
    "Car": np.array([4.2, 1.8, 1.5]),
    "Pedestrian": np.array([0.8, 0.6, 1.8]),
    "Cyclist": np.array([1.8, 0.6, 1.7]),
}
SIZE = (400, 120)
GROUND = -1.7
NO_LABELS = np.zeros((0, 7))


def calibration() -> Calibration:
    """Return a camera at the LiDAR that looks along x."""
    to_camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    return Calibration(np.array([[200.0, 0, 200, 0], [0, 200, 40, 0], [0, 0, 1, 0]]), to_camera)


def seen_sides(box: np.ndarray, step: float = 0.1) -> np.ndarray:
    """Return points on the sides of a box that face the LiDAR at the origin."""
    length, width, height = box[3:6]
    cos, sin = np.cos(box[6]), np.sin(box[6])
    points = []
    for normal, across, half, reach in (
        ((1, 0), (0, 1), length / 2, width / 2), ((-1, 0), (0, 1), length / 2, width / 2),
        ((0, 1), (1, 0), width / 2, length / 2), ((0, -1), (1, 0), width / 2, length / 2),
    ):  # fmt: skip
        outward = np.array([[cos, -sin], [sin, cos]]) @ normal
        if outward @ (box[:2] + half * outward) >= 0:
            continue
        for t in np.arange(-reach, reach + 1e-9, step):
            place = half * np.array(normal) + t * np.array(across)
            turned = np.array([cos * place[0] - sin * place[1], sin * place[0] + cos * place[1]])
            heights = box[2] - height / 2 + np.arange(0.4, height, 0.2)
            points += [[*(box[:2] + turned), z] for z in heights]
    return np.array(points)


class Given(Segmenter):
    """A segmenter that returns one map."""

    def __init__(self, semantic_map: SemanticMap) -> None:
        self.semantic_map = semantic_map

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the map."""
        return self.semantic_map


def street(boxes: dict[int, list[np.ndarray]]) -> tuple[Frame, Given]:
    """Return a frame with boxes by class, their points, ground, a wall behind, and their masks."""
    x, y = np.meshgrid(np.arange(3, 60, 0.5), np.arange(-20, 20, 0.5))
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, GROUND)])
    wall = np.array([[50.0, y, z] for y in np.arange(-20, 20, 0.3) for z in np.arange(-1, 3, 0.3)])
    points = [ground, wall]
    class_ids = np.zeros(SIZE[::-1], dtype=np.uint8)
    for class_id, of_class in boxes.items():
        for box in of_class:
            points.append(seen_sides(box))
            [rectangle] = image_rectangles(box[None], calibration(), SIZE)
            left, top, right, bottom = np.round(rectangle).astype(int)
            class_ids[top : bottom + 1, left : right + 1] = class_id
    cloud = np.concatenate(points)
    cloud = np.column_stack([cloud, np.zeros(len(cloud))]).astype(np.float32)
    return Frame("a", cloud, calibration(), SIZE), Given(SemanticMap(class_ids, CLASSES))


def car(x: float, y: float, yaw: float) -> np.ndarray:
    """Return a car on the ground."""
    return np.array([x, y, GROUND + 0.75, *SIZES["Car"], yaw])


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.2, -0.7, np.pi / 2])
def test_a_car_without_a_label_is_proposed_where_it_is(yaw: float) -> None:
    """From the sides that the LiDAR sees, up to half a turn; the wall behind it does not matter."""
    box = car(15, 3, yaw)
    frame, segmenter = street({1: [box]})
    found = propose_objects(frame, segmenter, NO_LABELS, SIZES)
    assert found.categories.tolist() == ["Car"]
    assert bev_iou(found.boxes, box[None])[0, 0] > 0.8
    assert abs(np.sin(found.boxes[0, 6] - yaw)) < 0.05
    assert found.boxes[0, 2] - found.boxes[0, 5] / 2 == pytest.approx(GROUND, abs=0.05)
    assert found.points[0] > 50


def test_labeled_objects_are_not_proposed() -> None:
    """Of two cars whose masks touch, the one without a label remains."""
    near, far = car(12, 2, 0.1), car(22, 0, 0.1)
    frame, segmenter = street({1: [far, near]})
    found = propose_objects(frame, segmenter, near[None], SIZES)
    assert len(found) == 1
    assert bev_iou(found.boxes, far[None])[0, 0] > 0.5
    both = propose_objects(frame, segmenter, np.stack([near, far]), SIZES)
    assert len(both) == 0
    assert both.boxes.shape == (0, 7)


def test_masks_without_points_and_small_masks_are_not_proposed() -> None:
    frame, segmenter = street({1: [car(15, 3, 0)]})
    few = ProposalSettings(fewest_points=10_000)
    assert len(propose_objects(frame, segmenter, NO_LABELS, SIZES, few)) == 0
    small = ProposalSettings(fewest_pixels=10_000)
    assert len(propose_objects(frame, segmenter, NO_LABELS, SIZES, small)) == 0
    empty = Frame("a", frame.points[:0], calibration(), SIZE)
    assert len(propose_objects(empty, segmenter, NO_LABELS, SIZES)) == 0


def test_a_shared_class_goes_to_the_category_with_its_own_class_beside_it() -> None:
    """A person on a bicycle is a cyclist, a person alone a pedestrian."""
    class_ids = np.zeros((20, 60), dtype=np.uint8)
    class_ids[2:8, 5:15], class_ids[8:14, 5:15] = 2, 3
    class_ids[2:14, 30:40] = 2
    found = candidate_masks(
        SemanticMap(class_ids, CLASSES), tuple(SIZES), np.zeros_like(class_ids, dtype=bool)
    )
    assert [(name, int(mask.sum()), int(mask.any(axis=0).argmax())) for name, mask in found] == [
        ("Cyclist", 120, 5),
        ("Pedestrian", 120, 30),
    ]


def test_instances_separate_what_touches() -> None:
    """Connected cars are one mask without instances, and two with them."""
    class_ids = np.zeros((20, 60), dtype=np.uint8)
    class_ids[5:15, 10:50] = 1
    nothing = np.zeros_like(class_ids, dtype=bool)
    assert len(candidate_masks(SemanticMap(class_ids, CLASSES), ("Car",), nothing)) == 1
    instances = np.zeros((20, 60), dtype=np.int64)
    instances[5:15, 10:30], instances[5:15, 30:50] = 3, 7
    found = candidate_masks(SemanticMap(class_ids, CLASSES, instances), ("Car",), nothing)
    assert [int(mask.sum()) for _, mask in found] == [200, 200]


def test_the_largest_group_and_the_nearer_of_equal_ones() -> None:
    """By hand: groups of 2, 3 and 3 points."""
    places = [[9, 0, 0], [9.3, 0, 0], [20, 0, 0], [20, 0.4, 0], [20, 0.8, 0], [5, 9, 0],
              [5, 9.4, 0], [5, 9.8, 0]]  # fmt: skip
    assert largest_group(np.array(places, dtype=float), 0.5).tolist() == [5, 6, 7]
    assert largest_group(np.zeros((0, 3)), 0.5).tolist() == []
    assert largest_group(np.array([[1.0, 2, 3]]), 0.5).tolist() == [0]


def test_the_angle_of_an_l_shape() -> None:
    """Of a corner with noise of 2 cm, to about the step of the search."""
    generator = np.random.default_rng(0)
    corner = np.concatenate([
        np.column_stack([np.linspace(0, 4, 40), np.zeros(40)]),
        np.column_stack([np.zeros(15), np.linspace(0, 1.8, 15)]),
    ])  # fmt: skip
    for angle in (0.1, 0.8, 1.4):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        places = corner @ turn.T + generator.normal(0, 0.02, corner.shape) + [10, 5]
        assert closest_angle(places) == pytest.approx(angle, abs=np.deg2rad(2))


def test_a_car_seen_from_behind_extends_away_from_the_lidar() -> None:
    """Only its rear has points: 1.7 m wide, so that the length is in the viewing direction."""
    rear = np.column_stack([np.full(18, 20.0), np.linspace(-0.85, 0.85, 18), np.full(18, -0.5)])
    box = fit_box(rear, SIZES["Car"], GROUND, 1.3)
    assert box[:2] == pytest.approx([20 + 2.1, 0], abs=0.05)
    assert box[3:5] == pytest.approx([4.2, 1.8])
    assert abs(np.sin(box[6])) < 0.05
