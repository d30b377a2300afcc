"""Draw a frame: the camera image with the boxes over it, and the bird's eye view below."""

from dataclasses import replace

import numpy as np

from curate.errors import DataError
from curate.frames import Frame
from curate.viewing.bird_eye import bird_eye_size, paint_bird_eye, region_around
from curate.viewing.canvas import Canvas
from curate.viewing.chart_style import ImageFormat
from curate.viewing.overlay import FrameContent, overlay_size, paint_overlay
from curate.viewing.tags import ShownLabels, ShownRepredictions
from curate.viewing.vector_canvas import VectorCanvas


def draw_frame(
    frame: Frame,
    labels: ShownLabels,
    truth_boxes: np.ndarray | None = None,
    repredictions: ShownRepredictions | None = None,
    *,
    title: str = "",
) -> np.ndarray:
    """Return the drawn frame in the dark style, (height, width, 3) uint8 RGB.

    Args:
        frame: a frame with its image.
        labels: labels, coloured by weight.
        truth_boxes: (m, 7) ground truth in the LiDAR frame; None if unknown.
        repredictions: repredictions; None to draw none.
        title: text at the top.

    Raises:
        DataError: if the frame has no image.
    """
    shown = FrameContent(labels, truth_boxes, repredictions, title)
    return paint_frame(frame, shown).finish()


def paint_frame(frame: Frame, shown: FrameContent, kind: ImageFormat = "png") -> Canvas:
    """Return a canvas with the drawn frame; `Canvas.content` encodes it.

    Args:
        frame: a frame with its image.
        shown: the boxes.
        kind: format to encode; for pdf and svg, lines and texts are vectors.

    Raises:
        DataError: if the frame has no image.
    """
    if frame.image is None:
        raise DataError(f"frame {frame.frame_id}: the data set has no image")
    width, above = overlay_size(frame.image)
    region = region_around([shown.labels.boxes, shown.valid_truth], width)
    below = bird_eye_size(region)[1]
    kind_of_canvas = Canvas if kind == "png" else VectorCanvas
    canvas = kind_of_canvas(width, above + below, shown.style.background)
    paint_overlay(canvas.part(0, above), frame.image, frame.calibration, shown)
    paint_bird_eye(canvas.part(above, below), frame.points, replace(shown, title=""), region)
    return canvas
