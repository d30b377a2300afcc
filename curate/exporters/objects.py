"""Iterate over a label set frame by frame, for formats that contain both X_l and X_u."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import pairwise
from typing import Any, Protocol, Self, TypeVar

import numpy as np

from curate.detections import Columns, Detections, as_categories
from curate.errors import DataError, error_prefix
from curate.evaluation.kitti_rules import MAX_OCCLUSIONS, MAX_TRUNCATIONS, MIN_HEIGHTS
from curate.exporters.base import (
    BOX_COLUMNS,
    GROUND_TRUTH_COLUMNS,
    FrameFiles,
    LabelRows,
    LabelSet,
)
from curate.files.batches import batched
from curate.frames import Calibration, Frame

UNKNOWN = -1
BATCH_FRAMES = 256
"""Number of frames that are converted at once."""

Result = TypeVar("Result", bound=np.ndarray | Columns)
FrameT = TypeVar("FrameT", bound="Calibrated")


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


@dataclass(frozen=True)
class _Objects:
    """The objects of one or several frames; the fields are those of `FrameObjects`."""

    boxes: np.ndarray
    scores: np.ndarray
    categories: list[str]
    weights: np.ndarray
    ignored: np.ndarray
    points: np.ndarray
    truncated: np.ndarray
    occluded: np.ndarray
    numbers: np.ndarray
    provenance: list[str]

    def part(self, start: int, end: int) -> Self:
        """Return some consecutive objects."""
        return type(self)(*(getattr(self, name)[start:end] for name in _FIELDS))

    def of(self, files: FrameFiles) -> FrameObjects:
        """Return the objects as those of a frame."""
        return FrameObjects(
            files.frame,
            files.split == "labeled",
            (files.points, *files.images),
            Detections(self.boxes, self.scores, as_categories(self.categories)),
            self.weights,
            self.ignored,
            self.points,
            self.truncated,
            self.occluded,
            self.numbers,
            as_categories(self.provenance),
        )


_FIELDS = tuple(field.name for field in fields(_Objects))


def frame_objects(labels: LabelSet) -> Iterator[FrameObjects]:
    """Yield the frames of a label set in their order, including frames without objects.

    The labels are read once and only one block of them is in memory at a time.

    Raises:
        DataError: see `LabelSet.blocks`, or if the labels are not in the order of the frames.
    """
    truth = dict(_by_frame([labels.truth()], _true_objects))
    ignoring = labels.description.zero_weight == "ignore"
    found = _by_frame(labels.blocks(), partial(_weighted_objects, ignoring=ignoring))
    following = next(found, None)
    nothing = _true_objects(LabelRows(GROUND_TRUTH_COLUMNS, []))
    for files in labels.frames:
        if files.split == "labeled":
            yield truth.get(files.frame, nothing).of(files)
        elif following is not None and following[0] == files.frame:
            yield following[1].of(files)
            following = next(found, None)
        else:
            yield nothing.of(files)
    if following is not None:
        raise DataError(
            f"labels of frame {following[0]} are out of order; sort the labels in the order of the "
            "frames"
        )


def frame_batches(
    labels: LabelSet, read: Callable[[FrameObjects], Frame]
) -> Iterator[list[tuple[FrameObjects, Frame]]]:
    """Yield the frames of a label set in batches; `read` reads a frame."""
    for batch in batched(frame_objects(labels), BATCH_FRAMES):
        yield [(objects, read(objects)) for objects in batch]


class Calibrated(Protocol):
    """A frame with a calibration, such as `Frame`."""

    @property
    def frame_id(self) -> str:
        """Name of the frame."""
        ...

    @property
    def calibration(self) -> Calibration:
        """Calibration of the first camera."""
        ...

    @property
    def image_size(self) -> tuple[int, int] | None:
        """Size of the first camera's image."""
        ...


