"""One picture of a frame: the image with the boxes over it, and below it the same from above."""

from dataclasses import replace

import numpy as np

from curate.errors import DataError
from curate.frames import Frame
from curate.viewing.bird_eye import Region, draw_bird_eye
from curate.viewing.overlay import draw_overlay
from curate.viewing.tags import ShownLabels, ShownRepredictions


def draw_frame(
    frame: Frame,
    labels: ShownLabels,
    truth_boxes: np.ndarray | None = None,
    repredictions: ShownRepredictions | None = None,
    *,
    human_boxes: np.ndarray | None = None,
    title: str = "",
) -> np.ndarray:
    """The picture.

    Args:
        frame: with its image.
        labels: coloured by weight.
        truth_boxes: (m, 7) ground truth in the LiDAR frame; None where it is unknown.
        repredictions: None where none are to be shown.
        human_boxes: (h, 7) what people decided on; None for none.
        title: written at the top.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        DataError: the frame has no image.
    """
    if frame.image is None:
        raise DataError(f"frame {frame.frame_id}: the data set has no image")
    overlay = draw_overlay(
        frame.image,
        frame.calibration,
        labels,
        truth_boxes,
        repredictions=repredictions,
        human_boxes=human_boxes,
        title=title,
        legend=False,
    )
    region = Region()
    half = overlay.shape[1] / region.pixels_per_metre / 2
    below = draw_bird_eye(
        frame.points,
        labels,
        truth_boxes,
        repredictions=repredictions,
        human_boxes=human_boxes,
        region=replace(region, y_min=-half, y_max=half),
    )
    return np.concatenate([overlay, below])
