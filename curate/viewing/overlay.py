"""The camera's image with the labels' 3D boxes over it, coloured by weight."""

import numpy as np

from curate.frames import Calibration
from curate.geometry.boxes import box_corners
from curate.geometry.projection import image_rectangles
from curate.viewing.canvas import Canvas, Colour
from curate.viewing.legend import (
    HUMAN_DASHES,
    REPREDICTION_DASHES,
    STRIP_HEIGHT,
    TITLE_HEIGHT,
    TRUTH_DOTS,
    draw_legend,
    draw_title,
)
from curate.viewing.palette import BACKGROUND, GROUND_TRUTH, HUMAN, weight_colours
from curate.viewing.tags import ShownLabels, ShownRepredictions, draw_tags

_LEAST_WIDTH = 1200
_NEAR_METRES = 0.1
# Pairs of `box_corners`: the front face first, then the rear face and what joins them.
_STARTS = np.array([0, 3, 7, 4, 1, 2, 6, 5, 0, 3, 7, 4])
_ENDS = np.array([3, 7, 4, 0, 2, 6, 5, 1, 1, 2, 6, 5])
_FRONT_EDGES = 4
# Far outside any image; a stroke that runs farther is not worth its numbers.
_PIXEL_LIMIT = 10_000.0


def draw_overlay(
    image: np.ndarray,
    calibration: Calibration,
    labels: ShownLabels,
    truth_boxes: np.ndarray | None = None,
    *,
    repredictions: ShownRepredictions | None = None,
    human_boxes: np.ndarray | None = None,
    title: str = "",
    legend: bool = True,
) -> np.ndarray:
    """The picture.

    Args:
        image: (h, w, 3) uint8 RGB; enlarged by a whole factor where it is small.
        calibration: of the frame.
        labels: coloured by weight, far ones first, with captions where there is room.
        truth_boxes: (m, 7) ground truth in the LiDAR frame, dotted; None where it is unknown.
        repredictions: dashed, in the colour of the label that each was matched with.
        human_boxes: (h, 7) what people decided on, in long dashes; None for none.
        title: written above the image.
        legend: false leaves out the strip below it, where another picture brings it.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    height, width = image.shape[:2]
    factor = max(1, -(-_LEAST_WIDTH // width))
    shown = (width * factor, height * factor)
    canvas = Canvas(shown[0], shown[1] + TITLE_HEIGHT + legend * STRIP_HEIGHT, BACKGROUND)
    canvas.image(0, TITLE_HEIGHT, *shown, image)
    offset = np.array([0.0, TITLE_HEIGHT])
    if truth_boxes is not None:
        known = truth_boxes[~np.isnan(truth_boxes).any(axis=1)]
        for strokes in box_strokes(known, calibration, (width, height)):
            canvas.dashes(strokes * factor + offset, GROUND_TRUTH, 1.6, TRUTH_DOTS)
    if repredictions is not None:
        strokes_of = box_strokes(repredictions.boxes, calibration, (width, height))
        colours = weight_colours(repredictions.weights).tolist()
        for strokes, colour in zip(strokes_of, colours, strict=True):
            canvas.dashes(strokes * factor + offset, tuple(colour), 1.3, REPREDICTION_DASHES)
    strokes_of = box_strokes(labels.boxes, calibration, (width, height))
    for index in np.argsort(-np.linalg.norm(labels.boxes[:, :2], axis=1), kind="stable"):
        weight = float(labels.emphasis[index])
        stroke = 1.0 if weight <= 0 else 1.5 + weight
        strokes = strokes_of[index] * factor + offset
        _draw_strokes(
            canvas, strokes, labels.colour(int(index)), stroke, shade=0.22 if weight > 0 else 0.0
        )
    if human_boxes is not None:
        for strokes in box_strokes(human_boxes, calibration, (width, height)):
            canvas.dashes(strokes * factor + offset, HUMAN, 2.0, HUMAN_DASHES)
    rectangles = image_rectangles(labels.boxes, calibration, (width, height))
    anchors = rectangles * factor + np.tile(offset, 2)
    bounds = np.array([0, TITLE_HEIGHT, shown[0], TITLE_HEIGHT + shown[1]])
    draw_tags(canvas, labels, anchors, bounds)
    draw_title(canvas, title, "camera image")
    if legend:
        draw_legend(
            canvas,
            zero_weight=labels.zero_weight,
            truth=truth_boxes is not None,
            repredictions=repredictions is not None,
            unweighted=bool(np.isnan(labels.weights).any()),
            human=human_boxes is not None and len(human_boxes) > 0,
        )
    return canvas.finish()


def box_strokes(
    boxes: np.ndarray, calibration: Calibration, image_size: tuple[int, int]
) -> list[np.ndarray]:
    """The edges of each box in the image, cut where they come nearer than the near plane.

    Args:
        boxes: (n, 7) in the LiDAR frame.
        calibration: of the frame.
        image_size: (width, height) in pixels.

    Returns:
        n arrays (strokes, 2, 2) of start and end in pixels: 12 where the box is wholly ahead, those
        around its front face first; fewer where it is partly behind; none where the image does
        not show the box.
    """
    seen = ~np.isnan(image_rectangles(boxes, calibration, image_size)).any(axis=1)
    matrix = calibration.lidar_to_image
    corners = box_corners(boxes) @ matrix[:, :3].T + matrix[:, 3]
    return [
        _project_strokes(own[_STARTS], own[_ENDS]) if visible else np.zeros((0, 2, 2))
        for own, visible in zip(corners, seen, strict=True)
    ]


def _project_strokes(starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """(strokes, 2, 2) pixels of strokes between (n, 3) homogeneous image points."""
    ahead = (starts[:, 2] > _NEAR_METRES) | (ends[:, 2] > _NEAR_METRES)
    starts, ends = starts[ahead], ends[ahead]
    strokes = np.stack([_drawn_ahead(starts, ends), _drawn_ahead(ends, starts)], axis=1)
    pixels = strokes[..., :2] / strokes[..., 2:]
    limited: np.ndarray = np.clip(pixels, -_PIXEL_LIMIT, _PIXEL_LIMIT)
    return limited


def _drawn_ahead(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Points behind the near plane, moved towards the others until they lie on it."""
    depth, other_depth = points[:, 2], others[:, 2]
    behind = depth < _NEAR_METRES
    share = np.where(behind, (_NEAR_METRES - depth) / np.where(behind, other_depth - depth, 1), 0)
    moved: np.ndarray = points + share[:, None] * (others - points)
    # The sum leaves nothing of the near plane where a box is as large as the universe.
    moved[behind, 2] = _NEAR_METRES
    return moved


def _draw_strokes(
    canvas: Canvas, strokes: np.ndarray, colour: Colour, width: float, *, shade: float
) -> None:
    """A box with its front face shaded; a dark rim keeps it apart from a light image."""
    if shade > 0 and len(strokes) == len(_STARTS):
        canvas.fill(strokes[:_FRONT_EDGES, 0], colour, shade)
    if len(strokes):
        canvas.lines(strokes, BACKGROUND, width + 1.6)
        canvas.lines(strokes, colour, width)
