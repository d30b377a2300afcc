"""Simulated labels: on handmade scenes, and their agreement with points and pixels."""

import cv2
import numpy as np
import pytest

from curate.datasets.formats.images import decode_image
from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.labels import read_objects
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.projection import image_rectangles
from curate.geometry.similarity import wrap_angle
from curate.simulation import SEMANTIC_CLASSES, SEMANTIC_FOLDER
from curate.simulation.camera import render
from curate.simulation.labels import annotate
from curate.simulation.lidar import sweep
from curate.simulation.materials import Material
from curate.simulation.meshes import box
from curate.simulation.scene import Caster

LAST = np.array([1241.0, 374.0, 1241.0, 374.0])


@pytest.fixture
def labels_of(scene_of, rig):
    """Return the labels of a handmade scene."""

    def make(*things):
        scene = scene_of(*things)
        caster = Caster(scene.vertices, scene.triangles)
        return annotate(scene, render(scene, caster, rig, np.random.default_rng(0)), rig)

    return make


def frames_of(root):
    """Return the dataset, and each frame with its labels and those that have a 3D box."""
    dataset = KittiDataset(root)
    for frame_id in dataset.frame_ids():
        labels = dataset.annotations(frame_id)
        yield dataset.read(frame_id), labels, labels.select(labels.categories != "DontCare")


def test_a_fully_visible_car(labels_of):
    """Neither truncated nor occluded, with the box at its position."""
    labels = labels_of(("Car", 15.0, 2.0, 0.4))
    assert labels.categories.tolist() == ["Car"]
    np.testing.assert_allclose(labels.boxes[0, [0, 1, 6]], [15.0, 2.0, 0.4], atol=1e-6)
    assert labels.truncated[0] == 0
    assert labels.occluded[0] == 0


def test_the_hidden_share_decides_the_occlusion_level(labels_of):
    """A board that hides none, a third, most or all of it gives 0, 1, 2 or no clear label."""
    levels = []
    for width in (0.0, 0.35, 0.6, 2.6):
        board = box((0, 0, 1.5), (0.1, max(width, 0.01), 3.0), Material.WOOD)
        aside = 0.0 if width else 30.0
        labels = labels_of(("Car", 22.0, 0.0, 0.0), (board, 11.0, aside, 0.0))
        levels.append((labels.categories.tolist(), labels.occluded.tolist()))
    assert levels[0] == (["Car"], [0])
    assert levels[1] == (["Car"], [1])
    assert levels[2] == (["Car"], [2])
    assert "Car" not in levels[3][0]


def test_the_share_outside_the_image_is_the_truncation(labels_of):
    """A car that moves out of view goes from 0 to almost 1, its box clipped to the image."""
    labels = [labels_of(("Car", 8.0, y, 0.0)) for y in (3.0, 6.3, 7.2, 30.0)]
    shares = [float(label.truncated[0]) for label in labels[:3]]
    assert shares[0] == 0
    assert 0.05 < shares[1] < shares[2] < 1
    assert labels[1].boxes_2d[0, 0] == 0
    assert len(labels[3]) == 0


def test_a_car_beside_the_camera_has_a_box_within_the_image(labels_of):
    """An object that reaches behind the camera is clipped, not mirrored."""
    labels = labels_of(("Car", 1.8, 3.0, 0.0))
    assert labels.truncated[0] > 0.9
    assert (labels.boxes_2d >= 0).all()
    assert (labels.boxes_2d <= LAST).all()


def test_far_people_become_dontcare_regions(labels_of):
    """KITTI does not label people at that distance."""
    labels = labels_of(("Pedestrian", 80.0, 0.0, 0.0), ("Car", 20.0, 6.0, 0.0))
    assert labels.categories.tolist() == ["Car", "DontCare"]
    assert np.isnan(labels.boxes[1]).all()


