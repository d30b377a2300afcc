"""A label set frame by frame, as formats take it that hold X_l and X_u side by side."""

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
        labeled: whether they are ground truth (X_l) or pseudo-labels (X_u).
        files: points and image, relative to the root of the data set.
        detections: boxes in the LiDAR frame; ground truth has score 1.
        weights: (n,) in [0, 1]; ground truth has 1.
        ignored: (n,) bool, which labels of weight 0 are regions to ignore.
        points: (n,) int64 LiDAR points in each box; -1 unknown.
        truncated: (n,) share outside the image; -1 unknown.
        occluded: (n,) int64, KITTI's levels 0 to 3; -1 unknown.
    """

    frame_id: str
    labeled: bool
    files: tuple[str, str]
    detections: Detections
    weights: np.ndarray
    ignored: np.ndarray
    points: np.ndarray
    truncated: np.ndarray
    occluded: np.ndarray

    @property
    def background(self) -> np.ndarray:
        """(n,) bool, which labels of weight 0 are background: no objects."""
        return np.asarray((self.weights == 0) & ~self.ignored)


def frame_objects(labels: LabelSet) -> Iterator[FrameObjects]:
    """The frames of a label set in its order, those without objects too; one walk, none is held.

    Raises:
        DataError: see `LabelSet.blocks`; or the labels are not in the order of the frames.
    """
    truth: Mapping[str, Columns] = dict(by_frame([labels.truth()]))
    nothing: Columns = {name: [] for name in (*labels.column_names, "truncated", "occluded")}
    found = by_frame(labels.blocks())
    following = next(found, None)
    for files in labels.frames:
        if files.split == "labeled":
            yield _true_objects(files, truth.get(files.frame, nothing))
        elif following is not None and following[0] == files.frame:
            yield _weighted_objects(files, following[1], labels)
            following = next(found, None)
        else:
            yield _weighted_objects(files, nothing, labels)
    if following is not None:
        raise DataError(
            f"labels of frame {following[0]} are out of order; labels to export are in the order "
            "of their frames"
        )


def count_labels(frames: Sequence[FrameObjects]) -> int:
    """Return how many pseudo-labels some frames have."""
    return sum(len(objects.weights) for objects in frames if not objects.labeled)


def categories_of(frames: Sequence[FrameObjects]) -> set[str]:
    """Return the categories that occur in some frames."""
    return {name for objects in frames for name in objects.detections.categories.tolist()}


def difficulties(boxes_2d: np.ndarray, truncated: np.ndarray, occluded: np.ndarray) -> np.ndarray:
    """(n,) int32 KITTI's difficulty: 0 easy, 1 moderate, 2 hard, -1 beyond; unknown counts as 0.

    Args:
        boxes_2d: (n, 4) left, top, right, bottom in pixels.
        truncated: (n,) share outside the image.
        occluded: (n,) levels 0 to 3.
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
        files=(files.points, str(files.image)),
        detections=_detections(rows, [1.0] * count),
        weights=np.ones(count),
        ignored=np.zeros(count, dtype=bool),
        points=np.full(count, UNKNOWN, dtype=np.int64),
        truncated=np.array(rows["truncated"], dtype=np.float64),
        occluded=np.array(rows["occluded"], dtype=np.int64),
    )


def _weighted_objects(files: FrameFiles, rows: Columns, labels: LabelSet) -> FrameObjects:
    count = len(rows["category"])
    weights = np.array(rows["weight"], dtype=np.float64)
    # What a person rejected is background, whatever the policy takes a weight of 0 for.
    doubted = [each != "human" for each in rows["provenance"]]
    ignoring = labels.description.zero_weight == "ignore"
    return FrameObjects(
        files.frame,
        labeled=False,
        files=(files.points, str(files.image)),
        detections=_detections(rows, rows["score"]),
        weights=weights,
        ignored=(weights == 0) & ignoring & np.array(doubted, dtype=bool),
        points=np.array([UNKNOWN if m is None else m for m in rows["points"]], dtype=np.int64),
        truncated=np.full(count, float(UNKNOWN)),
        occluded=np.full(count, UNKNOWN, dtype=np.int64),
    )


def _detections(rows: Columns, scores: Sequence[Any]) -> Detections:
    boxes = np.array([rows[name] for name in BOX_COLUMNS], dtype=np.float64).T
    return Detections(boxes, np.array(scores, dtype=np.float64), as_categories(rows["category"]))
