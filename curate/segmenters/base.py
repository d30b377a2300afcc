"""The protocol of segmenters, and the semantic map that they return."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from curate.errors import ModelError
from curate.frames import Frame
from curate.shapes import Int, UInt8


@dataclass(frozen=True)
class SemanticMap:
    """The semantic class of every pixel of a frame's image.

    Attributes:
        class_ids: (height, width) uint8.
        category_classes: for each category, the class ids that count as its pixels, e.g. bicycle
            and person for Cyclist.
        instances: (height, width) number of the object from 1, 0 for none; None if the segmenter
            does not tell objects apart. They are not stored with the maps.
    """

    class_ids: UInt8[np.ndarray, "height width"]
    category_classes: Mapping[str, tuple[int, ...]]
    instances: Int[np.ndarray, "height width"] | None = None


def image_size_of(frame: Frame) -> tuple[int, int]:
    """Return (width, height) of the frame's image in pixels.

    Raises:
        ModelError: if the frame has no camera.
    """
    if frame.image_size is None:
        raise ModelError(f"frame {frame.frame_id} has no camera, so there is no image to segment")
    return frame.image_size


class Segmenter(Protocol):
    """Returns the semantic class of every pixel; raises `ModelError` or `DataError`.

    A frame to segment has one camera: of a frame with several, each is segmented by itself, with
    the name of the camera in `frame.camera`.

    The attributes with a default may be left out.

    Attributes:
        needs_image: whether it reads `frame.image`.
        needs_points: whether it reads `frame.points`; otherwise they are not loaded for it.
        map_version: a number if the map depends on nothing but the pixels and the arguments of the
            constructor (a model's file by its content). The pipeline then makes the map of an image
            once and stores it, see `curate.segmenters.map_store`. Raise the number when the class
            makes other maps than before. None: the map is made whenever it is needed.
    """

    needs_image: bool = True
    needs_points: bool = True
    map_version: int | None = None

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's semantic map, of the same size as its image."""
        ...


@runtime_checkable
class DeclaresClasses(Protocol):
    """A segmenter that has the same classes in every frame, and knows them before the first.

    Attributes:
        classes: for each category, the class ids that count as its pixels.
    """

    classes: Mapping[str, tuple[int, ...]]
