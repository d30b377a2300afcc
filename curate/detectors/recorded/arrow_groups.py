"""Columns of Parquet and Feather files, read one group of rows at a time.

Memory holds only where the rows of each frame are, as runs within groups: the row groups of
Parquet, the record batches of Feather. A column is text or numbers. Integers can be read as text,
too: a time in nanoseconds has more digits than a float64.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import DataError, one_line
from curate.files.child_process import require_survival
from curate.files.parquet import load_parquet

_CACHED_GROUPS = 2
# The numbers of different boxes do not compress below this. A file with fewer bytes per row
# compresses better than boxes can, and could expand to any size.
_MIN_BYTES_PER_ROW = 4
_MAX_TEXT_BYTES = 256 << 20  # of a text column in a row group

ColumnsOf = Callable[[Sequence[str]], Sequence[str]]
Run = tuple[int, int, int]
"""Group, first row in it, and the row after the last."""


@dataclass(frozen=True)
class ArrowGroups:
    """The required columns of a file that was found to be readable.

    Attributes:
        path: the file.
        texts: the columns that are read as text.
        numbers: the columns that are read as numbers.
    """

    path: Path
    texts: Sequence[str]
    numbers: Sequence[str]

    @classmethod
    def of(cls, path: Path, texts: Collection[str], columns_of: ColumnsOf) -> "ArrowGroups":
        """Return the groups of a file.

        Args:
            path: a .parquet or .feather file.
            texts: the columns that are read as text.
            columns_of: returns the required columns of a file with these columns; a function at the
                top level of a module.

        Raises:
            ConfigError: if pyarrow is not installed.
            DataError: if the file is missing or damaged, or a column is missing or of a wrong type.
        """
        require_survival(path, "pyarrow", _read_all, tuple(texts), columns_of)
        return cls.of_survived(path, texts, columns_of)

    @classmethod
    def of_survived(
        cls, path: Path, texts: Collection[str], columns_of: ColumnsOf
    ) -> "ArrowGroups":
        """Return the groups of a file that does not end the process; see `of`."""
        schema = _open(path, texts).schema
        with _errors_as_data_error(f"{path}: not a readable {_kind(path)} file"):
            names = list(schema.names)
        required = columns_of(names)
        missing = [name for name in required if name not in names]
        if missing:
            raise DataError(f"{path}: no column {', '.join(missing)}; it has {', '.join(names)}")
        for name in required:
            _check_type(path, name, schema.field(name).type, is_text=name in texts)
        numbers = [name for name in required if name not in texts]
        return cls(path, [name for name in required if name in texts], numbers)

    def runs(self, keys: Sequence[str]) -> dict[tuple[str, ...], list[Run]]:
        """Return the location of the rows of each frame; reads only the columns of its name.

        Args:
            keys: the text columns with equal values in all rows of a frame.
        """
        file = _open(self.path, self.texts)
        runs: dict[tuple[str, ...], list[Run]] = {}
        for number in range(file.count):
            columns = self._columns(file, number, keys)
            values = np.column_stack([columns[key] for key in keys])
            if not len(values):
                continue
            starts = np.flatnonzero(np.append(True, (values[1:] != values[:-1]).any(axis=1)))
            stops = np.append(starts[1:], len(values))
            for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
                frame = tuple(map(str, values[start]))
                runs.setdefault(frame, []).append((number, start, stop))
        return runs

    def rows(self, runs: Sequence[Run]) -> Mapping[str, np.ndarray]:
        """Return the columns of the rows in some runs: text as objects, numbers as float64.

        Raises:
            DataError: if a group is damaged, or a value is missing.
        """
        parts = [
            {name: column[start:stop] for name, column in self._groups(number).items()}
            for number, start, stop in runs
        ]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def distinct(self, name: str) -> frozenset[str]:
        """Return the different values of a text column; damaged groups are left out."""
        file, found = _open(self.path, self.texts), set[str]()
        for number in range(file.count):
            with suppress(DataError):
                found.update(self._columns(file, number, [name])[name])
        return frozenset(found)

    def read_all(self) -> None:
        """Read every group, without looking at its values."""
        for number in range(_open(self.path, self.texts).count):
            with suppress(DataError):  # the next group may be readable
                self._groups(number)

    @cached_property
    def _groups(self) -> Callable[[int], Mapping[str, np.ndarray]]:
        """Function that reads all columns of a group; it caches the last ones."""
        columns = [*self.texts, *self.numbers]

        def read(number: int) -> Mapping[str, np.ndarray]:
            return self._columns(_open(self.path, self.texts), number, columns)

        return lru_cache(_CACHED_GROUPS)(read)

    def _columns(
        self, file: "_File", number: int, columns: Sequence[str]
    ) -> Mapping[str, np.ndarray]:
        place = f"{self.path}: {file.group_name} {number}"
        with _errors_as_data_error(f"{place} is damaged"):
            table = file.read(number, columns)
            table.validate(full=True)  # e.g. indices beyond the distinct texts
            return {
                name: _values(place, name, table.column(name), is_text=name in self.texts)
                for name in columns
            }


def _read_all(path: Path, texts: Collection[str], columns_of: ColumnsOf) -> None:
    """Read everything in a file that `ArrowGroups` ever reads of it; called in a child process."""
    ArrowGroups.of_survived(path, texts, columns_of).read_all()


@dataclass(frozen=True)
class _File:
    """An open file.

    Attributes:
        schema: names and types of its columns.
        count: number of groups.
        group_name: what the format calls a group.
        read: returns a table of some columns of a group.
    """

    schema: Any
    count: int
    group_name: str
    read: Callable[[int, Sequence[str]], Any]


@contextmanager
def _errors_as_data_error(problem: str) -> Iterator[None]:
    """Convert the errors that pyarrow raises for a damaged file."""
    arrow, _ = load_parquet()
    try:
        yield
    except (arrow.ArrowException, LookupError, OSError, OverflowError, UnicodeError) as error:
        raise DataError(f"{problem}: {one_line(error, 300)}") from None


def _kind(path: Path) -> str:
    return "Feather" if path.suffix.lower() == ".feather" else "Parquet"


def _open(path: Path, texts: Collection[str]) -> _File:
    load_parquet()
    if not path.exists():
        raise DataError(f"{path}: no such file of recorded detections")
    with _errors_as_data_error(f"{path}: not a readable {_kind(path)} file"):
        return _open_feather(path) if _kind(path) == "Feather" else _open_parquet(path, texts)


def _open_parquet(path: Path, texts: Collection[str]) -> _File:
    _, parquet = load_parquet()
    metadata = parquet.read_metadata(path)
    own_texts = sorted(set(texts) & set(metadata.schema.names))
    file = parquet.ParquetFile(path, metadata=metadata, read_dictionary=own_texts)
    _check_expansion(path, metadata, own_texts)

    def read(number: int, columns: Sequence[str]) -> Any:
        return file.read_row_group(number, columns=list(columns), use_threads=False)

    return _File(file.schema_arrow, file.num_row_groups, "row group", read)


def _open_feather(path: Path) -> _File:
    arrow, _ = load_parquet()
    file = arrow.ipc.open_file(arrow.OSFile(str(path)))

    def read(number: int, columns: Sequence[str]) -> Any:
        batch = file.get_batch(number)
        return arrow.Table.from_batches([batch]).select(list(columns))

    return _File(file.schema, file.num_record_batches, "record batch", read)


def _check_type(path: Path, name: str, kind: Any, *, is_text: bool) -> None:
    """Raise DataError if a text column does not contain text, or another one no numbers."""
    arrow, _ = load_parquet()
    is_a = arrow.types
    kind = kind.value_type if is_a.is_dictionary(kind) else kind
    text = is_a.is_string(kind) or is_a.is_large_string(kind) or is_a.is_integer(kind)
    number = is_a.is_integer(kind) or is_a.is_floating(kind) or is_a.is_boolean(kind)
    if not (text if is_text else number):
        expected = "text or integers" if is_text else "numbers"
        raise DataError(f"{path}: column {name} is of type {kind}, expected {expected}")


def _check_expansion(path: Path, metadata: Any, texts: Collection[str]) -> None:
    """Raise DataError if a Parquet file claims far more content than its bytes can hold."""
    size = path.stat().st_size
    if metadata.num_rows * _MIN_BYTES_PER_ROW > size:
        raise DataError(
            f"{path}: {metadata.num_rows} rows in {size} bytes cannot be different boxes"
        )
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        for column in map(group.column, range(group.num_columns)):
            if column.path_in_schema in texts and column.total_uncompressed_size > _MAX_TEXT_BYTES:
                raise DataError(
                    f"{path}: row group {number}: column {column.path_in_schema} expands to "
                    f"{column.total_uncompressed_size} bytes, the limit is {_MAX_TEXT_BYTES}; "
                    "write smaller row groups"
                )


def _values(place: str, name: str, column: Any, *, is_text: bool) -> np.ndarray:
    """Return a column of a group: text as objects, numbers as float64."""
    arrow, _ = load_parquet()
    missing = column.null_count
    if is_text:
        chunks = [_dictionary_encoded(arrow, chunk) for chunk in column.chunks]
        missing += sum(chunk.dictionary.null_count for chunk in chunks)
    elif arrow.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if missing:
        raise DataError(f"{place}: no {name} in {missing} of {len(column)} rows")
    if is_text:
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
