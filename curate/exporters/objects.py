"""Iterate over a label set frame by frame, for formats that contain both X_l and X_u."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from curate.detections import Detections, as_categories
from curate.errors import DataError
from curate.evaluation.kitti_rules import MAX_OCCLUSIONS, MAX_TRUNCATIONS, MIN_HEIGHTS
from curate.exporters.base import BOX_COLUMNS, Columns, FrameFiles, LabelSet, by_frame

UNKNOWN = -1


@dataclass(frozen=True)
class FrameObjects:
    """All objects of one frame that a student learns from.

    Attributes:
        frame_id: name of the frame.
        labeled: True for ground truth (X_l), False for pseudo-labels (X_u).
        files: points, then the image of each camera, relative to the root of the data set.
        detections: boxes in the LiDAR frame; ground truth has score 1.
        weights: (n,) in [0, 1]; ground truth has weight 1.
        ignored: (n,) bool, True for labels of weight 0 that are regions to ignore.
        points: (n,) int64 LiDAR points in each box; -1 if unknown.
        truncated: (n,) share outside the image; -1 if unknown.
        occluded: (n,) int64, KITTI's levels 0 to 3; -1 if unknown.
        numbers: (n,) int64 k of each label, or of each object of the ground truth.
        provenance: (n,) str, detector, or human if a person decided; ground_truth for X_l.
    """

    frame_id: str
    labeled: bool
    files: tuple[str, ...]
    detections: Detections
    weights: np.ndarray
    ignored: np.ndarray
    points: np.ndarray
    truncated: np.ndarray
    occluded: np.ndarray
    numbers: np.ndarray
    provenance: np.ndarray

    @property
    def images(self) -> tuple[str, ...]:
        """The images of the cameras, relative to the root; empty without images."""
        return self.files[1:]

    @property
    def background(self) -> np.ndarray:
        """(n,) bool, True for labels of weight 0 that are background."""
        return np.asarray((self.weights == 0) & ~self.ignored)


def frame_objects(labels: LabelSet) -> Iterator[FrameObjects]:
    """Yield the frames of a label set in their order, including frames without objects.

    The labels are read once and only one frame is in memory at a time.

    Raises:
        DataError: see `LabelSet.blocks`, or if the labels are not in the order of the frames.
    """
    truth: Mapping[str, Columns] = dict(by_frame([labels.truth()]))
    no_rows: Columns = {name: [] for name in (*labels.column_names, "truncated", "occluded")}
    found = by_frame(labels.blocks())
    following = next(found, None)
    for files in labels.frames:
        if files.split == "labeled":
            yield _true_objects(files, truth.get(files.frame, no_rows))
        elif following is not None and following[0] == files.frame:
            yield _weighted_objects(files, following[1], labels)
            following = next(found, None)
        else:
            yield _weighted_objects(files, no_rows, labels)
    if following is not None:
        raise DataError(
            f"labels of frame {following[0]} are out of order; sort the labels in the order of the "
            "frames"
        )


def count_labels(frames: Sequence[FrameObjects]) -> int:
    """Return the number of pseudo-labels of the frames."""
    return sum(len(objects.weights) for objects in frames if not objects.labeled)


def categories_of(frames: Sequence[FrameObjects]) -> set[str]:
    """Return the categories that occur in the frames."""
    return {name for objects in frames for name in objects.detections.categories.tolist()}


def difficulties(boxes_2d: np.ndarray, truncated: np.ndarray, occluded: np.ndarray) -> np.ndarray:
    """Return (n,) int32 KITTI's difficulty: 0 easy, 1 moderate, 2 hard, -1 harder.

    Args:
        boxes_2d: (n, 4) left, top, right, bottom in pixels.
        truncated: (n,) share outside the image; -1 (unknown) is treated like 0.
        occluded: (n,) levels 0 to 3; -1 (unknown) is treated like 0.
    """
    found = np.full(len(boxes_2d), -1, dtype=np.int32)
    height = boxes_2d[:, 3] - boxes_2d[:, 1]
    limits = zip(MIN_HEIGHTS, MAX_OCCLUSIONS, MAX_TRUNCATIONS, strict=True)
    for level, (least, most_occluded, most_truncated) in reversed(list(enumerate(limits))):
        within = (height >= least) & (occluded <= most_occluded) & (truncated <= most_truncated)
        found[within] = level
    return found


def _true_objects(files: FrameFiles, rows: Columns) -> FrameObjects:
    count = len(rows["category"])
    return FrameObjects(
        files.frame,
        labeled=True,
        files=(files.points, *files.images),
        detections=_detections(rows, [1.0] * count),
        weights=np.ones(count),
        ignored=np.zeros(count, dtype=bool),
        points=np.full(count, UNKNOWN, dtype=np.int64),
        truncated=np.array(rows["truncated"], dtype=np.float64),
        occluded=np.array(rows["occluded"], dtype=np.int64),
        numbers=np.array(rows["k"], dtype=np.int64),
        provenance=as_categories(["ground_truth"] * count),
    )


def _weighted_objects(files: FrameFiles, rows: Columns, labels: LabelSet) -> FrameObjects:
    count = len(rows["category"])
    weights = np.array(rows["weight"], dtype=np.float64)
    # A label that a person rejected is background, whatever weight 0 means for the policy.
    provenance = as_categories(rows["provenance"])
    ignoring = labels.description.zero_weight == "ignore"
    return FrameObjects(
        files.frame,
        labeled=False,
        files=(files.points, *files.images),
        detections=_detections(rows, rows["score"]),
        weights=weights,
        ignored=(weights == 0) & ignoring & (provenance != "human"),
        points=np.array([UNKNOWN if m is None else m for m in rows["points"]], dtype=np.int64),
        truncated=np.full(count, float(UNKNOWN)),
        occluded=np.full(count, UNKNOWN, dtype=np.int64),
        numbers=np.array(rows["k"], dtype=np.int64),
        provenance=provenance,
    )


def _detections(rows: Columns, scores: Sequence[Any]) -> Detections:
    boxes = np.array([rows[name] for name in BOX_COLUMNS], dtype=np.float64).T
    return Detections(boxes, np.array(scores, dtype=np.float64), as_categories(rows["category"]))
