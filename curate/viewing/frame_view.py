"""Draw a frame: the images of its cameras with the boxes over them, and the bird's eye view."""

from dataclasses import replace

import numpy as np

from curate.frames import Camera, Frame
from curate.geometry.projection import camera_of_boxes
from curate.viewing.bird_eye import Region, bird_eye_size, paint_bird_eye, region_around
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
        frame: a frame with its images, or without.
        labels: labels, coloured by weight.
        truth_boxes: (m, 7) ground truth in the LiDAR frame; None if unknown.
        repredictions: repredictions; None to draw none.
        title: text at the top.
    """
    shown = FrameContent(labels, truth_boxes, repredictions, title)
    return paint_frame(frame, shown).finish()


def paint_frame(frame: Frame, shown: FrameContent, kind: ImageFormat = "png") -> Canvas:
    """Return a canvas with the drawn frame; `Canvas.content` encodes it.

    Every image that shows a label is drawn, of one camera in any case, and the bird's eye view
    below. Without images, the bird's eye view is drawn alone.

    Args:
        frame: a frame with its images, or without.
        shown: the boxes.
        kind: format to encode; for pdf and svg, lines and texts are vectors.
    """
    cameras = _shown_cameras(frame, shown.labels.boxes)
    images = [camera.image for camera in cameras if camera.image is not None]
    sizes = [overlay_size(image) for image in images]
    width = max((size[0] for size in sizes), default=Region().size[0])
    boxes = [shown.labels.boxes, shown.valid_truth]
    region = region_around(boxes, width)
    below, above = bird_eye_size(region)[1], sum(height for _, height in sizes)
    kind_of_canvas = Canvas if kind == "png" else VectorCanvas
    canvas = kind_of_canvas(width, above + below, shown.style.background)
    top = 0
    for camera, image, (_, height) in zip(cameras, images, sizes, strict=True):
        title = ", ".join(filter(None, (shown.title if top == 0 else "", camera.name)))
        part = canvas.part(top, height)
        paint_overlay(part, image, camera.calibration, replace(shown, title=title))
        top += height
    title = "" if images else shown.title
    paint_bird_eye(canvas.part(above, below), frame.points, replace(shown, title=title), region)
    return canvas


def _shown_cameras(frame: Frame, boxes: np.ndarray) -> list[Camera]:
    """Return the cameras with images that show most of a label; the first if none does."""
    cameras = [camera for camera in frame.cameras if camera.image is not None]
    chosen = set(camera_of_boxes(boxes, cameras).tolist())
    return [camera for number, camera in enumerate(cameras) if number in chosen] or cameras[:1]
