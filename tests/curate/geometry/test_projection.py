"""Projection into the image: by hand, at the near plane, and on real KITTI frames."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.strategies import box_arrays

from curate.datasets.kitti.dataset import KittiDataset
from curate.frames import Calibration, Camera, Frame, calibration_without_camera
from curate.geometry.boxes import box_corners
from curate.geometry.projection import (
    box_rectangles,
    camera_of_boxes,
    image_rectangles,
    in_camera_view,
    in_view,
    project_points,
)

# A camera at the LiDAR's position that looks along x: focal length 100, centre (50, 40).
CAMERA = Calibration(
    np.array([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]]),
    np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
)
SIZE = (101, 81)


def test_points_are_projected_by_the_pinhole_model():
    """Left in the world is left in the image, up is up, and depth is along x."""
    pixels, depth = project_points(np.array([[10.0, 0, 0], [10, 1, 0.5], [-5, 0, 0]]), CAMERA)
    assert pixels[:2].tolist() == [[50, 40], [40, 35]]
    assert depth.tolist() == [10, 10, -5]


def test_only_points_before_the_camera_and_inside_the_image_are_in_view():
    """Behind, beside, on the border, at the camera itself, NaN."""
    points = np.array(
        [[10.0, 0, 0], [-10, 0, 0], [10, 5, 0], [10, 5.001, 0], [0, 0, 0], [np.nan, 0, 0]]
    )
    with np.errstate(invalid="ignore"):
        seen = in_view(points, CAMERA, SIZE)
    assert seen.tolist() == [True, False, True, False, False, False]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_view_mask_agrees_with_the_projected_points(dtype):
    """Point by point, also on the border, as NumPy rounds them."""
    generator = np.random.default_rng(0)
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    turned = Calibration(CAMERA.projection, CAMERA.lidar_to_camera @ np.eye(4))
    turned.lidar_to_camera[:3, :3] @= turn
    u, v = np.meshgrid(np.linspace(-1, 102, 104), np.linspace(-1, 82, 84))
    rays = np.column_stack([np.ones(u.size), (50 - u.ravel()) / 100, (40 - v.ravel()) / 100])
    border = np.concatenate([rays * depth for depth in (-3, 0.0, 0.1, 7, 80)])
    points = np.concatenate([border @ turn, generator.normal(0, 30, (20_000, 3))]).astype(dtype)
    for camera in (CAMERA, turned):
        pixels, depth = project_points(points, camera)
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels < np.array(SIZE))).all(axis=1) & (depth > 0)
        assert 1000 < inside.sum() < len(points)
        assert np.array_equal(in_view(points, camera, SIZE), inside)


def test_a_cube_ahead_has_the_rectangle_of_its_near_face():
    """Sides of 2 m at 9 m: plus and minus 100 / 9 pixels around the centre."""
    rectangle = image_rectangles(np.array([[10.0, 0, 0, 2, 2, 2, 0]]), CAMERA, SIZE)
    half = 100 / 9
    assert rectangle[0] == pytest.approx([50 - half, 40 - half, 50 + half, 40 + half])


def test_a_box_beyond_the_border_is_clipped():
    """The rectangle ends at the last pixels."""
    boxes = np.array([[10.0, 5, 0, 2, 2, 2, 0], [3.0, 0, 0, 1, 20, 20, 0]])
    rectangles = image_rectangles(boxes, CAMERA, SIZE)
    assert rectangles[0, 0] == 0
    assert rectangles[1].tolist() == [0, 0, 100, 80]


def test_boxes_behind_or_beside_the_image_have_no_rectangle():
    """All values are NaN, never only some."""
    boxes = np.array([[-10.0, 0, 0, 2, 2, 2, 0], [10.0, 50, 0, 2, 2, 2, 0], [0, 9, 0, 2, 2, 2, 0]])
    assert np.isnan(image_rectangles(boxes, CAMERA, SIZE)).all()
    assert image_rectangles(boxes[:0], CAMERA, SIZE).shape == (0, 4)


def test_a_box_around_the_camera_plane_is_clipped_at_the_near_plane():
    """A long box on the left that passes the camera covers the left border and stays left."""
    box = np.array([[0.0, 2.0, 0, 20.0, 1.0, 1.0, 0]])
    left, top, right, bottom = image_rectangles(box, CAMERA, SIZE)[0]
    assert (left, top, bottom) == (0, 0, 80)
    assert right == pytest.approx(50 - 100 * 1.5 / 10)


def by_sampling(box):
    """Return the rectangle around many points of the box that are beyond the near plane."""
    corners = box_corners(box[None])[0]
    shares = np.stack(np.meshgrid(*[np.linspace(0, 1, 41)] * 3), axis=-1).reshape(-1, 3)
    points = (
        corners[0]
        + shares[:, :1] * (corners[1] - corners[0])
        + shares[:, 1:2] * (corners[3] - corners[0])
        + shares[:, 2:] * (corners[4] - corners[0])
    )
    pixels, depth = project_points(points, CAMERA)
    pixels = pixels[depth >= 0.1]
    return pixels.min(axis=0), pixels.max(axis=0)


@settings(max_examples=60)
@given(box_arrays(min_size=1, max_size=3))
def test_rectangles_contain_all_visible_points_of_the_box(boxes):
    """No point of the box beyond the near plane appears outside the rectangle."""
    boxes = np.add(boxes, [1.0, 0, 0, 0.1, 0.1, 0.1, 0])
    last = np.array(SIZE) - 1
    for box, rectangle in zip(boxes, image_rectangles(boxes, CAMERA, SIZE), strict=True):
        if not (box_corners(box[None])[0, :, 0] >= 0.1).any():
            assert np.isnan(rectangle).all()
            continue
        low, high = by_sampling(box)
        if np.isnan(rectangle).any():
            assert (high <= 1e-6).any() or (low >= last - 1e-6).any()
        else:
            assert np.all(rectangle[:2] <= np.clip(low, 0, last) + 1e-6)
            assert np.all(rectangle[2:] >= np.clip(high, 0, last) - 1e-6)
            assert np.all((rectangle >= 0) & (rectangle <= np.tile(last, 2)))


@pytest.mark.kitti
def test_projected_label_boxes_are_the_labels_of_real_frames(kitti_root):
    """3D labels that are completely in the image project onto their 2D labels."""
    data = KittiDataset(kitti_root)
    overlaps = []
    for frame_id in data.frame_ids():
        frame, labels = data.read(frame_id), data.annotations(frame_id)
        whole = (labels.truncated == 0) & (labels.categories != "DontCare")
        rectangles = image_rectangles(labels.boxes[whole], frame.calibration, frame.image_size)
        overlaps.extend(map(rectangle_iou, rectangles, labels.boxes_2d[whole]))
    assert len(overlaps) > 50
    assert np.median(overlaps) > 0.85
    assert np.mean(np.array(overlaps) > 0.7) > 0.9


@pytest.mark.kitti
def test_points_of_real_objects_appear_inside_their_labels(kitti_root):
    """LiDAR points inside a 3D label box are inside its 2D label, within a few pixels."""
    from curate.geometry.points_in_boxes import box_of_points

    data = KittiDataset(kitti_root)
    inside = total = 0
    for frame_id in data.frame_ids()[:8]:
        frame, labels = data.read(frame_id), data.annotations(frame_id)
        labels = labels.select((labels.truncated == 0) & (labels.categories != "DontCare"))
        points = frame.points[in_view(frame.points, frame.calibration, frame.image_size)]
        owners = box_of_points(points, labels.boxes)
        pixels, _ = project_points(points[owners >= 0], frame.calibration)
        rectangles = labels.boxes_2d[owners[owners >= 0]]
        within = (pixels >= rectangles[:, :2] - 5) & (pixels <= rectangles[:, 2:] + 5)
        inside, total = inside + np.sum(within.all(axis=1)), total + len(pixels)
    assert total > 1000
    assert inside / total > 0.95


def rectangle_iou(a, b):
    """Return the IoU of two rectangles; 0 if one is NaN."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if not (width > 0 and height > 0):
        return 0.0
    common = width * height
    return common / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common)


