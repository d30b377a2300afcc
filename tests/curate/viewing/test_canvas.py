"""The canvas."""

import cv2
import numpy as np
import pytest

from curate.viewing.canvas import Canvas, save_png

BLACK, WHITE = (0, 0, 0), (255, 255, 255)


@pytest.fixture
def canvas():
    """Return an empty black canvas."""
    return Canvas(60, 40, BLACK)


def test_size_and_background(canvas):
    """Width and height are those of the finished image."""
    image = canvas.finish()
    assert image.shape == (40, 60, 3)
    assert image.dtype == np.uint8
    assert not image.any()


def test_lines_are_drawn_smoothly_at_their_position(canvas):
    """A slanted line has half tones along its edges."""
    canvas.lines(np.array([[5.0, 5], [50, 30]]), WHITE, 2)
    image = canvas.finish()[..., 0]
    assert image[17:20, 27:30].max() > 200
    assert image[35:, :10].max() == 0
    assert ((image > 20) & (image < 235)).sum() > 20


def test_fills_blend(canvas):
    """Half opacity gives half the colour; outside nothing changes."""
    canvas.box(10, 10, 30, 20, (200, 100, 50), opacity=0.5)
    image = canvas.finish()
    assert image[15, 20].tolist() == pytest.approx([100, 50, 25], abs=2)
    assert not image[:9].any()
    assert not image[22:].any()


@pytest.mark.parametrize("offset", [(-100, 0), (100, 0), (0, -100), (0, 100), (1e9, 1e9)])
def test_drawing_outside_the_canvas_has_no_effect(canvas, offset):
    """Lines, fills, dots and text."""
    outline = np.array([[0.0, 0], [20, 0], [20, 20]]) + offset
    canvas.fill(outline, WHITE, 1.0)
    canvas.lines(outline, WHITE, 1, closed=True)
    canvas.dots(outline, np.full((3, 3), 255, np.uint8))
    assert not canvas.finish().any()


def test_dots_have_their_own_colours(canvas):
    """The later of two dots at one position is visible."""
    places = np.array([[10.0, 10], [10, 10], [30, 5]])
    canvas.dots(places, np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8))
    image = canvas.finish()
    assert image[10, 10].tolist() == [0, 255, 0]
    assert image[5, 30].tolist() == [0, 0, 255]


def test_circles_have_their_radius(canvas):
    """The rim is drawn, the centre is not."""
    canvas.circle(np.array([30.0, 20.0]), 15, WHITE, 2)
    image = canvas.finish()[..., 0]
    assert image[20, 14:17].max() > 150
    assert image[20, 30] == 0


def test_text_has_the_predicted_width(canvas):
    """Nothing is drawn beyond the width that the layout uses."""
    wide = Canvas(200, 40, BLACK)
    wide.text(10, 30, "Car 0.87", WHITE, 14)
    columns = np.flatnonzero(wide.finish().max(axis=(0, 2)) > 60)
    assert columns[0] >= 9
    assert columns[-1] - 10 <= wide.text_width("Car 0.87", 14) + 2
    assert columns[-1] - 10 > 0.8 * wide.text_width("Car 0.87", 14)


def test_saved_images_keep_their_colours(tmp_path, canvas):
    """Red is red for every other reader."""
    canvas.box(0, 0, 60, 40, (255, 0, 0))
    save_png(tmp_path / "deep" / "a.png", canvas.finish())
    bgr = cv2.imread(str(tmp_path / "deep" / "a.png"))
    assert bgr[20, 30].tolist() == [0, 0, 255]
    assert len(list((tmp_path / "deep").iterdir())) == 1


def test_a_part_draws_only_into_its_rows(canvas):
    """Its own top is 0; everything outside is clipped."""
    part = canvas.part(10, 20)
    assert (part.width, part.height) == (60, 20)
    part.box(0, 0, 5, 5, WHITE)
    part.lines(np.array([[30.0, -50], [30, 90]]), WHITE, 2)
    image = canvas.finish()[..., 0]
    assert image[12, 2] == 255
    assert image[11:29, 29:31].min() > 200
    assert not image[:10].any()
    assert not image[30:].any()
