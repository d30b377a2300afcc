"""The vector canvas: it draws the same as the raster canvas, and keeps text as text."""

import re
import zlib

import cv2
import numpy as np
import pytest
from support.toys import toy_calibration

from curate.frames import Frame
from curate.viewing.canvas import Canvas
from curate.viewing.frame_view import paint_frame
from curate.viewing.overlay import FrameContent
from curate.viewing.palette import PAPER
from curate.viewing.tags import ShownLabels
from curate.viewing.vector_canvas import VectorCanvas

BLACK, WHITE, RED = (0, 0, 0), (255, 255, 255), (255, 0, 0)


def paint(kind):
    """Draw everything that a canvas supports, half of it in a part of a part."""
    canvas = kind(120, 90, BLACK)
    canvas.box(5, 5, 30, 15, RED)
    canvas.lines(np.array([[40.0, 5], [110, 15]]), WHITE, 2)
    part = canvas.part(20, 70).part(10, 60)
    part.image(0, 30, 60, 30, np.full((2, 4, 3), 128, np.uint8))
    part.fill(np.array([[70.0, 5], [110, 5], [110, 25]]), RED, 0.5)
    part.circle(np.array([20.0, 15]), 8, WHITE, 2)
    part.dashes(np.array([[[65.0, 40], [115, 40]]]), WHITE, 2.0, (6.0, 4.0))
    part.dots(np.array([[80.0, 50], [500, 500]]), np.array([[0, 255, 0]] * 2, np.uint8))
    part.lines(np.array([[90.0, -500], [90, -1]]), WHITE, 3)
    part.text(2, -4, "outside of the part", WHITE)
    return canvas.finish().astype(int)


def test_it_draws_the_same_as_the_raster_canvas():
    """Up to a pixel at the edges of strokes; both clip what leaves a part."""
    raster, vector = paint(Canvas), paint(VectorCanvas)
    assert raster.shape == vector.shape
    seen = [picture.max(axis=2).astype(np.uint8) > 60 for picture in (raster, vector)]
    for one, other in (seen, seen[::-1]):
        grown = cv2.dilate(one.astype(np.uint8), np.ones((3, 3))).astype(bool)
        assert (other & ~grown).sum() <= 15
    assert (np.abs(raster - vector).max(axis=2) > 100).mean() < 0.02
    assert (vector[75] != 0).any()
    assert not vector[18:29].any()


def test_text_has_the_predicted_width():
    """And is on its baseline."""
    canvas = VectorCanvas(200, 40, BLACK)
    canvas.text(10, 30, "Car $0.87", WHITE, 14)
    seen = canvas.finish().max(axis=2) > 60
    columns, rows = np.flatnonzero(seen.any(axis=0)), np.flatnonzero(seen.any(axis=1))
    assert columns[-1] - 10 <= canvas.text_width("Car $0.87", 14) + 2
    assert columns[-1] - 10 > 0.85 * canvas.text_width("Car $0.87", 14)
    assert 29 <= rows[-1] <= 33
    assert canvas.text_width("") == 0


def painted(kind):
    """Return a frame with a car, as the content of a file."""
    points = np.random.default_rng(0).uniform(-20, 20, (500, 4)).astype(np.float32)
    image = np.full((40, 120, 3), 90, np.uint8)
    frame = Frame("000000", points, toy_calibration(), (120, 40), image)
    boxes = np.array([[15.0, 1, 0, 4, 2, 1.5, 0.3]])
    labels = ShownLabels(boxes, np.array(["Car"]), np.array([0.9]), np.array([0.7]))
    shown = FrameContent(labels, title="a <title>", style=PAPER)
    return paint_frame(frame, shown, kind).content(kind)


@pytest.mark.parametrize("kind", ["pdf", "svg"])
def test_equal_frames_give_equal_files(kind):
    """Without a date."""
    content = painted(kind)
    assert content == painted(kind)
    assert b"CreationDate" not in content
    assert b"dc:date" not in content


def test_a_pdf_contains_text_vectors_and_few_images():
    """Fonts are embedded; only the image and the points are not vectors."""
    content = painted("pdf")
    assert content.startswith(b"%PDF")
    assert b"/FontFile2" in content
    assert 1 <= len(re.findall(rb"/Subtype /Image", content)) <= 6
    streams = re.findall(rb"/FlateDecode.*?stream\r?\n(.*?)endstream", content, re.DOTALL)
    pages = b"".join(_inflated(each) for each in streams)
    assert len(re.findall(rb" l\n", pages)) > 30
    assert b" Tj" in pages or b" TJ" in pages


def _inflated(stream):
    try:
        return zlib.decompress(stream)
    except zlib.error:
        return b""