def camera(name: str, degrees: float, size=(200, 100)) -> Camera:
    """Return a camera at the LiDAR with a view of 90 degrees, turned to the left by an angle."""
    turn = np.eye(4)
    angle = np.radians(degrees)
    turn[:2, :2] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    projection = np.array([[100.0, 0, 100, 0], [0, 100, 50, 0], [0, 0, 1, 0]])
    ahead = calibration_without_camera().lidar_to_camera
    return Camera(name, Calibration(projection, ahead @ turn), size)


AROUND = [camera("front", 0), camera("left", 90), camera("back", 180), camera("right", -90)]


def test_a_box_is_assigned_to_the_camera_that_shows_most_of_it():
    """One that straddles a border, too; -1 for a box that no camera shows."""
    angles = np.radians([0, 90, 180, -90, 40, 50, -130, 44.9, 45.1])
    boxes = np.tile([0, 0, 0, 4, 1.8, 1.5, 0.3], (len(angles), 1))
    boxes[:, 0], boxes[:, 1] = 12 * np.cos(angles), 12 * np.sin(angles)
    assert camera_of_boxes(boxes, AROUND).tolist() == [0, 1, 2, 3, 0, 1, 3, 0, 1]
    above = boxes[:1] + np.eye(7)[2] * 60
    assert camera_of_boxes(above, AROUND).tolist() == [-1]
    assert camera_of_boxes(boxes, ()).tolist() == [-1] * len(boxes)
    front = camera_of_boxes(boxes, AROUND[:1])
    seen = ~np.isnan(image_rectangles(boxes, AROUND[0].calibration, AROUND[0].image_size))
    np.testing.assert_array_equal(front >= 0, seen.all(axis=1))


