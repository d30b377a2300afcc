"""Draw the 3D boxes of labels over the camera image, coloured by weight."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.frames import Calibration
from curate.geometry.boxes import box_corners
from curate.geometry.projection import image_rectangles
from curate.viewing.canvas import Canvas
from curate.viewing.legend import (
    HUMAN_DASHES,
    REPREDICTION_DASHES,
    STRIP_HEIGHT,
    TITLE_HEIGHT,
    TRUTH_DOTS,
    draw_cross,
    draw_legend,
    draw_title,
)
from curate.viewing.palette import DARK, Colour, Style, weight_colours
from curate.viewing.tags import ShownLabels, ShownRepredictions, draw_tags

_Pattern = tuple[float, float]

_LEAST_WIDTH = 1200
_NEAR_METRES = 0.1
# Pairs of `box_corners`: the front face, then the rear face, then the edges between them.
_STARTS = np.array([0, 3, 7, 4, 1, 2, 6, 5, 0, 3, 7, 4])
_ENDS = np.array([3, 7, 4, 0, 2, 6, 5, 1, 1, 2, 6, 5])
_FRONT_EDGES = 4
# Far outside any image; pixel coordinates are limited to this value.
_PIXEL_LIMIT = 10_000.0


@dataclass(frozen=True)
class FrameContent:
    """The boxes, title and style of a drawn frame, for the overlay and the bird's eye view.

    Attributes:
        labels: labels, coloured by weight, with captions.
        truth_boxes: (m, 7) ground truth in the LiDAR frame, dotted; None if unknown.
        repredictions: repredictions, dashed, each in the colour of its matched label.
        title: text at the top.
        style: colours.
    """

    labels: ShownLabels
    truth_boxes: np.ndarray | None = None
    repredictions: ShownRepredictions | None = None
    title: str = ""
    style: Style = DARK

    @property
    def valid_truth(self) -> np.ndarray:
        """(m, 7) ground truth without DontCare regions, which have no 3D box."""
        if self.truth_boxes is None:
            return np.zeros((0, 7))
        valid: np.ndarray = self.truth_boxes[~np.isnan(self.truth_boxes).any(axis=1)]
        return valid

    def draw_legend(self, canvas: Canvas) -> None:
        """Draw the legend at the bottom."""
        draw_legend(
            canvas,
            zero_weight=self.labels.zero_weight,
            truth=self.truth_boxes is not None,
            repredictions=self.repredictions is not None,
            unweighted=bool(np.isnan(self.labels.weights).any()),
            human=bool(self.labels.is_human.any()),
            rejected=bool(self.labels.is_rejected.any()),
            unseen=self.labels.unseen is not None and bool(self.labels.unseen.any()),
            style=self.style,
        )


def draw_overlay(
    image: np.ndarray,
    calibration: Calibration,
    labels: ShownLabels,
    truth_boxes: np.ndarray | None = None,
    *,
    title: str = "",
    style: Style = DARK,
) -> np.ndarray:
    """Return the overlay with a legend, (height, width, 3) uint8 RGB.

    Args:
        image: (h, w, 3) uint8 RGB camera image; a small image is enlarged by a whole factor.
        calibration: calibration of the frame.
        labels: see `FrameContent`.
        truth_boxes: see `FrameContent`.
        title: text above the image.
        style: colours.
    """
    width, height = overlay_size(image)
    canvas = Canvas(width, height + STRIP_HEIGHT, style.background)
    shown = FrameContent(labels, truth_boxes, title=title, style=style)
    paint_overlay(canvas.part(0, height), image, calibration, shown)
    shown.draw_legend(canvas)
    return canvas.finish()


def overlay_size(image: np.ndarray) -> tuple[int, int]:
    """Return width and height of the overlay without its legend, in pixels."""
    height, width = image.shape[:2]
    factor = _enlargement(image)
    return width * factor, height * factor + TITLE_HEIGHT


def paint_overlay(
    canvas: Canvas, image: np.ndarray, calibration: Calibration, shown: FrameContent
) -> None:
    """Draw an image and all boxes over it, far labels first.

    Args:
        canvas: canvas of the size `overlay_size`.
        image: (h, w, 3) uint8 RGB.
        calibration: calibration of the frame.
        shown: the boxes.
    """
    height, width = image.shape[:2]
    factor, style, labels = _enlargement(image), shown.style, shown.labels
    size, within = (width, height), canvas.part(TITLE_HEIGHT, canvas.height - TITLE_HEIGHT)
    within.image(0, 0, width * factor, height * factor, image)

    def dash(
        boxes: np.ndarray, colours: Sequence[Colour], stroke: float, pattern: _Pattern
    ) -> None:
        for strokes, colour in zip(box_strokes(boxes, calibration, size), colours, strict=True):
            within.dashes(strokes * factor, colour, stroke, pattern)

    truth = shown.valid_truth
    dash(truth, [style.ground_truth] * len(truth), 1.6, TRUTH_DOTS)
    if shown.repredictions is not None:
        colours = [tuple(c) for c in weight_colours(shown.repredictions.weights, style).tolist()]
        dash(shown.repredictions.boxes, colours, 1.3, REPREDICTION_DASHES)
    strokes_of = box_strokes(labels.boxes, calibration, size)
    for index in np.argsort(-np.linalg.norm(labels.boxes[:, :2], axis=1), kind="stable").tolist():
        weight = float(labels.emphasis[index])
        _draw_strokes(
            within, strokes_of[index] * factor, labels.colour(index, style), weight, style
        )
    for index in np.flatnonzero(labels.is_rejected):
        if len(strokes_of[index]) == len(_STARTS):
            draw_cross(within, strokes_of[index][:_FRONT_EDGES, 0] * factor, style)
    human = labels.boxes[labels.is_human]
    dash(human, [style.human] * len(human), 2.0, HUMAN_DASHES)
    anchors = image_rectangles(labels.boxes, calibration, size) * factor
    bounds = np.array([0, 0, width * factor, height * factor])
    draw_tags(within, labels, anchors, bounds, style)
    draw_title(
        canvas,
        shown.title,
        "camera image; a label: k, weight, category, score, LiDAR points",
        style,
    )


def _enlargement(image: np.ndarray) -> int:
    """Return the whole factor that makes a small image large enough for readable captions."""
    return int(max(1, -(-_LEAST_WIDTH // image.shape[1])))


def box_strokes(
    boxes: np.ndarray, calibration: Calibration, image_size: tuple[int, int]
) -> list[np.ndarray]:
    """Return the edges of each box in the image, clipped at the near plane of the camera.

    Args:
        boxes: (n, 7) in the LiDAR frame.
        calibration: calibration of the frame.
        image_size: (width, height) in pixels.

    Returns:
        n arrays (strokes, 2, 2) of start and end in pixels. A box in front of the camera has 12
        strokes, the front face first; a box that is partly behind the camera has fewer; a box
        outside the image has none.
    """
    seen = ~np.isnan(image_rectangles(boxes, calibration, image_size)).any(axis=1)
    matrix = calibration.lidar_to_image
    corners = box_corners(boxes) @ matrix[:, :3].T + matrix[:, 3]
    return [
        _project_strokes(points[_STARTS], points[_ENDS]) if visible else np.zeros((0, 2, 2))
        for points, visible in zip(corners, seen, strict=True)
    ]


def _project_strokes(starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return (strokes, 2, 2) pixels of strokes between (n, 3) homogeneous image points."""
    ahead = (starts[:, 2] > _NEAR_METRES) | (ends[:, 2] > _NEAR_METRES)
    starts, ends = starts[ahead], ends[ahead]
    strokes = np.stack([_clipped_near(starts, ends), _clipped_near(ends, starts)], axis=1)
    pixels = strokes[..., :2] / strokes[..., 2:]
    limited: np.ndarray = np.clip(pixels, -_PIXEL_LIMIT, _PIXEL_LIMIT)
    return limited


def _clipped_near(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Move the points behind the near plane towards `others` until they are on the plane."""
    depth, other_depth = points[:, 2], others[:, 2]
    behind = depth < _NEAR_METRES
    share = np.where(behind, (_NEAR_METRES - depth) / np.where(behind, other_depth - depth, 1), 0)
    moved: np.ndarray = points + share[:, None] * (others - points)
    # For a gigantic box, rounding errors of the sum are larger than the near plane's depth.
    moved[behind, 2] = _NEAR_METRES
    return moved


def _draw_strokes(
    canvas: Canvas, strokes: np.ndarray, colour: Colour, weight: float, style: Style
) -> None:
    """Draw a box with a shaded front face, and a dark rim that separates it from the image."""
    width = 1.0 if weight <= 0 else 1.5 + weight
    if weight > 0 and len(strokes) == len(_STARTS):
        canvas.fill(strokes[:_FRONT_EDGES, 0], colour, 0.22)
    if len(strokes):
        canvas.lines(strokes, style.background, width + 1.6)
        canvas.lines(strokes, colour, width)
