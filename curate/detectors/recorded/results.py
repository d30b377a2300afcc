"""Results of one frame as a record stores them, and the check of their values."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.detections import Detections, as_categories
from curate.detectors.scores import describe_invalid_scores
from curate.errors import ConfigError, DataError, one_line
from curate.frames import Calibration
from curate.geometry.similarity import wrap_angle

# Largest valid number, in metres or radians: boxes are in the LiDAR frame, not on a map.
LARGEST = 1e6


class ForeignBoxes(Protocol):
    """Boxes in another frame of reference; their conversion needs the calibration of the frame."""

    @property
    def categories(self) -> np.ndarray:
        """(n,) category names of the boxes."""
        ...

    @property
    def scores(self) -> np.ndarray:
        """(n,) the scores of the boxes as they are stored."""
        ...

    def in_lidar(self, calibration: Calibration) -> Detections:
        """Return the boxes in the LiDAR frame of reference.

        Raises:
            DataError: if a box cannot be a detection of this frame.
        """
        ...


RecordedResult = Detections | KittiObjects | ForeignBoxes
"""Result of one frame. The last two are converted to the LiDAR frame once the calibration is
loaded."""

ResultsByFrame = Mapping[str, RecordedResult]
"""Results of one pass of a detector over a data set, by frame id."""


@dataclass(frozen=True)
class ReadOptions:
    """Information that some formats do not contain.

    Attributes:
        classes: class names of numbered labels, in the order of the model's configuration.
        frame_list: a text file with one frame id per line, in the order of the results; for
            results without frame ids.
        sigmoid: whether the scores are logits, which the detector converts.
        version: the version of mmdetection3d that computed the boxes: "0.x" or "1.x".
        ignored: whether to "drop" or "keep" ST3D's boxes with a negative category.
        shift: SHIFT_COOR of ST3D's data set configuration: (3,) metres that were added to x, y, z.
        frame_name: pattern of the frame names of Argoverse 2's results.
        frame_ids: the frames of the data set.
    """

    classes: Sequence[str] = ()
    frame_list: Path | None = None
    sigmoid: bool = False
    version: str | None = None
    ignored: str = "drop"
    shift: Sequence[float] = (0.0, 0.0, 0.0)
    frame_name: str | None = None
    frame_ids: Collection[str] = ()

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ConfigError: if one has an invalid value.
        """
        for name, choices in (("version", (None, "0.x", "1.x")), ("ignored", ("drop", "keep"))):
            value = getattr(self, name)
            if value not in choices:
                shown = " or ".join(choice for choice in choices if choice)
                raise ConfigError(f"detector.options.{name} {value!r}: use {shown}")
        is_number = [isinstance(metres, int | float) for metres in self.shift]
        if is_number != [True] * 3:
            raise ConfigError(f"detector.options.shift {self.shift}: expected [x, y, z] in metres")


def as_detections(place: str, boxes: Any, scores: Any, names: Any) -> Detections:
    """Return the result of one frame as `Detections`.

    Args:
        place: file and entry, for messages.
        boxes: (n, >=7) centre boxes in the LiDAR frame; further columns (velocities) are ignored.
        scores: (n,); their range is checked by `check_scores`, or where they are used.
        names: (n,) category names.

    Raises:
        DataError: if the lengths differ, a number is not finite, or a size is not positive.
    """
    try:
        boxes = np.array(boxes, dtype=np.float64)
        scores = np.array(scores, dtype=np.float64).reshape(-1)
    except (OverflowError, TypeError, ValueError) as error:
        raise DataError(
            f"{place}: boxes and scores must be numbers: {one_line(error, 200)}"
        ) from None
    categories = as_categories(names)
    if boxes.size == 0:
        boxes = boxes.reshape(0, 7)
    if boxes.ndim != 2 or boxes.shape[1] < 7 or len({*map(len, (boxes, scores, categories))}) > 1:
        raise DataError(
            f"{place}: boxes {list(boxes.shape)}, scores {list(scores.shape)} and "
            f"{len(categories)} names do not fit; expected [n, 7], [n] and n"
        )
    boxes = boxes[:, :7]
    for reason, rows in invalid_rows(boxes, scores).items():
        if rows.any():
            k = int(np.argmax(rows))
            numbers = [round(float(number), 3) for number in (*boxes[k], scores[k])]
            raise DataError(f"{place}: box {k}: {reason}: {numbers} (x, y, z, l, w, h, yaw, score)")
    boxes[:, 6] = wrap_angle(boxes[:, 6])
    return Detections(boxes, scores, categories)


def invalid_rows(boxes: np.ndarray, scores: np.ndarray) -> Mapping[str, np.ndarray]:
    """Return the (n,) mask of rows that cannot be boxes, by reason; shared by all formats.

    Args:
        boxes: (n, 7) x, y, z, length, width, height, yaw.
        scores: (n,) in any range.
    """
    return {
        "a number is NaN or infinite": ~np.isfinite(np.column_stack([boxes, scores])).all(axis=1),
        f"a number is beyond {LARGEST:g}": (np.abs(boxes) > LARGEST).any(axis=1),
        "length, width or height is not positive": (boxes[:, 3:6] <= 0).any(axis=1),
    }


def check_scores(place: object, scores: Iterable[tuple[str, np.ndarray]], *, sigmoid: bool) -> None:
    """Raise DataError if the scores of the frames of a pass are not in [0, 1].

    Args:
        place: the file, for messages.
        scores: the name and the scores of each frame.
        sigmoid: whether they are logits, in any range.
    """
    lowest, highest, example = 0.0, 0.0, ""
    for name, found in scores:
        low, high = found.min(initial=0), found.max(initial=0)
        if not example and (low < 0 or high > 1):
            example = name
        lowest, highest = min(lowest, low), max(highest, high)
    problem = None if sigmoid else describe_invalid_scores(lowest, highest)
    if problem:
        raise DataError(f"{place}: frame {example}: {problem}")