def test_of_two_cameras_that_show_the_whole_box_the_closer_one_counts():
    """The one with the longer focal length has more pixels of it."""
    wide = camera("wide", 0)
    scale = np.diag([2.0, 2, 1])
    tele = Camera("tele", replace(wide.calibration, projection=scale @ wide.calibration.projection),
                  (400, 200))  # fmt: skip
    boxes = np.array([[20.0, 1, 0, 4, 1.8, 1.5, 0]])
    assert camera_of_boxes(boxes, [wide, tele]).tolist() == [1]
    assert camera_of_boxes(boxes, [tele, wide]).tolist() == [0]


@given(st.integers(0, 10_000))
@settings(max_examples=30)
def test_the_chosen_camera_contains_most_sampled_points_of_the_box(seed):
    """Compared with random points inside the box."""
    rng = np.random.default_rng(seed)
    box = np.array([*rng.uniform(-20, 20, 2), rng.uniform(-2, 2), *rng.uniform(0.5, 6, 3),
                    rng.uniform(-3, 3)])  # fmt: skip
    places = rng.uniform(-0.5, 0.5, (4000, 3)) * box[3:6]
    cos, sin = np.cos(box[6]), np.sin(box[6])
    places[:, :2] = places[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    shares = [in_view(places + box[:3], c.calibration, c.image_size).mean() for c in AROUND]
    [chosen] = camera_of_boxes(box[None], AROUND)
    assert shares[chosen] >= max(shares) - 0.08 or max(shares) == 0


def test_the_view_of_several_cameras_is_their_union():
    """Without a camera, every point is kept."""
    points = np.random.default_rng(0).uniform(-20, 20, (500, 4)).astype(np.float32)
    alone = Frame("a", points, calibration_without_camera(), None)
    assert in_camera_view(alone).all()
    assert alone.cameras == ()
    both = alone.with_cameras(AROUND[:2])
    expected = [in_view(points, each.calibration, each.image_size) for each in AROUND[:2]]
    np.testing.assert_array_equal(in_camera_view(both), expected[0] | expected[1])
    assert [view.camera for view in both.views()] == ["front", "left"]
    assert all(len(view.cameras) == 1 for view in both.views())
    boxes = np.array(
        [[12.0, 0, 0, 4, 2, 1.5, 0], [0, 12, 0, 4, 2, 1.5, 0], [-12, 0, 0, 4, 2, 1, 0]]
    )
    rectangles = box_rectangles(boxes, both)
    for i in (0, 1):
        own = image_rectangles(boxes[i : i + 1], AROUND[i].calibration, (200, 100))[0]
        np.testing.assert_array_equal(rectangles[i], own)
    assert np.isnan(rectangles[2]).all()


def test_without_an_image_nothing_is_clipped():
    """The rectangle of a box beyond the border is that of a larger image."""
    calibration = AROUND[0].calibration
    boxes = np.array([[10.0, 14, 0, 4, 2, 1.5, 0], [-10, 0, 0, 4, 2, 1.5, 0]])
    found = image_rectangles(boxes, calibration, None)
    assert np.isnan(image_rectangles(boxes, calibration, (200, 100))).all()
    assert found[0, 0] < 0
    assert np.isnan(found[1]).all()
