"""Read exported labels as a pandas or polars DataFrame: `read_labels("labels.sqlite")`.

SQLite, CSV and Parquet exports can be read, because they contain every label with its weight. All
give the columns of `weighted_labels` with the same types. The types come from the declared columns:
a reader that guesses types would turn the frame id "000001" into the number 1.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, overload

from curate.errors import ConfigError, DataError, one_line
from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from curate.exporters.columns import WEIGHTED_LABELS
from curate.exporters.label_file import read_label_rows
from curate.exporters.parquet import FORMAT
from curate.files.batches import batched
from curate.files.csv_text import Header, open_lines
from curate.files.parquet import load_parquet
from curate.files.paths import StrPath

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

Library = Literal["pandas", "polars"]
Kind = type[int] | type[float] | type[str]
Kinds = Mapping[str, Kind]
"""The Python type of each column's values, any of which may be None."""
Row = Sequence[Any]

BLOCK_ROWS: Final = 65_536
_NOT_LABELS: Final = (
    "not exported labels; read_labels reads the formats sqlite, csv and parquet, which "
    "`curate export --format` writes"
)
_PANDAS: Final = {int: "Int64", float: "float64", str: "string"}
_CORE: Final[Kinds] = {
    column.name: {"name": str, "float64": float}.get(column.kind, int) for column in WEIGHTED_LABELS
}


@overload
def read_labels(path: StrPath, as_: Literal["pandas"]) -> "pd.DataFrame": ...
@overload
def read_labels(path: StrPath, as_: Literal["polars"]) -> "pl.DataFrame": ...
@overload
def read_labels(path: StrPath, as_: None = None) -> Any: ...
def read_labels(path: StrPath, as_: Library | None = None) -> Any:
    """Return exported labels as a DataFrame with one row per label, in the order of the file.

    The columns are those of `weighted_labels`: round, frame, k, category, the box (x, y, z, length,
    width, height in metres, yaw in radians; box centre, LiDAR frame), score, loss, the evidence,
    policy and weight. Frame ids are text: "000001" stays "000001". Unknown values are NaN, NA or
    null. The table does not contain the ground truth of labeled frames. The meaning of weight 0
    depends on the policy; see docs/training.md.

    Args:
        path: an export in the format sqlite, csv or parquet; the format is detected.
        as_: "pandas" or "polars"; by default pandas, or polars if only polars is installed.

    Raises:
        ConfigError: if the library is unknown or not installed, or pyarrow is missing for Parquet.
        DataError: if the file is missing, damaged, or not an export with weights.
    """
    path = Path(path)
    library = _choose(as_)
    start = _start(path)
    if start.startswith(b"PAR1"):
        return _read_parquet(path, library)
    if start.startswith(b"SQLite format 3\0"):
        with read_label_rows(path) as (kinds, rows):
            return _as_data_frame(library, kinds, rows)
    return _read_csv(path, library)


def _choose(as_: str | None) -> Library:
    for library in ("pandas", "polars"):
        if as_ in (None, library) and find_spec(library):
            return library
    if as_ in (None, "pandas", "polars"):
        raise ConfigError(f"read_labels needs {as_ or 'pandas or polars'}: pip install pandas")
    raise ConfigError(f"read_labels: unknown library {as_!r}; use pandas or polars")


def _start(path: Path) -> bytes:
    """Return the first bytes, enough to detect the format."""
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None


def _read_csv(path: Path, library: Library) -> Any:
    """Read a CSV export; columns beyond the core columns are numbers if all their values are.

    Raises:
        DataError: if a core column is missing, a row is too short or too long, or a value does not
            have its column's type.
    """
    header = Header.read(open_lines(path))
    known = {name.casefold() for name in header.names}
    if not known.issuperset(WEIGHTED_LABEL_COLUMNS):
        raise DataError(f"{path}: {_NOT_LABELS}")
    further = [name for name in header.names if name.casefold() not in WEIGHTED_LABEL_COLUMNS]
    names = (*WEIGHTED_LABEL_COLUMNS, *further)
    places = header.places(path, names)
    kinds = {**_CORE, **{name: _kind_of_texts(path, header, name) for name in further}}
    return _as_data_frame(library, kinds, _parse(path, _csv_rows(path), places, kinds))


