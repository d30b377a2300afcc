"""Boxes with categories: the predictions of a detector, and the ground truth.

`boxes` is (n, 7) float64 everywhere: x, y, z of the box centre, length, width, height in metres,
and yaw in radians, counter-clockwise from the x axis in (-pi, pi], all in the LiDAR frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Self

import numpy as np

from curate.shapes import Bool, Float, Int, Shaped

CATEGORIES = ("Car", "Pedestrian", "Cyclist")


def empty_boxes() -> Float[np.ndarray, "0 7"]:
    """Return a (0, 7) float64 array."""
    return np.zeros((0, 7))


def as_categories(names: Sequence[str] | np.ndarray) -> Shaped[np.ndarray, " n"]:
    """Return category names as an (n,) array of str, also for n = 0."""
    return np.asarray(names, dtype=np.str_).reshape(-1)


@dataclass(frozen=True)
class Columns:
    """Base of data classes with arrays as fields, one row per object."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def select(self, index: Int[np.ndarray, " m"] | Bool[np.ndarray, " m"]) -> Self:
        """Return the rows at `index` (integers or a mask) of every array, in that order."""
        return type(self)(*(getattr(self, column.name)[index] for column in fields(self)))

    def joined(self, other: Self) -> Self:
        """Return the rows of this object, then those of another."""
        pairs = ((getattr(each, column.name) for each in (self, other)) for column in fields(self))
        return type(self)(*map(np.concatenate, map(tuple, pairs)))


@dataclass(frozen=True)
class Detections(Columns):
    """The predictions of a detector for one frame: boxes, scores and categories.

    Attributes:
        boxes: (n, 7) in the LiDAR frame.
        scores: (n,) float64 in [0, 1].
        categories: (n,) str.
        iou: (n,) float64 in [0, 1], the detector's own estimate of the 3D IoU between its box and
            the object; NaN where there is no estimate, and everywhere if the argument is omitted.
    """

    boxes: Float[np.ndarray, "n 7"]
    scores: Float[np.ndarray, " n"]
    categories: Shaped[np.ndarray, " n"]
    iou: Float[np.ndarray, " n_or_0"] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Fill in NaN for omitted IoU estimates."""
        if len(self.iou) == 0:
            object.__setattr__(self, "iou", np.full(len(self.boxes), np.nan))

    @classmethod
    def from_rows(cls, rows: Sequence[Sequence[Any]]) -> Self:
        """Build detections from rows of category, score, x to yaw (7 numbers), and IoU or None."""
        if not rows:
            return cls.empty()
        categories, scores, *box, iou = zip(*rows, strict=True)
        return cls(
            np.array(box, dtype=np.float64).T,
            np.array(scores),
            as_categories(categories),
            np.array(iou, dtype=np.float64),
        )

    @classmethod
    def empty(cls) -> Self:
        """Return zero detections."""
        return cls(empty_boxes(), np.zeros(0), as_categories([]))


@dataclass(frozen=True)
class Annotations(Columns):
    """The ground truth of one frame, in the LiDAR frame.

    DontCare regions have category "DontCare", a 2D box, and NaN in `boxes`.

    Attributes:
        boxes: (n, 7) in the LiDAR frame.
        categories: (n,) str.
        truncated: (n,) float64, fraction of the object outside the image, 0 to 1.
        occluded: (n,) int64, KITTI's occlusion levels 0 to 3.
        alpha: (n,) float64, observation angle in radians.
        boxes_2d: (n, 4) float64: left, top, right, bottom in pixels.
    """

    boxes: Float[np.ndarray, "n 7"]
    categories: Shaped[np.ndarray, " n"]
    truncated: Float[np.ndarray, " n"]
    occluded: Int[np.ndarray, " n"]
    alpha: Float[np.ndarray, " n"]
    boxes_2d: Float[np.ndarray, "n 4"]

    @classmethod
    def empty(cls) -> Self:
        """Return zero annotations."""
        numbers, levels = np.zeros(0), np.zeros(0, dtype=np.int64)
        return cls(empty_boxes(), as_categories([]), numbers, levels, numbers, np.zeros((0, 4)))
