"""Detections and augmented views in one CSV file.

The record is a CSV file with a header and one row per box: frame, view, flip_y, rotation_rad,
scale, category, score, x, y, z, length, width, height, yaw; other columns are ignored. Without the
columns view, flip_y, rotation_rad and scale every row belongs to the original frame. View 0 is the
original frame; view v >= 1 is an augmented copy A(x) with A given by flip_y, rotation_rad and scale
(see `Similarity`). Boxes are centre boxes in the LiDAR frame of their view, in metres and radians.
See `curate.files.csv_text` for the variations of CSV that are read.

A frame or view without boxes has no row in such a file and cannot be distinguished from one that
was never recorded. A frame without any row is therefore an error: it is reported as a failed frame,
not as an empty scene. A frame that has only rows of other views has no detections in this view.
"""

import codecs
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO

import numpy as np

from curate.detections import Detections, as_categories
from curate.detectors.recorded.results import invalid_rows
from curate.detectors.scores import describe_invalid_scores
from curate.errors import DataError, one_line
from curate.files.batches import batched
from curate.files.csv_text import Header, number_problem
from curate.files.text import check_not_utf16
from curate.geometry.similarity import Similarity, wrap_angle

View = tuple[Similarity, Detections]

_NUMBERS = (
    "view", "flip_y", "rotation_rad", "scale", "score",
    "x", "y", "z", "length", "width", "height", "yaw",
)  # fmt: skip
_COLUMNS = ("frame", "category", *_NUMBERS)
_ORIGINAL = {"view": "0", "flip_y": "0", "rotation_rad": "0", "scale": "1"}  # without views
BLOCK_ROWS = 4096  # rows checked at once


@dataclass(frozen=True)
class TableRecord:
    """A `Record` in a CSV file; memory holds only where the rows of each frame are.

    Attributes:
        path: the file.
        header: its first row.
        order: index of each of `_COLUMNS` in a row; None for a column of views if there are none.
        names: (n,) the frame of each run of consecutive rows, as UTF-8, sorted.
        places: (n, 3) first byte, end byte and first line of each run.
        categories: the category names of all rows.
        sigmoid: whether the scores are logits.
    """

    path: Path
    header: Header
    order: tuple[int | None, ...]
    names: np.ndarray
    places: np.ndarray
    categories: frozenset[str]
    sigmoid: bool = False

    @classmethod
    def read(cls, path: Path, *, sigmoid: bool = False) -> "TableRecord":
        """Check every row of a file and index the rows of its frames.

        Args:
            path: the file.
            sigmoid: whether the scores are logits, in any range.

        Raises:
            DataError: if the file is missing or not a CSV file, a column is missing, a row has a
                wrong number of fields or an invalid value, or a row occurs twice.
        """
        try:
            with path.open("rb") as file:
                rows = _Rows(path, file)
                order = _places(path, rows.header)
                categories: set[str] = set()
                blocks = []
                for block in rows.blocks(order):
                    blocks.append(_check_block(path, block, sigmoid))
                    categories.update(row[1] for row in block.rows)
        except FileNotFoundError:
            raise DataError(f"{path}: no such file of recorded detections") from None
        except OSError as error:
            raise DataError(f"{path}: cannot be read as CSV: {one_line(error)}") from error
        runs = _Runs.joined(blocks)
        _check_repeated(path, runs.hashes, runs.places[:, 2])
        sort = np.argsort(runs.names, kind="stable")
        names, places = runs.names[sort], runs.places[sort]
        return cls(path, rows.header, order, names, places, frozenset(categories), sigmoid)

    @property
    def has_views(self) -> bool:
        """Whether there are columns of views; a view without boxes has no row."""
        return None not in self.order

    def frame_ids(self) -> Iterator[str]:
        """Return the recorded frames, in sorted order."""
        return (name.decode() for name in np.unique(self.names))

    def category_names(self) -> frozenset[str]:
        """Return the category names of all boxes."""
        return self.categories

    def check(self, frame_ids: Iterable[str]) -> None:
        """Do nothing: every row was checked when the file was read."""

    def result(self, frame_id: str) -> Detections:
        """Return the detections of the original frame.

        Raises:
            DataError: if the frame was not recorded.
        """
        _, found = self._views(frame_id).get(0, (Similarity(), Detections.empty()))
        return found

    def views(self, frame_id: str) -> Sequence[View]:
        """Return the augmented copies of a frame in the order of their numbers.

        Raises:
            DataError: if the frame was not recorded.
        """
        return [view for number, view in sorted(self._views(frame_id).items()) if number]

    def _views(self, frame_id: str) -> Mapping[int, View]:
        key = np.bytes_(frame_id.encode())
        first, last = (int(np.searchsorted(self.names, key, side)) for side in ("left", "right"))
        if first == last:
            raise DataError(f"no recorded detections for frame {frame_id} in {self.path}")
        fields: list[Sequence[str]] = []
        lines: list[int] = []
        ordered = _in_order(self.order)
        with self.path.open("rb") as file:
            for begin, end, line in self.places[first:last].tolist():
                file.seek(begin)
                text = io.StringIO(file.read(end - begin).decode(), newline="")
                for number, row in self.header.rows(text, self.path, line):
                    fields.append(ordered(row))
                    lines.append(number)
        return _views_of(self.path, fields, lines, _numbers(self.path, fields, lines, self.sigmoid))


