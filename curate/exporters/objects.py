"""A label set frame by frame, as formats take it that hold X_l and X_u side by side."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from curate.detections import Detections
from curate.evaluation.kitti_rules import MAX_OCCLUSIONS, MAX_TRUNCATIONS, MIN_HEIGHTS
from curate.exporters.base import (
    BOX_COLUMNS,
    GROUND_TRUTH_COLUMNS,
    WEIGHTED_LABEL_COLUMNS,
    LabelSet,
    Row,
    bad_weight,
)

UNKNOWN = -1


@dataclass(frozen=True)
class FrameObjects:
    """All objects of one frame that a student learns from.

    Attributes:
        frame_id: name of the frame.
        labeled: whether they are ground truth (X_l) or pseudo-labels (X_u).
        files: points and image, relative to the root of the data set.
        detections: boxes in the LiDAR frame; ground truth has score 1.
        weights: (n,) v in [0, 1]; ground truth has 1, and 0 is an ignore region.
        points: (n,) int64 LiDAR points in each box; -1 unknown.
        truncated: (n,) share outside the image; -1 unknown.
        occluded: (n,) int64, KITTI's levels 0 to 3; -1 unknown.
    """

    frame_id: str
    labeled: bool
    files: tuple[str, str]
    detections: Detections
    weights: np.ndarray
    points: np.ndarray
    truncated: np.ndarray
    occluded: np.ndarray


def frame_objects(labels: LabelSet) -> Iterator[FrameObjects]:
    """The frames of a label set in its order, those without objects too.

    Raises:
        DataError: a weight is not in [0, 1].
    """
    refuse_bad_weights(labels)
    rows: dict[str, list[Row]] = {row[0]: [] for row in labels.frames}
    for table, columns in (
        (labels.ground_truth, GROUND_TRUTH_COLUMNS),
        (labels.labels, WEIGHTED_LABEL_COLUMNS),
    ):
        position = columns.index("frame")
        for row in table:
            rows[row[position]].append(row)
    for frame_id, split, points, image, *_ in labels.frames:
        files = (str(points), str(image))
        found = rows[frame_id]
        make = _true_objects if split == "labeled" else _weighted_objects
        yield make(frame_id, files, found)


def refuse_bad_weights(labels: LabelSet) -> None:
    """DataError where a weight is not in [0, 1]."""
    for row in labels.labels:
        if not 0 <= row[-1] <= 1:
            raise bad_weight(row[1], row[2], row[-1])


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


def _true_objects(frame_id: str, files: tuple[str, str], rows: Sequence[Row]) -> FrameObjects:
    count = len(rows)
    wanted = itemgetter(*map(GROUND_TRUTH_COLUMNS.index, ("category", *BOX_COLUMNS)))
    boxes = [wanted(row) for row in rows]
    return FrameObjects(
        frame_id,
        labeled=True,
        files=files,
        detections=Detections.from_rows([(box[0], 1.0, *box[1:], None) for box in boxes]),
        weights=np.ones(count),
        points=np.full(count, UNKNOWN, dtype=np.int64),
        truncated=np.array([row[-2] for row in rows], dtype=np.float64),
        occluded=np.array([row[-1] for row in rows], dtype=np.int64),
    )


def _weighted_objects(frame_id: str, files: tuple[str, str], rows: Sequence[Row]) -> FrameObjects:
    count = len(rows)
    names = ("category", "score", *BOX_COLUMNS)
    wanted = itemgetter(*map(WEIGHTED_LABEL_COLUMNS.index, names))
    counted = WEIGHTED_LABEL_COLUMNS.index("points")
    return FrameObjects(
        frame_id,
        labeled=False,
        files=files,
        detections=Detections.from_rows([(*wanted(row), None) for row in rows]),
        weights=np.array([row[-1] for row in rows], dtype=np.float64),
        points=np.array(
            [UNKNOWN if row[counted] is None else row[counted] for row in rows], dtype=np.int64
        ),
        truncated=np.full(count, float(UNKNOWN)),
        occluded=np.full(count, UNKNOWN, dtype=np.int64),
    )
