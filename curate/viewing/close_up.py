"""Draw a close-up of a label: the camera image around it, and the points around it from above."""

from dataclasses import dataclass

import numpy as np

from curate.frames import Camera, Frame
from curate.geometry.boxes import bev_corners
from curate.geometry.projection import camera_of_boxes, image_rectangles
from curate.viewing.bird_eye import Region
from curate.viewing.canvas import Canvas
from curate.viewing.legend import REPREDICTION_DASHES
from curate.viewing.overlay import box_strokes
from curate.viewing.palette import DARK, height_shades, weight_colours

_SIDE, _WIDE = 260, 390
_REACH_METRES = 8.0
_MARGIN_SHARE = 0.6
_LEAST_PIXELS = 60.0


@dataclass(frozen=True)
class CloseUpLabel:
    """A label to draw in a close-up.

    Attributes:
        box: (7,) in the LiDAR frame.
        weight: weight in [0, 1], which gives the colour.
        former: (7,) its box in the previous round, drawn dashed; None if there was none.
    """

    box: np.ndarray
    weight: float
    former: np.ndarray | None = None


def draw_close_up(frame: Frame, label: CloseUpLabel) -> np.ndarray:
    """Return (260, 650, 3) uint8 RGB: the camera image on the left, the points on the right.

    Of several cameras, the one that shows most of the label is drawn. If none shows it, the left
    part says so; without images, it is left out.
    """
    wide = _WIDE if any(camera.image is not None for camera in frame.cameras) else 0
    canvas = Canvas(wide + _SIDE, _SIDE, DARK.background)
    red, green, blue = weight_colours(np.array([label.weight]))[0].tolist()
    colour = (red, green, blue)
    boxes = label.box[None] if label.former is None else np.stack([label.box, label.former])
    _draw_above(canvas, frame, boxes, colour)
    if wide:
        [number] = camera_of_boxes(boxes[:1], frame.cameras)
        _draw_image(canvas, frame.cameras[number] if number >= 0 else None, boxes, colour)
    return canvas.finish()


def _draw_above(
    canvas: Canvas, frame: Frame, boxes: np.ndarray, colour: tuple[int, int, int]
) -> None:
    """Draw the right part: the points within a few metres; x (forward) points up."""
    reach = _REACH_METRES
    x, y = boxes[0, :2]
    region = Region(x - reach, x + reach, y - reach, y + reach, _SIDE / (2 * reach))
    near = (np.abs(frame.points[:, :2] - boxes[0, :2]) < reach).all(axis=1)
    points = frame.points[near]
    points = points[np.argsort(points[:, 2], kind="stable")]
    # Region reserves space for a title, which a close-up does not have.
    shift = np.array([canvas.width - _SIDE, -region.to_pixels(np.array([region.x_max, y]))[1]])
    places = region.to_pixels(points[:, :2].astype(np.float64)) + shift
    canvas.dots(places, height_shades(points[:, 2]))
    outlines = region.to_pixels(bev_corners(boxes)) + shift
    sides = np.stack([outlines, np.roll(outlines, -1, axis=1)], axis=2)
    canvas.lines(outlines[:1], colour, 2.0, closed=True)
    front = (outlines[0, 0] + outlines[0, 3]) / 2
    canvas.lines(np.stack([outlines[0].mean(axis=0), front]), colour, 1.5)
    for side in sides[1:]:
        canvas.dashes(side, DARK.text, 1.2, REPREDICTION_DASHES)


def _draw_image(
    canvas: Canvas, camera: Camera | None, boxes: np.ndarray, colour: tuple[int, int, int]
) -> None:
    """Draw the left part: the camera image around the label; None if no camera shows it."""
    canvas.box(0, 0, _WIDE, _SIDE, DARK.panel)
    if camera is None or camera.image is None:
        canvas.text(20, _SIDE / 2, "outside the image", DARK.text)
        return
    rectangle = image_rectangles(boxes[:1], camera.calibration, camera.image_size)[0]
    window = _window(rectangle, camera.image_size)
    left, top, right, bottom = window
    factor = min(_WIDE / (right - left), _SIDE / (bottom - top))
    size = (round((right - left) * factor), round((bottom - top) * factor))
    corner = np.array([(_WIDE - size[0]) // 2, (_SIDE - size[1]) // 2])
    canvas.image(int(corner[0]), int(corner[1]), *size, camera.image[top:bottom, left:right])
    strokes = box_strokes(boxes, camera.calibration, camera.image_size)
    low, high = corner, corner + np.array(size)
    for index, box_lines in enumerate(strokes):
        places = (box_lines - np.array([left, top])) * factor + corner
        inside = places[((places >= low) & (places <= high)).all(axis=(1, 2))]
        if index:
            canvas.dashes(inside, DARK.text, 1.2, REPREDICTION_DASHES)
        elif len(inside):
            canvas.lines(inside, DARK.background, 3.2)
            canvas.lines(inside, colour, 1.8)


def _window(rectangle: np.ndarray, image_size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom of the image part around a rectangle, in pixels."""
    middle = (rectangle[:2] + rectangle[2:]) / 2
    half = (rectangle[2:] - rectangle[:2]) * (0.5 + _MARGIN_SHARE)
    height = max(half[1], half[0] * _SIDE / _WIDE, _LEAST_PIXELS)
    half = np.array([height * _WIDE / _SIDE, height])
    low = np.floor(np.clip(middle - half, 0, image_size)).astype(int)
    high = np.ceil(np.clip(middle + half, 0, image_size)).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
