"""The labels of frames whose ground truth is known, with what the truth says of them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Self

import numpy as np

from curate.detections import Annotations, Detections, as_categories
from curate.evaluation.reliability import JudgeSettings, judge
from curate.shapes import Bool, Float, Int, Shaped

ALL = "all"
"""Stands for all categories together."""

DISTANCES = (0.0, 20.0, 40.0, np.inf)
"""Edges in metres, over the ground from the LiDAR to the centre of the box."""
POINTS = (0.0, 10.0, 50.0, 200.0, np.inf)
"""Edges in LiDAR points inside the box."""


@dataclass(frozen=True)
class AuditedFrame:
    """A frame with its labels and its ground truth.

    Attributes:
        labels: n labels in the LiDAR frame.
        truth: what annotators wrote.
        rectangles: (n, 4) left, top, right, bottom of the labels in the image, NaN where invisible.
        points: (n,) LiDAR points in each label, NaN where they were not counted.
    """

    labels: Detections
    truth: Annotations
    rectangles: Float[np.ndarray, "n 4"]
    points: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class JudgedLabels:
    """The n labels and the m objects of all audited frames, as columns.

    Attributes:
        frames: number of frames, those without labels or objects included.
        frame_index: (n,) int64.
        category: (n,) str.
        distance: (n,) metres over the ground.
        points: (n,) float64, NaN where unknown.
        right: (n,) bool.
        counted: (n,) bool, False where a label is neither right nor wrong.
        object_frame: (m,) int64.
        object_category: (m,) str.
        object_distance: (m,) metres over the ground.
    """

    frames: int
    frame_index: Int[np.ndarray, " n"]
    category: Shaped[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]
    points: Float[np.ndarray, " n"]
    right: Bool[np.ndarray, " n"]
    counted: Bool[np.ndarray, " n"]
    object_frame: Int[np.ndarray, " m"]
    object_category: Shaped[np.ndarray, " m"]
    object_distance: Float[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.frame_index)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the frames of all parts, one after the other."""
        starts = np.cumsum([0, *(part.frames for part in parts)])
        numbered = [cls.no_frames()] + [
            replace(
                part,
                frame_index=part.frame_index + start,
                object_frame=part.object_frame + start,
            )
            for part, start in zip(parts, starts[:-1], strict=True)
        ]
        columns = {
            field.name: np.concatenate([getattr(part, field.name) for part in numbered])
            for field in fields(cls)
            if field.name != "frames"
        }
        return cls(int(starts[-1]), **columns)

    @classmethod
    def no_frames(cls) -> Self:
        """Neither labels nor objects."""
        numbers, names = np.zeros(0), as_categories([])
        keys, truths = numbers.astype(np.int64), numbers.astype(bool)
        return cls(0, keys, names, numbers, numbers, truths, truths, keys, names, numbers)


@dataclass(frozen=True)
class Slice:
    """Labels of a range of distances or of point counts; the whole where `by` is "all".

    Attributes:
        by: "all", "distance" or "points".
        low: lower edge, included.
        high: upper edge, not included.
    """

    by: str
    low: float = 0.0
    high: float = np.inf

    def holds(self, values: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return (n,) bool, which of the values it holds."""
        return np.asarray((values >= self.low) & (values < self.high))

    def __str__(self) -> str:
        unit = " m" if self.by == "distance" else ""
        if self.by == "all":
            return ALL
        return f"{self.low:g}-{self.high:g}{unit}" if self.high < np.inf else f"{self.low:g}+{unit}"


WHOLE = Slice("all")


def judge_frames(frames: Iterable[AuditedFrame], settings: JudgeSettings) -> JudgedLabels:
    """Ask the truth about the labels of some frames.

    Raises:
        ConfigError: if a label's category has no minimum IoU.
    """
    return JudgedLabels.joined([_judge_frame(frame, settings) for frame in frames])


def slices(labels: JudgedLabels) -> tuple[Slice, ...]:
    """Return the ranges of distance, and those of point counts where points were counted."""
    edges: dict[str, tuple[float, ...]] = {"distance": DISTANCES}
    if not np.isnan(labels.points).all():
        edges["points"] = POINTS
    return tuple(
        Slice(by, low, high) for by, values in edges.items() for low, high in pairwise(values)
    )


def _judge_frame(frame: AuditedFrame, settings: JudgeSettings) -> JudgedLabels:
    verdict = judge(frame.labels, frame.truth, settings, frame.rectangles)
    objects = np.isin(frame.truth.categories, list(settings.minimum_iou))
    n, m = len(frame.labels), int(objects.sum())
    return JudgedLabels(
        frames=1,
        frame_index=np.zeros(n, dtype=np.int64),
        category=as_categories(frame.labels.categories),
        distance=np.hypot(frame.labels.boxes[:, 0], frame.labels.boxes[:, 1]),
        points=np.asarray(frame.points, dtype=np.float64),
        right=verdict.right,
        counted=verdict.counted,
        object_frame=np.zeros(m, dtype=np.int64),
        object_category=as_categories(frame.truth.categories[objects]),
        object_distance=np.hypot(*frame.truth.boxes[objects, :2].T),
    )
