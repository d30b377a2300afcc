"""Detections and augmented views in one CSV file.

The record is a CSV file with a header and one row per box: frame, view, flip_y, rotation_rad,
scale, category, score, x, y, z, length, width, height, yaw; other columns are ignored. View 0 is
the frame as it is; view v >= 1 is an augmented copy A(x) with A given by flip_y, rotation_rad and
scale (see `Similarity`). Boxes are centre boxes in the LiDAR frame of their view, in metres and
radians.

A frame or view without boxes leaves no row in such a file and cannot be told from one that was
never recorded. A frame without any row is therefore an error, so that it shows up as a failed frame
instead of passing for an empty street; a frame with rows of other views only has no detections.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curate.detections import Detections, as_categories
from curate.detectors.recorded.answers import LARGEST
from curate.errors import DataError
from curate.geometry.similarity import Similarity, wrap_angle

View = tuple[Similarity, Detections]
Record = Mapping[str, Mapping[int, View]]
"""The views of each frame, by number."""

_NUMBERS = (
    "view", "flip_y", "rotation_rad", "scale", "score",
    "x", "y", "z", "length", "width", "height", "yaw",
)  # fmt: skip
_COLUMNS = ("frame", "category", *_NUMBERS)


@dataclass(frozen=True)
class TableRecord:
    """A `Record` from a CSV file.

    Attributes:
        path: the file.
        frames: what it holds.
    """

    path: Path
    frames: Record

    @classmethod
    def read(cls, path: Path) -> "TableRecord":
        """The record in a file; see `read_record`."""
        return cls(path, read_record(path))

    @property
    def has_views(self) -> bool:
        """Its columns say that it may; a copy without boxes leaves no row."""
        return True

    def frame_ids(self) -> tuple[str, ...]:
        """The recorded frames, in sorted order."""
        return tuple(sorted(self.frames))

    def answer(self, frame_id: str) -> Detections:
        """What was recorded for the frame as it is; DataError where nothing was recorded."""
        _, found = self._views(frame_id).get(0, (Similarity(), Detections.empty()))
        return found

    def views(self, frame_id: str) -> Sequence[View]:
        """The augmented copies in the order of their numbers; DataError like `answer`."""
        return [view for number, view in sorted(self._views(frame_id).items()) if number]

    def _views(self, frame_id: str) -> Mapping[int, View]:
        if frame_id not in self.frames:
            raise DataError(f"no recorded detections for frame {frame_id} in {self.path}")
        return self.frames[frame_id]


def read_record(path: Path) -> Record:
    """The views of each frame in a CSV file of recorded detections.

    Raises:
        DataError: the file is missing or no CSV file, a column is missing, or a row has a wrong
            number of fields or a value that cannot be.
    """
    rows, lines = _read_rows(path)
    numbers = _parse_numbers(path, rows, lines)
    _refuse_impossible(path, lines, numbers)
    similarities, scores = numbers[:, 1:4], numbers[:, 4]
    boxes = numbers[:, 5:].copy()
    boxes[:, 6] = wrap_angle(boxes[:, 6])
    categories = as_categories([row[1] for row in rows])
    record: dict[str, dict[int, View]] = {}
    for (frame_id, view), index in _rows_by_view(rows, numbers[:, 0]).items():
        own = similarities[index[0]]
        odd = index[(similarities[index] != own).any(axis=1)]
        if len(odd):
            raise DataError(
                f"{path}:{lines[odd[0]]}: flip_y, rotation_rad or scale differ from line "
                f"{lines[index[0]]}, which is of the same frame and view"
            )
        similarity = Similarity(bool(own[0]), float(own[1]), float(own[2]))
        found = Detections(boxes[index], scores[index], categories[index])
        record.setdefault(frame_id, {})[view] = (similarity, found)
    return record


def _read_rows(path: Path) -> tuple[list[list[str]], list[int]]:
    """The fields of each row in the order of `_COLUMNS`, and each row's line in the file."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.reader(file)
            header = next(reader, [])
            missing = [name for name in _COLUMNS if name not in header]
            if missing:
                raise DataError(f"{path}:1: no column {', '.join(missing)} in the header")
            rows = [(row, reader.line_num) for row in reader if row]
    except FileNotFoundError:
        raise DataError(f"{path}: no such file of recorded detections") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        words = " ".join(str(error).split())
        raise DataError(f"{path}: cannot be read as CSV: {words}") from error
    for row, line in rows:
        if len(row) != len(header):
            raise DataError(f"{path}:{line}: {len(row)} fields, the header has {len(header)}")
    order = [header.index(name) for name in _COLUMNS]
    return [[row[place] for place in order] for row, _ in rows], [line for _, line in rows]


def _parse_numbers(path: Path, rows: list[list[str]], lines: list[int]) -> np.ndarray:
    """(n, 12) the columns of `_NUMBERS`."""
    numbers = np.empty((len(rows), len(_NUMBERS)))
    for index, (row, line) in enumerate(zip(rows, lines, strict=True)):
        try:
            numbers[index] = [float(field) for field in row[2:]]
        except ValueError as error:
            raise DataError(f"{path}:{line}: {str(error)[:120]}") from None
    return numbers


def _refuse_impossible(path: Path, lines: list[int], numbers: np.ndarray) -> None:
    """DataError at the first row that no detector can have answered."""
    view, flip_y, rotation_rad, scale, score = numbers[:, :5].T
    identity = (flip_y == 0) & (rotation_rad == 0) & (scale == 1)
    faults = {
        "a number is NaN or infinite": ~np.isfinite(numbers).all(axis=1),
        f"a number is beyond {LARGEST:g}": (np.abs(numbers) > LARGEST).any(axis=1),
        "view is not 0, 1, 2, ...": (view < 0) | (view != np.floor(view)),
        "flip_y is neither 0 nor 1": (flip_y != 0) & (flip_y != 1),
        "scale is not positive": scale <= 0,
        "view 0 is the frame as it is, but flip_y, rotation_rad, scale are not 0, 0, 1": (
            (view == 0) & ~identity
        ),
        "score is not in [0, 1]": (score < 0) | (score > 1),
        "length, width or height is not positive": (numbers[:, 8:11] <= 0).any(axis=1),
    }
    for fault, rows in faults.items():
        if rows.any():
            raise DataError(f"{path}:{lines[int(np.argmax(rows))]}: {fault}")


def _rows_by_view(rows: list[list[str]], views: np.ndarray) -> Mapping[tuple[str, int], np.ndarray]:
    """The rows of each frame and view, in the order of the file."""
    groups: dict[tuple[str, int], list[int]] = {}
    for index, (row, view) in enumerate(zip(rows, views, strict=True)):
        groups.setdefault((row[0], int(view)), []).append(index)
    return {key: np.array(index) for key, index in groups.items()}
