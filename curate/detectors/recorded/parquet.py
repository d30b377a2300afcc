"""Detections and augmented views in one Parquet file, such as curate's own export.

The columns are those of the CSV record: frame, category, score, x, y, z, length, width, height,
yaw, and for augmented copies view, flip_y, rotation_rad, scale; without these four every row is of
the frame as it is. Other columns are not read, so the labels that `curate export --format parquet`
writes are a record of the predictions they come from.

Only the rows' frames and views are held, as runs within row groups; boxes are read when a frame is
asked for, a row group at a time, and a bad row fails its frame alone. A file that claims more rows
than boxes can be packed into it is refused.
"""

from collections.abc import Mapping, Sequence
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
_BOXES = ("score", *BOX_COLUMNS)
_NEEDED = ("frame", "category", *_BOXES)
_NAMES = frozenset({"frame", "category"})
_GROUPS_HELD = 2
# Boxes do not compress further; what does, unfolds to any size.
_FEWEST_BYTES_PER_ROW = 4
_MOST_NAME_BYTES = 256 << 20  # of a column of names in a row group

View = tuple[Similarity, Detections]
Runs = Mapping[str, list[tuple[int, int, int]]]
"""Of each frame: row group, first row in it, and the row after the last."""


@dataclass(frozen=True)
class ParquetRecord:
    """A `Record` in a Parquet file.

    Attributes:
        path: the file.
        has_views: whether it has the columns of augmented copies.
        runs: where each frame's rows are.
    """

    path: Path
    has_views: bool
    runs: Runs

    @classmethod
    def read(cls, path: Path) -> "ParquetRecord":
        """Return the record in a file, of which only the column of frames is read.

        Raises:
            ConfigError: pyarrow is not installed.
            DataError: if the file is missing, damaged or no Parquet, or a column is missing or of a
                wrong type.
        """
        file = _open(path)
        names = file.schema_arrow.names
        own = [name for name in VIEW_COLUMNS if name in names]
        wanted = (*_NEEDED, *(VIEW_COLUMNS if own else ()))
        missing = [name for name in wanted if name not in names]
        if missing:
            raise DataError(f"{path}: no column {', '.join(missing)}; it has {', '.join(names)}")
        _check_types(path, file.schema_arrow, wanted)
        _check_expansion(path, file.metadata)
        return cls(path, bool(own), _runs(path, file))

    def frame_ids(self) -> tuple[str, ...]:
        """Return the recorded frames, in sorted order."""
        return tuple(sorted(self.runs))

    def answer(self, frame_id: str) -> Detections:
        """What was recorded for the frame as it is; DataError where nothing was recorded."""
        _, found = self._views(frame_id).get(0, (Similarity(), Detections.empty()))
        return found

    def views(self, frame_id: str) -> Sequence[View]:
        """Return the augmented copies in the order of their numbers; DataError like `answer`."""
        return [view for number, view in sorted(self._views(frame_id).items()) if number]

    @cached_property
    def _groups(self) -> Any:
        """Reads a row group, and keeps the last ones."""
        columns = [*_NEEDED[1:], *(VIEW_COLUMNS if self.has_views else ())]
        return lru_cache(_GROUPS_HELD)(lambda number: _group(self.path, number, columns))

    def _views(self, frame_id: str) -> Mapping[int, View]:
        """Return all that was recorded for a frame, by the number of the view."""
        if frame_id not in self.runs:
            raise DataError(f"no recorded detections for frame {frame_id} in {self.path}")
        parts = [self._part(*run) for run in self.runs[frame_id]]
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        place = f"{self.path}: frame {frame_id}"
        boxes = np.column_stack([columns[name] for name in BOX_COLUMNS])
        found = as_detections(place, boxes, columns["score"], columns["category"])
        if not self.has_views:
            return {0: (Similarity(), found)}
        told = np.column_stack([columns[name] for name in VIEW_COLUMNS])
        _check_views(place, told)
        views = {}
        for number in np.unique(told[:, 0]):
            own = np.flatnonzero(told[:, 0] == number)
            _, flip_y, rotation_rad, scale = told[own[0]].tolist()
            views[int(number)] = (
                Similarity(bool(flip_y), rotation_rad, scale),
                found.select(own),
            )
        return views

    def _part(self, group: int, start: int, stop: int) -> Mapping[str, np.ndarray]:
        return {name: column[start:stop] for name, column in self._groups(group).items()}