@dataclass(frozen=True)
class _Block:
    """Consecutive rows of the file.

    Attributes:
        rows: the fields of each row, in the order of `_COLUMNS`.
        places: (n, 3) first byte, end byte and line of each row.
    """

    rows: Sequence[Sequence[str]]
    places: np.ndarray


@dataclass(frozen=True)
class _Runs:
    """Runs of consecutive rows of the same frame, in the order of the file.

    Attributes:
        names: (n,) the frame of each run, as UTF-8.
        places: (n, 3) first byte, end byte and first line of each run.
        hashes: (n,) int64, the sum of the hashes of its rows.
    """

    names: np.ndarray
    places: np.ndarray
    hashes: np.ndarray

    @classmethod
    def joined(cls, blocks: Sequence["_Runs"]) -> "_Runs":
        """Return the runs of all blocks; a run may continue in the next block."""
        if not blocks:
            return cls(np.empty(0, "S1"), np.empty((0, 3), np.int64), np.empty(0, np.int64))
        names = np.concatenate([each.names for each in blocks])
        places = np.concatenate([each.places for each in blocks])
        hashes = np.concatenate([each.hashes for each in blocks])
        first = _first_of_runs(names)
        ends = places[_last_of_runs(first, names), 1]
        places = np.column_stack([places[first, 0], ends, places[first, 2]])
        return cls(names[first], places, np.add.reduceat(hashes, first))


