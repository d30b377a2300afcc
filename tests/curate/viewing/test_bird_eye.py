"""The bird's eye view."""

import numpy as np
import pytest
from support.shown_labels import labels

from curate.viewing.bird_eye import Region, draw_bird_eye, region_around
from curate.viewing.legend import TITLE_HEIGHT
from curate.viewing.palette import DARK, PAPER, weight_colours
from curate.viewing.tags import ShownLabels

REGION = Region(0, 40, -20, 20, 10)


def near(image, place, colour, reach=2):
    """Return whether a colour appears near a position (x, y in metres)."""
    column, row = np.rint(REGION.to_pixels(np.array(place, dtype=np.float64))).astype(int)
    around = image[row - reach : row + reach + 1, column - reach : column + reach + 1]
    return (np.abs(around.astype(int) - colour).max(axis=2) < 40).any()


def test_forward_is_up_and_left_is_left():
    """The LiDAR's x points up, its y to the left."""
    origin = REGION.to_pixels(np.zeros(2))
    assert origin.tolist() == [200, 400 + TITLE_HEIGHT]
    assert REGION.to_pixels(np.array([10.0, 5.0])).tolist() == [150, 300 + TITLE_HEIGHT]
    assert REGION.size == (400, 400)


def test_footprints_have_the_colour_of_their_weight():
    """The outline of a rotated box is at its corners."""
    box = [20, 5, 0, 4, 2, 1.5, np.pi / 2]
    image = draw_bird_eye(np.zeros((0, 4)), labels([box], [0.6]), region=REGION)
    colour = weight_colours(np.array([0.6]))[0].astype(int)
    for corner in ((21, 7), (19, 7), (19, 3), (21, 3)):
        assert near(image, corner, colour)
    assert not near(image, (22, 5), colour)


def test_ground_truth_is_white_and_can_be_nan():
    """DontCare regions without a box are left out."""
    truth = np.array([[30.0, 0, 0, 4, 2, 1.5, 0], [np.nan] * 7])
    with_truth = draw_bird_eye(np.zeros((0, 4)), labels([], []), truth, region=REGION)
    without = draw_bird_eye(np.zeros((0, 4)), labels([], []), region=REGION)
    assert near(with_truth, (32, 1), np.array(DARK.ground_truth))
    assert not near(without, (32, 1), np.array(DARK.ground_truth))


def test_points_are_drawn():
    """Points in the region brighten their position; those outside are ignored."""
    points = np.array([[15.3, -7.2, 1.0, 0], [500, 500, 0, 0], [-5, 0, 0, 0]])
    empty = draw_bird_eye(np.zeros((0, 4)), labels([], []), region=REGION)
    image = draw_bird_eye(points, labels([], []), region=REGION)
    rows, columns = np.nonzero((image != empty).any(axis=2))
    place = REGION.to_pixels(points[0, :2])
    assert len(rows) > 0
    assert np.hypot(columns - place[0], rows - place[1]).max() < 3


def test_titles_are_drawn():
    """The strip above the plot changes with the title."""
    plain = draw_bird_eye(np.zeros((0, 4)), labels([], []), region=REGION)
    titled = draw_bird_eye(np.zeros((0, 4)), labels([], []), region=REGION, title="frame 000008")
    assert (plain[:TITLE_HEIGHT] != titled[:TITLE_HEIGHT]).any()
    assert (plain[TITLE_HEIGHT:] == titled[TITLE_HEIGHT:]).all()


def test_the_region_grows_to_contain_all_labels():
    """Behind the LiDAR, far ahead, and at the sides; otherwise it is the default."""
    usual = Region()
    ahead = np.array([[30.0, 5, 0, 4, 2, 1.5, 0]])
    width = usual.size[0]
    assert region_around([ahead], width) == usual
    assert region_around([], width) == usual
    behind = region_around([ahead, np.array([[-25.0, 0, 0, 4, 2, 1.5, 0]])], width)
    assert behind.x_min == pytest.approx(-25 - 2 - 2)
    assert (behind.x_max, behind.y_max) == (usual.x_max, usual.y_max)
    wide = region_around([np.array([[70.0, 50, 0, 4, 2, 1.5, 0]])], width)
    assert wide.x_max == pytest.approx(74)
    assert wide.y_max == -wide.y_min == pytest.approx(53)
    assert wide.size[0] == width
    broken = region_around([np.array([[1e9, -1e9, 0, 4, 2, 1.5, 0]])], width)
    assert max(broken.x_max, broken.y_max) < 130


def test_labels_behind_the_vehicle_are_drawn():
    """In the colour of their weight, with their points."""
    shown = labels([[-12.0, 3, 0, 4, 2, 1.5, 0]], [0.6])
    points = np.array([[-11.0, 8.0, 1.0, 0]])
    image = draw_bird_eye(points, shown)
    region = region_around([shown.boxes], Region().size[0])
    colour = weight_colours(np.array([0.6]))[0].astype(int)
    column, row = np.rint(region.to_pixels(np.array([-14.0, 4.0]))).astype(int)
    assert (np.abs(image[row - 2 : row + 3, column - 2 : column + 3].astype(int) - colour)
            .max(axis=2) < 40).any()  # fmt: skip
    without = draw_bird_eye(np.zeros((0, 4)), shown)
    assert (image != without).any()


def test_the_paper_style_has_a_white_background():
    """And its own colours."""
    shown = labels([[20, 5, 0, 4, 2, 1.5, 0]], [0.6])
    image = draw_bird_eye(np.zeros((0, 4)), shown, region=REGION, style=PAPER)
    assert (image == 255).all(axis=2).mean() > 0.7
    assert near(image, (22, 6), weight_colours(np.array([0.6]), PAPER)[0].astype(int))


@pytest.mark.parametrize("frame_id", ["000008", "000023"])
def test_real_frames(kitti_root, frame_id):
    """A crowded and a usual frame are drawn completely."""
    from curate.datasets.kitti.dataset import KittiDataset
    from curate.detectors.recorded import RecordedDetector

    dataset = KittiDataset(kitti_root)
    frame = dataset.read(frame_id)
    found = RecordedDetector(kitti_root / "recorded" / "pointgnn_T0.csv").predict(frame)
    shown = ShownLabels(found.boxes, found.categories, found.scores, found.scores)
    image = draw_bird_eye(frame.points, shown, dataset.annotations(frame_id).boxes)
    assert image.shape[2] == 3
    assert (image.max(axis=2) > 90).mean() > 0.01