def _open(path: Path) -> Any:
    arrow, parquet = load_parquet()
    try:
        return parquet.ParquetFile(path, read_dictionary=sorted(_NAMES))
    except FileNotFoundError:
        raise DataError(f"{path}: no such file of recorded detections") from None
    except (arrow.ArrowException, OSError, UnicodeError) as error:
        raise DataError(f"{path}: no readable Parquet: {one_line(error)}") from None


def _check_types(path: Path, schema: Any, names: Sequence[str]) -> None:
    """Raise DataError if a column holds neither names nor numbers as it should."""
    arrow, _ = load_parquet()
    for name in names:
        kind = schema.field(name).type
        kind = kind.value_type if arrow.types.is_dictionary(kind) else kind
        of = arrow.types
        text = of.is_string(kind) or of.is_large_string(kind) or of.is_integer(kind)
        number = of.is_integer(kind) or of.is_floating(kind) or of.is_boolean(kind)
        if not (text if name in _NAMES else number):
            raise DataError(f"{path}: column {name} is of type {kind}")


def _check_expansion(path: Path, metadata: Any) -> None:
    """Raise DataError if a file claims far more than its bytes can hold."""
    size = path.stat().st_size
    if metadata.num_rows * _FEWEST_BYTES_PER_ROW > size:
        raise DataError(
            f"{path}: {metadata.num_rows} rows in {size} bytes cannot be different boxes"
        )
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        for column in map(group.column, range(group.num_columns)):
            if (
                column.path_in_schema in _NAMES
                and column.total_uncompressed_size > _MOST_NAME_BYTES
            ):
                raise DataError(
                    f"{path}: row group {number}: column {column.path_in_schema} unfolds to "
                    f"{column.total_uncompressed_size} bytes; up to {_MOST_NAME_BYTES} are read"
                )


def _runs(path: Path, file: Any) -> Runs:
    """Where each frame's rows are, from the column of frames alone."""
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
    """Columns of a row group: names as objects, numbers as float64."""
    arrow, _ = load_parquet()
    try:
        table = file.read_row_group(number, columns=list(columns), use_threads=False)
        return {name: _values(path, number, arrow, name, table.column(name)) for name in columns}
    except (arrow.ArrowException, OSError, UnicodeError) as error:
        raise DataError(f"{path}: row group {number} is damaged: {one_line(error)}") from None


def _values(path: Path, number: int, arrow: Any, name: str, column: Any) -> np.ndarray:
    missing = column.null_count
    if name in _NAMES:
        chunks = [_coded(arrow, chunk) for chunk in column.chunks]
        missing += sum(chunk.dictionary.null_count for chunk in chunks)
    elif arrow.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if missing:
        raise DataError(f"{path}: row group {number}: {missing} rows have no {name}")
    if name in _NAMES:
        return np.concatenate([np.empty(0, object), *map(_named, chunks)])
    return np.asarray(column.cast(arrow.float64()).to_numpy())


def _coded(arrow: Any, chunk: Any) -> Any:
    """Return a chunk of names as numbers of those that it has."""
    if arrow.types.is_dictionary(chunk.type):
        return chunk
    return chunk.cast(arrow.string()).dictionary_encode()


def _named(chunk: Any) -> np.ndarray:
    """Return (n,) the names; equal ones are one object."""
    names = np.array([str(name) for name in chunk.dictionary.to_pylist()], dtype=object)
    named: np.ndarray = names[chunk.indices.to_numpy()]
    return named


def _check_views(place: str, told: np.ndarray) -> None:
    """Raise DataError if the four columns of views contradict each other."""
    view, flip_y, _, scale = told.T
    identity = (told[:, 1:] == [0, 0, 1]).all(axis=1)
    _, first, own = np.unique(view, return_index=True, return_inverse=True)
    faults = {
        "view is not 0, 1, 2, ...": (view < 0) | (view != np.floor(view)),
        "flip_y is neither 0 nor 1": (flip_y != 0) & (flip_y != 1),
        "rotation_rad or scale is NaN or infinite": ~np.isfinite(told).all(axis=1),
        "scale is not positive": scale <= 0,
        "view 0 is the frame as it is, but flip_y, rotation_rad, scale are not 0, 0, 1": (
            (view == 0) & ~identity
        ),
        "flip_y, rotation_rad or scale differ within a view": (told != told[first[own]]).any(
            axis=1
        ),
    }
    for fault, rows in faults.items():
        if rows.any():
            raise DataError(f"{place}: box {int(np.argmax(rows))}: {fault}")
