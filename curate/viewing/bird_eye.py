"""Draw a bird's eye view: the sweep with labels coloured by weight; x (forward) points up."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.geometry.boxes import bev_corners
from curate.viewing.canvas import Canvas
from curate.viewing.legend import (
    HUMAN_DASHES,
    REPREDICTION_DASHES,
    STRIP_HEIGHT,
    TITLE_HEIGHT,
    TRUTH_DOTS,
    UNSEEN_STROKE,
    draw_cross,
    draw_title,
)
from curate.viewing.overlay import FrameContent
from curate.viewing.palette import DARK, Colour, Style, height_shades, weight_colours
from curate.viewing.tags import ShownLabels, ShownRepredictions, draw_tags

_RING_METRES = 10.0
_SCALE_BAR_METRES = 10.0
# Only a broken detector predicts boxes farther away; they must not make the rest of the image tiny.
_FARTHEST_METRES = 120.0
_MARGIN_METRES = 2.0


@dataclass(frozen=True)
class Region:
    """The part of the LiDAR frame that the image shows, in metres.

    Attributes:
        x_min: lower edge of the image; the LiDAR is at x = 0.
        x_max: upper edge.
        y_min: right edge, because y points left.
        y_max: left edge.
        pixels_per_metre: scale of the image.
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
        """Convert (..., 2) x and y in metres to pixels from the left and the top of the canvas."""
        across = (self.y_max - places[..., 1]) * self.pixels_per_metre
        down = (self.x_max - places[..., 0]) * self.pixels_per_metre + TITLE_HEIGHT
        return np.stack([across, down], axis=-1)


def region_around(boxes: Sequence[np.ndarray], width: int) -> Region:
    """Return the default region, extended to contain all boxes, also those behind the LiDAR.

    Args:
        boxes: arrays (n, 7) in the LiDAR frame.
        width: width of the image in pixels.
    """
    default = Region()
    corners = bev_corners(np.concatenate([np.zeros((0, 7)), *boxes])).reshape(-1, 2)
    corners = np.clip(corners, -_FARTHEST_METRES, _FARTHEST_METRES)
    low, high = corners.min(axis=0, initial=np.inf), corners.max(axis=0, initial=-np.inf)
    half = max(
        width / default.pixels_per_metre / 2, high[1] + _MARGIN_METRES, _MARGIN_METRES - low[1]
    )
    return Region(
        min(default.x_min, low[0] - _MARGIN_METRES),
        max(default.x_max, high[0] + _MARGIN_METRES),
        -half,
        half,
        width / (2 * half),
    )


def draw_bird_eye(
    points: np.ndarray,
    labels: ShownLabels,
    truth_boxes: np.ndarray | None = None,
    *,
    region: Region | None = None,
    title: str = "",
    style: Style = DARK,
) -> np.ndarray:
    """Return the image, (height, width, 3) uint8 RGB.

    Args:
        points: (n, >=3) LiDAR points in metres.
        labels: see `FrameContent`.
        truth_boxes: see `FrameContent`.
        region: the region to show and its scale; None for one that contains all boxes.
        title: text at the top.
        style: colours.
    """
    shown = FrameContent(labels, truth_boxes, title=title, style=style)
    region = region or region_around([labels.boxes, shown.valid_truth], Region().size[0])
    canvas = Canvas(*bird_eye_size(region), style.background)
    paint_bird_eye(canvas, points, shown, region)
    return canvas.finish()


def bird_eye_size(region: Region) -> tuple[int, int]:
    """Return width and height of the image of a region, in pixels."""
    width, height = region.size
    return width, height + TITLE_HEIGHT + STRIP_HEIGHT


