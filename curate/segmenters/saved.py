"""Semantic maps that were computed before: one PNG of class ids per frame."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from curate.datasets.images import decode_image
from curate.errors import DataError
from curate.frames import Frame
from curate.segmenters.base import SemanticMap
from curate.segmenters.classes import checked_classes


class SavedSegmenter:
    """A `Segmenter` that reads DIRECTORY/FRAME.png, single-channel, 8 bits, one class id per pixel.

    Args:
        directory: the folder of the maps.
        classes: the class ids that count for each category.

    Raises:
        DataError: there is no such folder.
        ConfigError: a class id is out of range.
    """

    needs_image = False
    needs_points = False

    def __init__(self, directory: Path, classes: Mapping[str, Sequence[int]]) -> None:
        self.directory = Path(directory)
        self.classes = checked_classes(classes)
        if not self.directory.is_dir():
            raise DataError(f"{self.directory}: no such folder of semantic maps")

    def segment(self, frame: Frame) -> SemanticMap:
        """The frame's saved map.

        Raises:
            DataError: there is no map, or it is no map of the frame's image.
        """
        path = self.directory / f"{frame.frame_id}.png"
        class_ids = decode_image(path, cv2.IMREAD_UNCHANGED)
        width, height = frame.image_size
        if class_ids.ndim != 2 or class_ids.dtype != np.uint8:
            raise DataError(f"{path}: expected one channel of 8 bits, a class id per pixel")
        if class_ids.shape != (height, width):
            raise DataError(
                f"{path}: the map is {class_ids.shape[1]} x {class_ids.shape[0]} pixels, "
                f"the image of the frame {width} x {height}"
            )
        return SemanticMap(class_ids, self.classes)
