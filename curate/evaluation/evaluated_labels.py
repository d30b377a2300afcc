"""The labels of frames with ground truth, each marked as correct, wrong or neutral."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Self

import numpy as np

from curate.detections import Annotations, Detections, as_categories
from curate.evaluation.counts import Counts, tally
from curate.evaluation.difficulties import REASONS
from curate.evaluation.kitti_rules import neighbours_of
from curate.evaluation.reliability import MatchSettings, match_to_ground_truth
from curate.shapes import Bool, Float, Int, Shaped

ALL = "all"
"""The name that stands for all categories together."""

DISTANCES = (0.0, 20.0, 40.0, np.inf)
"""Edges of the distance ranges in metres, on the ground from the LiDAR to the box centre."""
POINTS = (0.0, 10.0, 50.0, 200.0, np.inf)
"""Edges of the ranges of LiDAR points inside the box."""


@dataclass(frozen=True)
class AuditedFrame:
    """A frame with its labels and its ground truth.

    Attributes:
        labels: n labels in the LiDAR frame.
        truth: the ground truth annotations.
        rectangles: (n, 4) left, top, right, bottom of the labels in the image, in pixels; NaN for
            labels outside the image. None for a frame without an image.
        points: (n,) LiDAR points in each label, NaN where they were not counted.
        sequence: name of the frame's sequence; "" if it is in none.
    """

    labels: Detections
    truth: Annotations
    rectangles: Float[np.ndarray, "n 4"] | None
    points: Float[np.ndarray, " n"]
    sequence: str = ""


@dataclass(frozen=True)
class EvaluatedLabels:
    """The n labels and the m objects of all audited frames, as columns.

    Attributes:
        frames: number of frames, including those without labels or objects.
        frame_index: (n,) int64 frame of each label.
        category: (n,) str.
        distance: (n,) metres on the ground.
        points: (n,) float64, NaN where unknown.
        correct: (n,) bool.
        counted: (n,) bool, False for neutral labels, which are neither correct nor wrong.
        neutral: (n,) str, why a label is neutral; "" for counted labels.
        object_frame: (m,) int64 frame of each object.
        object_category: (m,) str.
        object_distance: (m,) metres on the ground.
        other_category: (o,) str, the annotations that are not evaluated: other categories,
            neighbours, and DontCare regions.
        sequence: (f,) str name of the sequence of each frame, "" for a frame in none. By default
            no frame is in a sequence.
    """

    frames: int
    frame_index: Int[np.ndarray, " n"]
    category: Shaped[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]
    points: Float[np.ndarray, " n"]
    correct: Bool[np.ndarray, " n"]
    counted: Bool[np.ndarray, " n"]
    neutral: Shaped[np.ndarray, " n"]
    object_frame: Int[np.ndarray, " m"]
    object_category: Shaped[np.ndarray, " m"]
    object_distance: Float[np.ndarray, " m"]
    other_category: Shaped[np.ndarray, " o"]
    sequence: Shaped[np.ndarray, " f"] = field(default_factory=lambda: as_categories([]))

    def __post_init__(self) -> None:
        """Set the default of `sequence`."""
        if len(self.sequence) == 0:
            object.__setattr__(self, "sequence", as_categories([""] * self.frames))

    @property
    def resampling_unit(self) -> Int[np.ndarray, " f"]:
        """(f,) int64 number of the unit of each frame: its sequence, or the frame itself."""
        numbers: dict[str | int, int] = {}
        names = [name or frame for frame, name in enumerate(self.sequence.tolist())]
        unit = [numbers.setdefault(name, len(numbers)) for name in names]
        return np.array(unit, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.frame_index)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Concatenate the frames of all parts and renumber them."""
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
            column.name: np.concatenate([getattr(part, column.name) for part in numbered])
            for column in fields(cls)
            if column.name != "frames"
        }
        return cls(int(starts[-1]), **columns)

    @classmethod
    def no_frames(cls) -> Self:
        """Return an instance without labels and objects."""
        floats, names = np.zeros(0), as_categories([])
        integers, flags = floats.astype(np.int64), floats.astype(bool)
        return cls(
            *(0, integers, names, floats, floats, flags, flags, names),
            *(integers, names, floats, names),
        )

    def counts(self, categories: Sequence[str]) -> tuple[Counts, Counts]:
        """Return how many objects and labels count, and why the others do not.

        Every object of the categories counts, whatever its 2D box, occlusion or truncation.

        Args:
            categories: the evaluated categories.
        """
        names = np.concatenate([self.object_category, self.other_category])
        neighbours = tuple(neighbours_of(categories).values())
        counts = np.full(len(names), REASONS[0])
        reasons = np.where(self.counted, REASONS[0], self.neutral)
        return (
            tally(("all",), names, [counts], categories, neighbours),
            tally(("all",), self.category, [reasons], categories),
        )


@dataclass(frozen=True)
class Slice:
    """A range of distances or point counts, or all labels if `by` is "all".

    Attributes:
        by: "all", "distance" or "points".
        low: lower edge, inclusive.
        high: upper edge, exclusive.
    """

    by: str
    low: float = 0.0
    high: float = np.inf

    def holds(self, values: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return (n,) bool, True for values inside the range."""
        return np.asarray((values >= self.low) & (values < self.high))

    def __str__(self) -> str:
        unit = " m" if self.by == "distance" else ""
        if self.by == "all":
            return ALL
        return f"{self.low:g}-{self.high:g}{unit}" if self.high < np.inf else f"{self.low:g}+{unit}"


WHOLE = Slice("all")


def evaluate_frames(frames: Iterable[AuditedFrame], settings: MatchSettings) -> EvaluatedLabels:
    """Match the labels of frames to their ground truth.

    Raises:
        ConfigError: if a label's category has no minimum IoU.
    """
    return EvaluatedLabels.joined([_evaluate_frame(frame, settings) for frame in frames])


def slices(labels: EvaluatedLabels) -> tuple[Slice, ...]:
    """Return the ranges of distance, and those of point counts if points were counted."""
    edges: dict[str, tuple[float, ...]] = {"distance": DISTANCES}
    if not np.isnan(labels.points).all():
        edges["points"] = POINTS
    return tuple(
        Slice(by, low, high) for by, values in edges.items() for low, high in pairwise(values)
    )


def _evaluate_frame(frame: AuditedFrame, settings: MatchSettings) -> EvaluatedLabels:
    matches = match_to_ground_truth(frame.labels, frame.truth, settings, frame.rectangles)
    objects = np.isin(frame.truth.categories, list(settings.minimum_iou))
    n, m = len(frame.labels), int(objects.sum())
    return EvaluatedLabels(
        frames=1,
        frame_index=np.zeros(n, dtype=np.int64),
        category=as_categories(frame.labels.categories),
        distance=np.hypot(frame.labels.boxes[:, 0], frame.labels.boxes[:, 1]),
        points=np.asarray(frame.points, dtype=np.float64),
        correct=matches.correct,
        counted=matches.counted,
        neutral=as_categories(matches.neutral),
        object_frame=np.zeros(m, dtype=np.int64),
        object_category=as_categories(frame.truth.categories[objects]),
        object_distance=np.hypot(*frame.truth.boxes[objects, :2].T),
        other_category=as_categories(frame.truth.categories[~objects]),
        sequence=as_categories([frame.sequence]),
    )