def per_calibration(
    batch: Sequence[tuple[Detections, FrameT]], compute: Callable[[Detections, FrameT], Result]
) -> list[Result]:
    """Return the result of a function for the detections of each frame of a batch.

    It is called once for all frames with the same calibration and image size, because calls of
    NumPy for the few labels of one frame take longer than their arithmetic.

    Args:
        batch: frames with their detections.
        compute: returns columns, or an array, with one row per detection. It may use the
            calibration and the image size of the first camera.

    Raises:
        DataError: if the function raises it; the message names the first of the frames.
    """
    groups: dict[Any, list[int]] = {}
    for place, (_, frame) in enumerate(batch):
        matrices = (frame.calibration.projection, frame.calibration.lidar_to_camera)
        key = (*(matrix.tobytes() for matrix in matrices), frame.calibration.rotation_y)
        groups.setdefault((key, frame.image_size), []).append(place)
    results: dict[int, Result] = {}
    for places in groups.values():
        parts, first = [batch[place][0] for place in places], batch[places[0]][1]
        with error_prefix(f"frame {first.frame_id}"):
            computed = compute(_joined(parts), first)
        start = 0
        for place, part in zip(places, parts, strict=True):
            rows = np.arange(start, start + len(part))
            own: Any = computed[rows] if isinstance(computed, np.ndarray) else computed.select(rows)
            results[place] = own
            start += len(part)
    return [results[place] for place in range(len(batch))]


def rows_as_dicts(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of columns (arrays or sequences) as dicts of plain Python values."""
    values = (each.tolist() if isinstance(each, np.ndarray) else each for each in columns.values())
    return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]


def _joined(parts: Sequence[Detections]) -> Detections:
    if len(parts) == 1:
        return parts[0]
    columns = ([getattr(each, name.name) for each in parts] for name in fields(Detections))
    return Detections(*map(np.concatenate, columns))


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


def _by_frame(
    blocks: Iterable[LabelRows], convert: Callable[[LabelRows], _Objects]
) -> Iterator[tuple[str, _Objects]]:
    """Yield the name and the objects of each frame; a frame may continue in the next block."""
    for block in _whole_frames(blocks):
        names = block["frame"]
        objects = convert(block)
        starts = [row for row in range(1, len(names)) if names[row] != names[row - 1]]
        for start, end in pairwise([0, *starts, len(names)]):
            yield names[start], objects.part(start, end)


def _whole_frames(blocks: Iterable[LabelRows]) -> Iterator[LabelRows]:
    """Yield the rows in other blocks, each of which ends with the last row of a frame."""
    pending: list[tuple[Any, ...]] = []
    names: tuple[str, ...] = ()
    for block in blocks:
        names = block.names
        frame = names.index("frame")
        pending = [*pending, *block.rows]
        complete = len(pending)
        while complete and pending[complete - 1][frame] == pending[-1][frame]:
            complete -= 1
        if complete:
            yield LabelRows(names, pending[:complete])
            pending = pending[complete:]
    if pending:
        yield LabelRows(names, pending)


def _true_objects(block: LabelRows) -> _Objects:
    count = len(block.rows)
    return _Objects(
        _boxes(block),
        np.ones(count),
        block["category"],
        weights=np.ones(count),
        ignored=np.zeros(count, dtype=bool),
        points=np.full(count, UNKNOWN, dtype=np.int64),
        truncated=np.array(block["truncated"], dtype=np.float64),
        occluded=np.array(block["occluded"], dtype=np.int64),
        numbers=np.array(block["k"], dtype=np.int64),
        provenance=["ground_truth"] * count,
    )


def _weighted_objects(block: LabelRows, *, ignoring: bool) -> _Objects:
    """Return labels; `ignoring` is whether those of weight 0 are regions to ignore."""
    count, provenance = len(block.rows), block["provenance"]
    weights = np.array(block["weight"], dtype=np.float64)
    # A label that a person rejected is background, whatever weight 0 means for the policy.
    by_detector = np.array([each != "human" for each in provenance], dtype=bool)
    return _Objects(
        _boxes(block),
        np.array(block["score"], dtype=np.float64),
        block["category"],
        weights=weights,
        ignored=(weights == 0) & ignoring & by_detector,
        points=np.array([UNKNOWN if m is None else m for m in block["points"]], dtype=np.int64),
        truncated=np.full(count, float(UNKNOWN)),
        occluded=np.full(count, UNKNOWN, dtype=np.int64),
        numbers=np.array(block["k"], dtype=np.int64),
        provenance=provenance,
    )


def _boxes(block: LabelRows) -> np.ndarray:
    columns = [np.array(block[name], dtype=np.float64) for name in BOX_COLUMNS]
    return np.stack(columns, axis=1)
