"""A segmenter of the toy frames that shows their cars."""

from pathlib import Path

import numpy as np

from curate.frames import Frame
from curate.geometry.projection import image_rectangles
from curate.segmenters.base import Segmenter, SemanticMap
from support.toys import toy_calibration

CLASSES = {"Car": (1,), "Pedestrian": (2,), "Cyclist": (3,)}
TRUTH: dict[str, np.ndarray] = {}
"""The boxes of the cars by frame; a test fills it in."""


class TrueCars(Segmenter):
    """A segmenter of the projected cars of the toy frames."""

    needs_image = False

    def __init__(self, path: Path) -> None:
        pass

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the map of a frame."""
        width, height = frame.image_size or (0, 0)
        class_ids = np.zeros((height, width), dtype=np.uint8)
        for left, top, right, bottom in image_rectangles(
            TRUTH[frame.frame_id], toy_calibration(), (width, height)
        ).tolist():
            class_ids[int(top) : int(bottom) + 1, int(left) : int(right) + 1] = 1
        return SemanticMap(class_ids, CLASSES)