class _Rows:
    """The rows of an open CSV file with their positions in the file."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path = path
        self._end = 0
        self._lines = self._read_lines(file)
        self.header = Header.read(self._lines)

    def _read_lines(self, file: BinaryIO) -> Iterator[str]:
        for line in file:
            if self._end == 0:
                check_not_utf16(line[:4], self.path)
            # Old Macs end a line with a carriage return alone.
            for part in line.splitlines(keepends=True) if b"\r" in line[:-2] else (line,):
                # Spreadsheets write a byte order mark at the start of a file.
                text = part.removeprefix(codecs.BOM_UTF8) if self._end == 0 else part
                self._end += len(part)
                yield self._decoded(text)

    def _decoded(self, line: bytes) -> str:
        try:
            return line.decode()
        except UnicodeDecodeError as error:
            raise DataError(
                f"{self.path}: not UTF-8 text (byte {self._end - len(line) + error.start}); save "
                "the file as UTF-8"
            ) from None

    def blocks(self, order: Sequence[int | None]) -> Iterator[_Block]:
        """Yield all rows in blocks; raise DataError for a row with a wrong number of fields."""
        for block in batched(self._rows_with_places(order), BLOCK_ROWS):
            yield _Block([row for row, _ in block], np.array([place for _, place in block]))

    def _rows_with_places(
        self, order: Sequence[int | None]
    ) -> Iterator[tuple[Sequence[str], tuple[int, int, int]]]:
        begin, ordered = self._end, _in_order(order)
        for line, row in self.header.rows(self._lines, self.path, self.header.line + 1):
            yield ordered(row), (begin, self._end, line)
            begin = self._end


def _places(path: Path, header: Header) -> tuple[int | None, ...]:
    """Return the index of each of `_COLUMNS` in a row, None for views that a file does not have."""
    known = {name.casefold() for name in header.names}
    without = known.isdisjoint(_ORIGINAL)
    needed = [name for name in _COLUMNS if not (without and name in _ORIGINAL)]
    found = dict(zip(needed, header.places(path, needed), strict=True))
    return tuple(found.get(name) for name in _COLUMNS)


def _in_order(order: Sequence[int | None]) -> Callable[[list[str]], Sequence[str]]:
    """Return a function that returns the fields of a row in the order of `_COLUMNS`."""
    if None not in order:
        return itemgetter(*order)
    # The fields of views that a file does not have are taken from behind the row.
    defaults = [
        _ORIGINAL[name] for name, place in zip(_COLUMNS, order, strict=True) if place is None
    ]
    behind = iter(range(-len(defaults), 0))
    chosen = itemgetter(*(next(behind) if place is None else place for place in order))
    return lambda row: chosen([*row, *defaults])


def _check_block(path: Path, block: _Block, sigmoid: bool) -> _Runs:
    """Check the rows of a block and return its runs.

    Raises:
        DataError: if a row has an invalid value or occurs twice.
    """
    lines = block.places[:, 2]
    numbers = _numbers(path, block.rows, lines.tolist(), sigmoid)
    _views_of(path, block.rows, lines.tolist(), numbers)
    hashes = np.fromiter(
        (
            hash((row[0], row[1], values.tobytes()))
            for row, values in zip(block.rows, numbers, strict=True)
        ),
        np.int64,
        len(numbers),
    )
    _check_repeated(path, hashes, lines)
    names = np.array([row[0].encode() for row in block.rows])
    first = _first_of_runs(names)
    last = _last_of_runs(first, names)
    begin, end, line = block.places[first, 0], block.places[last, 1], lines[first]
    places = np.column_stack([begin, end, line])
    return _Runs(names[first], places, np.add.reduceat(hashes, first))


def _first_of_runs(names: np.ndarray) -> np.ndarray:
    """Return the index of the first of consecutive equal names."""
    return np.flatnonzero(np.append(True, names[1:] != names[:-1]))


def _last_of_runs(first: np.ndarray, names: np.ndarray) -> np.ndarray:
    """Return the index of the last of consecutive equal names."""
    return np.append(first[1:], len(names)) - 1


def _check_repeated(path: Path, hashes: np.ndarray, lines: np.ndarray) -> None:
    """Raise DataError if two hashes are the same, as in a file that was appended to itself.

    Args:
        path: the file, for messages.
        hashes: (n,) of the rows of a block, or of the runs of the file: a hash for each of its rows
            would need more memory than all else. A row that occurs again far away in another run of
            its frame is found when the frame is read.
        lines: (n,) their lines.
    """
    order = np.argsort(hashes, kind="stable")
    again = np.flatnonzero(hashes[order][1:] == hashes[order][:-1])
    if len(again):
        k = again[np.argmin(lines[order][again + 1])]
        raise DataError(
            f"{path}:{lines[order][k + 1]}: the same row as line {lines[order][k]}; were the "
            "results written twice into one file?"
        )


def _views_of(
    path: Path, rows: Sequence[Sequence[str]], lines: Sequence[int], numbers: np.ndarray
) -> dict[int, View]:
    """Return the views in the rows of one frame, by number.

    Rows of several frames are checked as well, but their views overwrite each other in the result.

    Args:
        path: the file, for messages.
        rows: the fields of the rows, in the order of `_COLUMNS`.
        lines: their lines.
        numbers: (n, 12) the columns of `_NUMBERS`.

    Raises:
        DataError: if rows of one view disagree on A.
    """
    similarities, scores = numbers[:, 1:4], numbers[:, 4]
    boxes = numbers[:, 5:].copy()
    boxes[:, 6] = wrap_angle(boxes[:, 6])
    categories = as_categories([row[1] for row in rows])
    views: dict[int, View] = {}
    for (_, view), index in _rows_by_view(rows, numbers[:, 0]).items():
        first = similarities[index[0]]
        different = index[(similarities[index] != first).any(axis=1)]
        if len(different):
            raise DataError(
                f"{path}:{lines[different[0]]}: flip_y, rotation_rad or scale differ from line "
                f"{lines[index[0]]}, which is of the same frame and view"
            )
        similarity = Similarity(bool(first[0]), float(first[1]), float(first[2]))
        views[view] = (similarity, Detections(boxes[index], scores[index], categories[index]))
    return views


def _numbers(
    path: Path, rows: Sequence[Sequence[str]], lines: Sequence[int], sigmoid: bool
) -> np.ndarray:
    """Return the (n, 12) columns of `_NUMBERS`; raise DataError for an invalid value."""
    fields = chain.from_iterable(row[2:] for row in rows)
    try:
        numbers = np.fromiter(map(float, fields), np.float64).reshape(len(rows), len(_NUMBERS))
    except ValueError:
        problems = (
            (line, next(filter(None, map(number_problem, row[2:])), None))
            for row, line in zip(rows, lines, strict=True)
        )
        line, problem = next(each for each in problems if each[1])
        raise DataError(f"{path}:{line}: {problem}") from None
    _check_values(path, lines, numbers, sigmoid)
    return numbers


def _check_values(path: Path, lines: Sequence[int], numbers: np.ndarray, sigmoid: bool) -> None:
    """Raise DataError for the first row that cannot be a detection."""
    view, flip_y, rotation_rad, scale, score = numbers[:, :5].T
    identity = (flip_y == 0) & (rotation_rad == 0) & (scale == 1)
    invalid = {
        **invalid_rows(numbers[:, 5:], score),
        "rotation_rad or scale is NaN or infinite": ~np.isfinite(numbers).all(axis=1),
        "view is not 0, 1, 2, ...": (view < 0) | (view != np.floor(view)),
        "flip_y is neither 0 nor 1": (flip_y != 0) & (flip_y != 1),
        "scale is not positive": scale <= 0,
        "view 0 is the original frame, but flip_y, rotation_rad, scale are not 0, 0, 1": (
            (view == 0) & ~identity
        ),
    }
    problem = describe_invalid_scores(score.min(initial=0), score.max(initial=0))
    if problem and not sigmoid:
        invalid[problem] = (score < 0) | (score > 1)
    for reason, rows in invalid.items():
        if rows.any():
            raise DataError(f"{path}:{lines[int(np.argmax(rows))]}: {reason}")


def _rows_by_view(
    rows: Sequence[Sequence[str]], views: np.ndarray
) -> Mapping[tuple[str, int], np.ndarray]:
    """Return the row indices of each frame and view, in the order of the file."""
    groups: dict[tuple[str, int], list[int]] = {}
    for index, (row, view) in enumerate(zip(rows, views, strict=True)):
        groups.setdefault((row[0], int(view)), []).append(index)
    return {key: np.array(index) for key, index in groups.items()}
