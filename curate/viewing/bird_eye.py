"""Bird's eye view: the sweep from above with labels coloured by weight; x (forward) points up."""

from dataclasses import dataclass

import numpy as np

from curate.geometry.boxes import bev_corners
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
from curate.viewing.palette import (
    BACKGROUND,
    FAINT_TEXT,
    GRID,
    GROUND_TRUTH,
    HUMAN,
    TEXT,
    height_shades,
    weight_colours,
)
from curate.viewing.tags import ShownLabels, ShownRepredictions, draw_tags

_RING_METRES = 10.0
_SCALE_BAR_METRES = 10.0


@dataclass(frozen=True)
class Region:
    """The part of the LiDAR frame that the picture shows, in metres.

    Attributes:
        x_min: nearest; the LiDAR stands at x = 0.
        x_max: farthest ahead.
        y_min: rightmost, as y points left.
        y_max: leftmost.
        pixels_per_metre: scale of the picture.
    """

    x_min: float = -2.0
    x_max: float = 62.0
    y_min: float = -36.0
    y_max: float = 36.0
    pixels_per_metre: float = 14.0

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        scale = self.pixels_per_metre
        return round((self.y_max - self.y_min) * scale), round((self.x_max - self.x_min) * scale)

    def to_pixels(self, places: np.ndarray) -> np.ndarray:
        """(..., 2) x and y in metres to pixels from the left and from the top of the canvas."""
        across = (self.y_max - places[..., 1]) * self.pixels_per_metre
        down = (self.x_max - places[..., 0]) * self.pixels_per_metre + TITLE_HEIGHT
        return np.stack([across, down], axis=-1)


_DEFAULT_REGION = Region()


def draw_bird_eye(
    points: np.ndarray,
    labels: ShownLabels,
    truth_boxes: np.ndarray | None = None,
    *,
    repredictions: ShownRepredictions | None = None,
    human_boxes: np.ndarray | None = None,
    region: Region = _DEFAULT_REGION,
    title: str = "",
) -> np.ndarray:
    """The picture.

    Args:
        points: (n, >=3) LiDAR points in metres.
        labels: coloured by weight, the highest on top, with captions where there is room.
        truth_boxes: (m, 7) ground truth in the LiDAR frame, dotted; None where it is unknown.
        repredictions: dashed, in the colour of the label that each was matched with.
        human_boxes: (h, 7) what people decided on, in long dashes; None for none.
        region: what to show, and how large.
        title: written at the top.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    width, height = region.size
    canvas = Canvas(width, height + TITLE_HEIGHT + STRIP_HEIGHT, BACKGROUND)
    _draw_rings(canvas, region)
    _draw_points(canvas, region, points)
    footprints = region.to_pixels(bev_corners(labels.boxes))
    emphasis = labels.emphasis
    for index in np.argsort(emphasis, kind="stable"):
        _draw_label(canvas, footprints[index], labels.colour(int(index)), emphasis[index])
    if repredictions is not None:
        _draw_repredictions(canvas, region, repredictions)
    if human_boxes is not None:
        canvas.dashes(_sides(human_boxes, region), HUMAN, 2.0, HUMAN_DASHES)
    if truth_boxes is not None:
        _draw_truth(canvas, region, truth_boxes)
    anchors = np.concatenate([footprints.min(axis=1), footprints.max(axis=1)], axis=1)
    draw_tags(canvas, labels, anchors, np.array([0, TITLE_HEIGHT, width, TITLE_HEIGHT + height]))
    draw_title(canvas, title, "bird's eye view, x forward, metres")
    draw_legend(
        canvas,
        zero_weight=labels.zero_weight,
        truth=truth_boxes is not None,
        repredictions=repredictions is not None,
        unweighted=bool(np.isnan(labels.weights).any()),
        human=human_boxes is not None and len(human_boxes) > 0,
    )
    _draw_scale_bar(canvas, region)
    return canvas.finish()


def _draw_label(canvas: Canvas, footprint: np.ndarray, colour: Colour, weight: float) -> None:
    """A footprint with its heading; the outline grows with the weight."""
    stroke = 1.0 if weight <= 0 else 1.4 + 1.2 * float(weight)
    canvas.fill(footprint, colour, 0.0 if weight <= 0 else 0.12 + 0.22 * float(weight))
    canvas.lines(footprint, colour, stroke, closed=True)
    front = (footprint[0] + footprint[3]) / 2
    ahead = front + 0.35 * (front - footprint.mean(axis=0))
    canvas.lines(np.stack([footprint.mean(axis=0), ahead]), colour, stroke)


def _draw_truth(canvas: Canvas, region: Region, boxes: np.ndarray) -> None:
    """Footprints without regions that have no box, dotted and over the labels."""
    known = boxes[~np.isnan(boxes).any(axis=1)]
    canvas.dashes(_sides(known, region), GROUND_TRUTH, 1.5, TRUTH_DOTS)


def _draw_repredictions(canvas: Canvas, region: Region, shown: ShownRepredictions) -> None:
    """Footprints in dashes, the highest weight on top."""
    sides = _sides(shown.boxes, region).reshape(-1, 4, 2, 2)
    colours = weight_colours(shown.weights).tolist()
    for index in np.argsort(shown.weights, kind="stable"):
        canvas.dashes(sides[index], tuple(colours[index]), 1.2, REPREDICTION_DASHES)


def _sides(boxes: np.ndarray, region: Region) -> np.ndarray:
    """(4 n, 2, 2) start and end in pixels of the sides of n footprints."""
    corners = region.to_pixels(bev_corners(boxes))
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)


def _draw_points(canvas: Canvas, region: Region, points: np.ndarray) -> None:
    order = np.argsort(points[:, 2], kind="stable")
    places = region.to_pixels(points[order, :2].astype(np.float64))
    canvas.dots(places, height_shades(points[order, 2]))


def _draw_rings(canvas: Canvas, region: Region) -> None:
    """Distances from the LiDAR, and the LiDAR itself."""
    origin = region.to_pixels(np.zeros(2))
    for metres in np.arange(_RING_METRES, region.x_max + _RING_METRES, _RING_METRES):
        canvas.circle(origin, metres * region.pixels_per_metre, GRID, 1)
        label = region.to_pixels(np.array([metres, 0.0]))
        canvas.text(label[0] + 4, label[1] - 4, f"{metres:.0f} m", FAINT_TEXT, 10.5)
    arrow = np.array([[0.0, -10], [7, 8], [-7, 8]]) + origin
    canvas.fill(arrow, TEXT, 0.9)


def _draw_scale_bar(canvas: Canvas, region: Region) -> None:
    length = _SCALE_BAR_METRES * region.pixels_per_metre
    right, level = canvas.width - 14.0, canvas.height - 16.0
    bar = np.array([[right - length, level - 5], [right - length, level], [right, level]])
    canvas.lines(np.vstack([bar, [[right, level - 5]]]), TEXT, 1.5)
    canvas.text(right - length + 6, level - 5, f"{_SCALE_BAR_METRES:.0f} m", TEXT, 12)
