"""Detections and augmented views in one Parquet file, such as curate's own export.

The columns are those of the CSV record: frame, category, score, x, y, z, length, width, height,
yaw, and for augmented copies view, flip_y, rotation_rad, scale. Without these four columns every
row belongs to the original frame. Other columns are not read, so the labels that
`curate export --format parquet` writes are a record of the predictions they come from.

Memory holds only where the rows of each frame are, as runs within row groups. Boxes are read when a
frame is requested, a row group at a time, and an invalid row affects only its frame. A file that
claims more rows than its bytes can hold is rejected.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from curate.detections import Detections
from curate.detectors.recorded.results import as_detections
from curate.errors import DataError, one_line
from curate.exporters.base import BOX_COLUMNS
from curate.files.parquet import load_parquet
from curate.geometry.similarity import Similarity

VIEW_COLUMNS = ("view", "flip_y", "rotation_rad", "scale")
_REQUIRED = ("frame", "category", "score", *BOX_COLUMNS)
_TEXT_COLUMNS = frozenset({"frame", "category"})
_CACHED_GROUPS = 2
# The numbers of different boxes do not compress below this. A file with fewer bytes per row
# compresses better than boxes can, and could expand to any size.
_MIN_BYTES_PER_ROW = 4
_MAX_TEXT_BYTES = 256 << 20  # of a text column in a row group

View = tuple[Similarity, Detections]
Runs = Mapping[str, list[tuple[int, int, int]]]
"""Of each frame: row group, first row in it, and the row after the last."""


@dataclass(frozen=True)
class ParquetRecord:
    """A `Record` in a Parquet file.

    Attributes:
        path: the file.
        has_views: whether it has the columns of augmented copies.
        runs: location of the rows of each frame.
    """

    path: Path
    has_views: bool
    runs: Runs

    @classmethod
    def read(cls, path: Path) -> "ParquetRecord":
        """Return the record in a file; reads only the column of frames.

        Raises:
            ConfigError: if pyarrow is not installed.
            DataError: if the file is missing, damaged or not a Parquet file, or a column is missing
                or of a wrong type.
        """
        file = _open(path)
        names = file.schema_arrow.names
        has_views = any(name in names for name in VIEW_COLUMNS)
        required = (*_REQUIRED, *(VIEW_COLUMNS if has_views else ()))
        missing = [name for name in required if name not in names]
        if missing:
            raise DataError(f"{path}: no column {', '.join(missing)}; it has {', '.join(names)}")
        _check_types(path, file.schema_arrow, required)
        _check_expansion(path, file.metadata)
        return cls(path, has_views, _runs(path, file))

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

    @cached_property
    def _groups(self) -> Any:
        """Function that reads a row group; it caches the last ones."""
        columns = [*_REQUIRED[1:], *(VIEW_COLUMNS if self.has_views else ())]
        return lru_cache(_CACHED_GROUPS)(lambda number: _group(self.path, number, columns))

    def _views(self, frame_id: str) -> Mapping[int, View]:
        """Return all views of a frame by their number."""
        if frame_id not in self.runs:
            raise DataError(f"no recorded detections for frame {frame_id} in {self.path}")
        parts = [self._part(*run) for run in self.runs[frame_id]]
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        place = f"{self.path}: frame {frame_id}"
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

    def _part(self, group: int, start: int, stop: int) -> Mapping[str, np.ndarray]:
        return {name: column[start:stop] for name, column in self._groups(group).items()}


def _open(path: Path) -> Any:
    arrow, parquet = load_parquet()
    try:
        return parquet.ParquetFile(path, read_dictionary=sorted(_TEXT_COLUMNS))
    except FileNotFoundError:
        raise DataError(f"{path}: no such file of recorded detections") from None
    except (arrow.ArrowException, OSError, UnicodeError) as error:
        raise DataError(f"{path}: not a readable Parquet file: {one_line(error)}") from None


def _check_types(path: Path, schema: Any, names: Sequence[str]) -> None:
    """Raise DataError if a text column does not contain text, or another one no numbers."""
    arrow, _ = load_parquet()
    for name in names:
        kind = schema.field(name).type
        kind = kind.value_type if arrow.types.is_dictionary(kind) else kind
        is_a = arrow.types
        text = is_a.is_string(kind) or is_a.is_large_string(kind) or is_a.is_integer(kind)
        number = is_a.is_integer(kind) or is_a.is_floating(kind) or is_a.is_boolean(kind)
        if not (text if name in _TEXT_COLUMNS else number):
            expected = "text or integers" if name in _TEXT_COLUMNS else "numbers"
            raise DataError(f"{path}: column {name} is of type {kind}, expected {expected}")


def _check_expansion(path: Path, metadata: Any) -> None:
    """Raise DataError if a file claims far more content than its bytes can hold."""
    size = path.stat().st_size
    if metadata.num_rows * _MIN_BYTES_PER_ROW > size:
        raise DataError(
            f"{path}: {metadata.num_rows} rows in {size} bytes cannot be different boxes"
        )
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        for column in map(group.column, range(group.num_columns)):
            if (
                column.path_in_schema in _TEXT_COLUMNS
                and column.total_uncompressed_size > _MAX_TEXT_BYTES
            ):
                raise DataError(
                    f"{path}: row group {number}: column {column.path_in_schema} expands to "
                    f"{column.total_uncompressed_size} bytes, the limit is {_MAX_TEXT_BYTES}; "
                    "write smaller row groups"
                )


def _runs(path: Path, file: Any) -> Runs:
    """Return the location of the rows of each frame; reads only the column of frames."""
    runs: dict[str, list[tuple[int, int, int]]] = {}
    for number in range(file.num_row_groups):
        frames = _read(path, file, number, ["frame"])["frame"]
        if not len(frames):
            continue
        starts = np.flatnonzero(np.append(True, frames[1:] != frames[:-1]))
        stops = np.append(starts[1:], len(frames))
        for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
            runs.setdefault(str(frames[start]), []).append((number, start, stop))
    return runs


def _group(path: Path, number: int, columns: Sequence[str]) -> Mapping[str, np.ndarray]:
    return _read(path, _open(path), number, columns)


def _read(path: Path, file: Any, number: int, columns: Sequence[str]) -> Mapping[str, np.ndarray]:
    """Return columns of a row group: text as objects, numbers as float64."""
    arrow, _ = load_parquet()
    try:
        table = file.read_row_group(number, columns=list(columns), use_threads=False)
        return {name: _values(path, number, arrow, name, table.column(name)) for name in columns}
    except (arrow.ArrowException, OSError, UnicodeError) as error:
        raise DataError(f"{path}: row group {number} is damaged: {one_line(error)}") from None


def _values(path: Path, number: int, arrow: Any, name: str, column: Any) -> np.ndarray:
    missing = column.null_count
    if name in _TEXT_COLUMNS:
        chunks = [_dictionary_encoded(arrow, chunk) for chunk in column.chunks]
        missing += sum(chunk.dictionary.null_count for chunk in chunks)
    elif arrow.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if missing:
        raise DataError(f"{path}: row group {number}: {missing} rows have no {name}")
    if name in _TEXT_COLUMNS:
        return np.concatenate([np.empty(0, object), *map(_texts, chunks)])
    return np.asarray(column.cast(arrow.float64()).to_numpy())


def _dictionary_encoded(arrow: Any, chunk: Any) -> Any:
    """Return a chunk of text as indices into its distinct values."""
    if arrow.types.is_dictionary(chunk.type):
        return chunk
    return chunk.cast(arrow.string()).dictionary_encode()


def _texts(chunk: Any) -> np.ndarray:
    """Return (n,) the texts of a chunk; equal texts share one object to save memory."""
    distinct = np.array([str(text) for text in chunk.dictionary.to_pylist()], dtype=object)
    texts: np.ndarray = distinct[chunk.indices.to_numpy()]
    return texts


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