def paint_bird_eye(canvas: Canvas, points: np.ndarray, shown: FrameContent, region: Region) -> None:
    """Draw the points, all boxes with the highest weight on top, and the legend.

    Args:
        canvas: canvas of the size `bird_eye_size`.
        points: (n, >=3) LiDAR points in metres.
        shown: the boxes.
        region: the region to show.
    """
    style, labels, (width, height) = shown.style, shown.labels, region.size
    _draw_rings(canvas, region, style)
    _draw_points(canvas, region, points, style)
    footprints = region.to_pixels(bev_corners(labels.boxes))
    for index in np.argsort(labels.emphasis, kind="stable").tolist():
        colour = labels.colour(index, style)
        _draw_label(canvas, footprints[index], colour, labels.emphasis[index])
        if labels.unseen is not None and labels.unseen[index]:
            canvas.lines(footprints[index][[[0, 2], [1, 3]]], colour, UNSEEN_STROKE)
    if shown.repredictions is not None:
        _draw_repredictions(canvas, region, shown.repredictions, style)
    for footprint in footprints[labels.is_rejected]:
        draw_cross(canvas, footprint, style)
    human = labels.boxes[labels.is_human]
    canvas.dashes(_sides(human, region), style.human, 2.0, HUMAN_DASHES)
    canvas.dashes(_sides(shown.valid_truth, region), style.ground_truth, 1.5, TRUTH_DOTS)
    anchors = np.concatenate([footprints.min(axis=1), footprints.max(axis=1)], axis=1)
    bounds = np.array([0, TITLE_HEIGHT, width, TITLE_HEIGHT + height])
    draw_tags(canvas, labels, anchors, bounds, style)
    draw_title(canvas, shown.title, "bird's eye view, x forward, metres", style)
    shown.draw_legend(canvas)
    _draw_scale_bar(canvas, region, style)


def _draw_label(canvas: Canvas, footprint: np.ndarray, colour: Colour, weight: float) -> None:
    """Draw a footprint with its heading; the line width increases with the weight."""
    stroke = 1.0 if weight <= 0 else 1.4 + 1.2 * float(weight)
    canvas.fill(footprint, colour, 0.0 if weight <= 0 else 0.12 + 0.22 * float(weight))
    canvas.lines(footprint, colour, stroke, closed=True)
    front = (footprint[0] + footprint[3]) / 2
    ahead = front + 0.35 * (front - footprint.mean(axis=0))
    canvas.lines(np.stack([footprint.mean(axis=0), ahead]), colour, stroke)


def _draw_repredictions(
    canvas: Canvas, region: Region, shown: ShownRepredictions, style: Style
) -> None:
    """Draw dashed footprints, the highest weight on top."""
    sides = _sides(shown.boxes, region).reshape(-1, 4, 2, 2)
    colours = weight_colours(shown.weights, style).tolist()
    for index in np.argsort(shown.weights, kind="stable"):
        canvas.dashes(sides[index], tuple(colours[index]), 1.2, REPREDICTION_DASHES)


def _sides(boxes: np.ndarray, region: Region) -> np.ndarray:
    """Return (4 n, 2, 2) start and end of the sides of n footprints, in pixels."""
    corners = region.to_pixels(bev_corners(boxes))
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)


def _draw_points(canvas: Canvas, region: Region, points: np.ndarray, style: Style) -> None:
    order = np.argsort(points[:, 2], kind="stable")
    places = region.to_pixels(points[order, :2].astype(np.float64))
    canvas.dots(places, height_shades(points[order, 2], style))


def _draw_rings(canvas: Canvas, region: Region, style: Style) -> None:
    """Draw circles of equal distance from the LiDAR, and the LiDAR itself."""
    origin = region.to_pixels(np.zeros(2))
    farthest = max(region.x_max, -region.x_min, region.y_max)
    for metres in np.arange(_RING_METRES, farthest + _RING_METRES, _RING_METRES):
        canvas.circle(origin, metres * region.pixels_per_metre, style.grid, 1)
        label = region.to_pixels(np.array([metres, 0.0]))
        canvas.text(label[0] + 4, label[1] - 4, f"{metres:.0f} m", style.faint_text, 10.5)
    arrow = np.array([[0.0, -10], [7, 8], [-7, 8]]) + origin
    canvas.fill(arrow, style.text, 0.9)


def _draw_scale_bar(canvas: Canvas, region: Region, style: Style) -> None:
    length = _SCALE_BAR_METRES * region.pixels_per_metre
    right, level = canvas.width - 14.0, canvas.height - 16.0
    bar = np.array([[right - length, level - 5], [right - length, level], [right, level]])
    canvas.lines(np.vstack([bar, [[right, level - 5]]]), style.text, 1.5)
    canvas.text(right - length + 6, level - 5, f"{_SCALE_BAR_METRES:.0f} m", style.text, 12)