def test_points_on_a_car_are_in_its_box(scene_of, labels_of):
    """The sweep of a single car on the street fills its box, and only its box."""
    scene = scene_of(("Car", 12.0, -2.0, 2.5))
    labels = labels_of(("Car", 12.0, -2.0, 2.5))
    caster = Caster(scene.vertices, scene.triangles)
    points = sweep(scene, caster, np.random.default_rng(1))
    raised = points[(points[:, 2] > -1.5) & (np.hypot(points[:, 0] - 12, points[:, 1] + 2) < 6)]
    grown = labels.boxes.copy()
    grown[:, 3:6] += 0.25  # range noise
    assert len(raised) > 300
    assert count_points_in_boxes(raised, grown)[0] > 0.99 * len(raised)


def test_visible_objects_have_points(simulated):
    """Every near object that is not hidden was hit by the sweep."""
    checked = 0
    for frame, _, labels in frames_of(simulated):
        clear = (labels.occluded == 0) & (labels.truncated < 0.2) & (labels.boxes[:, 0] < 35)
        counts = count_points_in_boxes(frame.points, labels.boxes[clear])
        assert (counts >= 5).all()
        checked += len(counts)
    assert checked > 15


def test_2d_boxes_are_those_of_the_3d_boxes(simulated):
    """The tight box of the object is in the rectangle of its 3D box, and fills most of it."""
    shares = []
    for frame, _, labels in frames_of(simulated):
        outer = image_rectangles(labels.boxes, frame.calibration, frame.image_size)
        assert (labels.boxes_2d[:, :2] >= outer[:, :2] - 2).all()
        assert (labels.boxes_2d[:, 2:] <= outer[:, 2:] + 2).all()
        sides = [part[:, 2:] - part[:, :2] for part in (labels.boxes_2d, outer)]
        shares.extend(np.prod(sides[0], axis=1) / np.prod(sides[1], axis=1))
    assert np.median(shares) > 0.75


def test_truncated_boxes_reach_the_image_border(simulated):
    """And no others; all levels are in KITTI's range."""
    for _, _, labels in frames_of(simulated):
        assert ((labels.truncated >= 0) & (labels.truncated <= 1)).all()
        assert np.isin(labels.occluded, [0, 1, 2]).all()
        border = (labels.boxes_2d[:, :2] <= 0.01).any(axis=1)
        border |= (labels.boxes_2d[:, 2:] >= LAST[2:] - 0.01).any(axis=1)
        assert border[labels.truncated > 0.005].all()


def test_alpha_is_the_observation_angle(simulated):
    """KITTI's definition: rotation_y minus the direction of the object."""
    for path in sorted((simulated / "training" / "label_2").glob("*.txt")):
        objects = read_objects(path)
        objects = objects.select(objects.categories != "DontCare")
        bearing = np.arctan2(objects.locations[:, 0], objects.locations[:, 2])
        difference = wrap_angle(objects.rotations_y - bearing - objects.alpha)
        assert np.abs(difference).max(initial=0) < 0.01


def test_pixels_of_a_class_are_in_boxes_of_its_category(simulated):
    """Every pixel of the semantic map belongs to a labelled object or a DontCare region."""
    for frame, labels, _ in frames_of(simulated):
        path = simulated / "training" / SEMANTIC_FOLDER / f"{frame.frame_id}.png"
        class_ids = decode_image(path, cv2.IMREAD_UNCHANGED)
        for category, class_id in SEMANTIC_CLASSES.items():
            covered = np.zeros(class_ids.shape, dtype=bool)
            for box_2d in labels.boxes_2d[np.isin(labels.categories, [category, "DontCare"])]:
                left, top = np.floor(box_2d[:2]).astype(int)
                right, bottom = np.ceil(box_2d[2:]).astype(int)
                covered[top : bottom + 1, left : right + 1] = True
            assert covered[class_ids == class_id].all()


def test_all_kinds_and_levels_occur(simulated):
    """A few frames have every category, occluded and truncated objects, and regions."""
    labels = [labels for _, labels, _ in frames_of(simulated)]
    categories = np.concatenate([part.categories for part in labels])
    assert set(categories) == {"Car", "Pedestrian", "Cyclist", "DontCare"}
    assert {0, 1, 2} <= set(np.concatenate([part.occluded for part in labels]).tolist())
    assert (np.concatenate([part.truncated for part in labels]) > 0.05).any()
