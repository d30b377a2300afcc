"""The image of a whole frame, and its line styles."""

import numpy as np
from support.toys import toy_calibration

from curate.frames import Calibration, Camera, Frame
from curate.viewing.bird_eye import bird_eye_size, draw_bird_eye, region_around
from curate.viewing.canvas import Canvas, jpeg
from curate.viewing.frame_view import draw_frame
from curate.viewing.overlay import overlay_size
from curate.viewing.palette import DARK, weight_colours
from curate.viewing.tags import ShownLabels, ShownRepredictions

BOX = np.array([[15.0, 1, 0, 4, 2, 1.5, 0.3]])


def frame(image=True):
    """Return a grey frame without points."""
    pixels = np.full((40, 120, 3), 90, np.uint8) if image else None
    return Frame("000000", np.zeros((0, 4), np.float32), toy_calibration(), (120, 40), pixels)


def shown(weight):
    """Return one car."""
    return ShownLabels(BOX, np.array(["Car"]), np.array([0.9]), np.array([weight]), np.array([7]))


def has(pixels, colour):
    """Return whether some pixel has nearly this colour."""
    return (np.abs(pixels.astype(int) - np.array(colour)).max(axis=2) < 12).any()


def test_image_and_bird_eye_view_are_one_image():
    """As wide as the overlay; ground truth and repredictions are drawn too."""
    plain = draw_frame(frame(), shown(0.9))
    assert plain.shape[1] == 1200
    moved = BOX + np.array([3.0, 3, 0, 0, 0, 0, 0])
    truth = draw_frame(frame(), shown(0.9), moved)
    both = draw_frame(
        frame(), shown(0.9), moved, ShownRepredictions(moved - 6 * (np.arange(7) == 1), np.zeros(1))
    )
    assert plain.shape == truth.shape == both.shape
    for one, other in ((plain, truth), (truth, both)):
        changed = (one != other).any(axis=2)
        half = len(plain) // 2
        assert changed[:half].any()
        assert changed[half:-60].any()


def test_a_label_without_weight_has_its_own_colour():
    """NaN is neither ignored nor trusted."""
    assert has(draw_frame(frame(), shown(np.nan)), DARK.unweighted)
    assert not has(draw_frame(frame(), shown(0.9)), DARK.unweighted)
    assert weight_colours(np.array([np.nan]))[0].tolist() == list(DARK.unweighted)


def test_without_images_the_bird_eye_view_is_drawn_alone():
    """It has the title and the width of a bird's eye view."""
    alone = draw_frame(frame(image=False), shown(0.5), title="frame 000000")
    expected = draw_bird_eye(np.zeros((0, 4)), shown(0.5), title="frame 000000")
    np.testing.assert_array_equal(alone, expected)


def test_every_camera_that_shows_a_label_is_drawn():
    """One after the other, with their names; a camera without labels is left out."""
    calibration = toy_calibration()
    turned = np.diag([-1.0, -1, 1, 1])
    behind = Calibration(calibration.projection, calibration.lidar_to_camera @ turned)
    pixels = np.full((40, 120, 3), 90, np.uint8)
    cameras = [
        Camera(name, each, (120, 40), pixels)
        for name, each in (("front", calibration), ("back", behind))
    ]
    both = np.concatenate([BOX, BOX * np.array([-1, 1, 1, 1, 1, 1, 1])])
    labels = ShownLabels(both, np.array(["Car"] * 2), np.ones(2), np.array([0.9, 0.4]))
    several = draw_frame(frame().with_cameras(cameras), labels)
    one = draw_frame(frame().with_cameras(cameras), shown(0.9))
    height = overlay_size(pixels)[1]
    region = region_around([both], 1200)
    assert several.shape[0] == 2 * height + bird_eye_size(region)[1]
    assert one.shape == draw_frame(frame(), shown(0.9)).shape
    assert has(several[height : 2 * height], weight_colours(np.array([0.4]))[0])


def test_dashes_have_gaps_and_end_with_the_image():
    """About half of the pixels; a stroke from far outside still crosses the image."""
    canvas = Canvas(200, 20, (0, 0, 0))
    canvas.dashes(np.array([[[-100_000.0, 10], [100_000, 10]]]), (255, 255, 255), 1.0, (5.0, 5.0))
    row = canvas.finish()[10, :, 0] > 100
    assert 0.35 < row.mean() < 0.75
    assert 15 <= np.count_nonzero(np.diff(row.astype(int)) == 1) <= 21
    canvas = Canvas(20, 20, (0, 0, 0))
    outside = np.array([[[30.0, 5], [40, 9]], [[5, 5], [5, 5]], [[-5, -5], [-5, 30]]])
    canvas.dashes(outside, (255, 255, 255), 1.0, (5.0, 5.0))
    assert not canvas.finish().any()


def test_a_jpeg_is_smaller_than_its_pixels():
    """And has the header of a JPEG."""
    content = jpeg(np.full((64, 64, 3), 120, np.uint8))
    assert content[:2] == b"\xff\xd8"
    assert len(content) < 2000