def _csv_rows(path: Path) -> Iterator[tuple[int, Sequence[str]]]:
    lines = open_lines(path)
    header = Header.read(lines)
    yield from header.rows(lines, path, header.line + 1)


def _parse(
    path: Path, rows: Iterable[tuple[int, Sequence[str]]], places: Sequence[int], kinds: Kinds
) -> Iterator[Row]:
    for line, row in rows:
        texts = [row[place] for place in places]
        try:
            yield [
                kind(text) if text else None
                for kind, text in zip(kinds.values(), texts, strict=True)
            ]
        except (OverflowError, ValueError) as error:
            raise DataError(f"{path}:{line}: {one_line(error)}; export it again") from None


def _kind_of_texts(path: Path, header: Header, name: str) -> Kind:
    """Return int or float if every value of a column is written as such a number, else str.

    "7" is an int, but "007" is text, because an int would be written as "7".
    """
    fitting: list[Kind] = [int, float]
    (place,) = header.places(path, (name,))
    for _, row in _csv_rows(path):
        fitting = [kind for kind in fitting if not row[place] or _is_written_as(kind, row[place])]
    return fitting[0] if fitting else str


def _is_written_as(kind: Kind, text: str) -> bool:
    try:
        return str(kind(text)) == text
    except ValueError:
        return False


def _read_parquet(path: Path, library: Library) -> Any:
    """Read all columns and convert them to the types that the other formats give."""
    arrow, parquet = load_parquet()
    try:
        if (parquet.read_schema(path).metadata or {}).get(b"curate.format") != FORMAT.encode():
            raise DataError(f"{path}: this Parquet file is not an export of curate")
        table = parquet.read_table(path)
        types = [(field.name, _plain(arrow, field.type)) for field in table.schema]
        table = table.cast(arrow.schema(types))
    except (arrow.ArrowException, OSError) as error:
        raise DataError(f"{path}: cannot be read: {one_line(error)}; export it again") from None
    if library == "polars":
        import polars as pl

        return pl.from_arrow(table)
    import pandas as pd

    nullable = {arrow.int64(): pd.Int64Dtype(), arrow.string(): pd.StringDtype()}
    return table.to_pandas(types_mapper=nullable.get)


def _plain(arrow: Any, kind: Any) -> Any:
    """Return the Arrow type that all formats use: int64, float64 or string."""
    if arrow.types.is_integer(kind):
        return arrow.int64()
    return arrow.float64() if arrow.types.is_floating(kind) else arrow.string()


def _as_data_frame(library: Library, kinds: Kinds, rows: Iterator[Row]) -> Any:
    """Build the table block by block, to have only one block as Python objects in memory."""
    blocks = _blocks(rows)
    if library == "polars":
        import polars as pl

        schema = {name: _polars_types()[kind] for name, kind in kinds.items()}
        return pl.concat([pl.DataFrame(block, schema=schema, orient="row") for block in blocks])
    import pandas as pd

    made = []
    for block in blocks:
        columns = zip(*block, strict=True) if block else [()] * len(kinds)
        made.append(
            pd.DataFrame(
                {
                    name: pd.Series(values, dtype=_PANDAS[kind])
                    for (name, kind), values in zip(kinds.items(), columns, strict=True)
                }
            )
        )
    return pd.concat(made, ignore_index=True)


def _polars_types() -> Mapping[Kind, Any]:
    import polars as pl

    return {int: pl.Int64, float: pl.Float64, str: pl.String}


def _blocks(rows: Iterator[Row]) -> Iterator[list[Row]]:
    """Yield the rows in blocks; a single empty block if there are no rows."""
    blocks = batched(rows, BLOCK_ROWS)
    yield next(blocks, [])
    yield from blocks
