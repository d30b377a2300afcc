"""What every segmenter offers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from curate.frames import Frame
from curate.shapes import UInt8


@dataclass(frozen=True)
class SemanticMap:
    """The semantic class of every pixel of a frame's image.

    Attributes:
        class_ids: (height, width) uint8.
        category_classes: the class ids that count as pixels of a category, e.g. Cyclist = bicycle
            and person.
    """

    class_ids: UInt8[np.ndarray, "height width"]
    category_classes: Mapping[str, tuple[int, ...]]


class Segmenter(Protocol):
    """Names the semantic class of every pixel; raises `ModelError` or `DataError`.

    One that never looks at `frame.points` may have a further attribute, `needs_points`, that is
    false; the points are then not read for it.
    """

    needs_image: bool

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's semantic map, in the size of its image."""
        ...
