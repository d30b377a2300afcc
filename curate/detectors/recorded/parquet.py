"""Detections and augmented views in one Parquet file, such as curate's own export.

The columns are those of the CSV record: frame, category, score, x, y, z, length, width, height,
yaw, and for augmented copies view, flip_y, rotation_rad, scale. Without these four columns every
row belongs to the original frame. Other columns are not read, so the labels that
`curate export --format parquet` writes are a record of the predictions they come from.

A Parquet file is read one row group at a time, see `arrow_groups`. An invalid row affects only its
frame.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curate.detections import Detections
from curate.detectors.recorded.arrow_groups import ArrowGroups, Run
from curate.detectors.recorded.results import as_detections
from curate.errors import DataError
from curate.exporters.base import BOX_COLUMNS
from curate.geometry.similarity import Similarity

VIEW_COLUMNS = ("view", "flip_y", "rotation_rad", "scale")
_REQUIRED = ("frame", "category", "score", *BOX_COLUMNS)

View = tuple[Similarity, Detections]


@dataclass(frozen=True)
class ParquetRecord:
    """A `Record` in a Parquet file.

    Attributes:
        groups: the file.
        has_views: whether it has the columns of augmented copies.
        runs: location of the rows of each frame.
    """

    groups: ArrowGroups
    has_views: bool
    runs: Mapping[str, Sequence[Run]]

    @classmethod
    def read(cls, path: Path) -> "ParquetRecord":
        """Return the record in a file; keeps only the location of each frame.

        Raises:
            ConfigError: if pyarrow is not installed.
            DataError: if the file is missing, damaged or not a Parquet file, or a column is missing
                or of a wrong type.
        """
        groups = ArrowGroups.of(path, ("frame", "category"), _required)
        runs = {frame: runs for (frame,), runs in groups.runs(("frame",)).items()}
        return cls(groups, "view" in groups.numbers, runs)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the recorded frames, in sorted order."""
        return tuple(sorted(self.runs))

    def check(self, frame_ids: Iterable[str]) -> None:
        """Do nothing: rows are checked when their frame is requested."""

    def result(self, frame_id: str) -> Detections:
        """Return the detections of the original frame.

        Raises:
            DataError: if the frame was not recorded, or its rows are invalid.
        """
        _, found = self._views(frame_id).get(0, (Similarity(), Detections.empty()))
        return found

    def views(self, frame_id: str) -> Sequence[View]:
        """Return the augmented copies of a frame in the order of their numbers.

        Raises:
            DataError: if the frame was not recorded, or its rows are invalid.
        """
        return [view for number, view in sorted(self._views(frame_id).items()) if number]

    def _views(self, frame_id: str) -> Mapping[int, View]:
        """Return all views of a frame by their number."""
        path = self.groups.path
        if frame_id not in self.runs:
            raise DataError(f"no recorded detections for frame {frame_id} in {path}")
        columns = self.groups.rows(self.runs[frame_id])
        place = f"{path}: frame {frame_id}"
        boxes = np.column_stack([columns[name] for name in BOX_COLUMNS])
        found = as_detections(place, boxes, columns["score"], columns["category"])
        if not self.has_views:
            return {0: (Similarity(), found)}
        view_values = np.column_stack([columns[name] for name in VIEW_COLUMNS])
        _check_views(place, view_values)
        views = {}
        for number in np.unique(view_values[:, 0]):
            rows = np.flatnonzero(view_values[:, 0] == number)
            _, flip_y, rotation_rad, scale = view_values[rows[0]].tolist()
            views[int(number)] = (
                Similarity(bool(flip_y), rotation_rad, scale),
                found.select(rows),
            )
        return views


def _required(names: Sequence[str]) -> Sequence[str]:
    """Return the required columns of a file with these columns."""
    has_views = any(name in names for name in VIEW_COLUMNS)
    return (*_REQUIRED, *(VIEW_COLUMNS if has_views else ()))


def _check_views(place: str, view_values: np.ndarray) -> None:
    """Raise DataError if (n, 4) values of `VIEW_COLUMNS` are invalid or contradict each other."""
    view, flip_y, _, scale = view_values.T
    identity = (view_values[:, 1:] == [0, 0, 1]).all(axis=1)
    _, first_row, view_index = np.unique(view, return_index=True, return_inverse=True)
    of_first_row = view_values[first_row[view_index]]
    invalid = {
        "view is not 0, 1, 2, ...": (view < 0) | (view != np.floor(view)),
        "flip_y is neither 0 nor 1": (flip_y != 0) & (flip_y != 1),
        "rotation_rad or scale is NaN or infinite": ~np.isfinite(view_values).all(axis=1),
        "scale is not positive": scale <= 0,
        "view 0 is the original frame, but flip_y, rotation_rad, scale are not 0, 0, 1": (
            (view == 0) & ~identity
        ),
        "flip_y, rotation_rad or scale differ within a view": (view_values != of_first_row).any(
            axis=1
        ),
    }
    for reason, rows in invalid.items():
        if rows.any():
            raise DataError(f"{place}: box {int(np.argmax(rows))}: {reason}")
