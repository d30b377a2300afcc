"""Export weighted labels as one Parquet file: one row per label with its evidence and weight.

Source: the Apache Parquet format (parquet.apache.org). The columns are those of `weighted_labels`,
with their types; unknown values are null. The metadata of each field contains its unit and meaning.
The metadata of the file (keys `curate.*`) contains the frame of reference, the round, the policy,
the meaning of weight 0 (`curate.zero_weight`), the data set, the categories and the version. Rows
are written in row groups, and only one group is in memory at a time.
"""

import json
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

from curate.errors import DataError, one_line
from curate.exporters.base import LabelFileDescription, LabelRows, LabelSet
from curate.exporters.columns import WEIGHTED_LABELS
from curate.exporters.place import check_place
from curate.files.atomic import atomic_path
from curate.files.batches import batched
from curate.files.parquet import load_parquet
from curate.priors.base import Column
from curate.ranges import AtLeastOne

FORMAT = "curate weighted labels, Parquet"
FORMAT_VERSION = "1"
FRAME_OF_REFERENCE = "LiDAR: x forward, y left, z up; x, y, z is the centre of the box"
ROWS_PER_GROUP = 65_536


class ParquetExporter:
    """An `Exporter` that writes the weighted labels of X_u as Parquet, without ground truth.

    Args:
        rows_per_group: size of a row group.

    Raises:
        ConfigError: if pyarrow is not installed.
    """

    name: ClassVar[str] = "parquet"
    suffix: ClassVar[str] = ".parquet"

    def __init__(self, rows_per_group: AtLeastOne = ROWS_PER_GROUP) -> None:
        load_parquet()
        self.rows_per_group = rows_per_group

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`."""
        check_place(path, _is_export)
        arrow, parquet = load_parquet()
        schema = label_schema(labels.description, labels.columns)
        count = 0
        with (
            atomic_path(path) as partial,
            parquet.ParquetWriter(partial, schema, compression="zstd") as writer,
        ):
            for rows in _groups(labels.blocks(), self.rows_per_group):
                batch = _batch(arrow, schema, LabelRows(labels.column_names, rows))
                writer.write_batch(batch, row_group_size=batch.num_rows)
                count += batch.num_rows
        return count


def label_schema(about: LabelFileDescription, columns: Iterable[Column] = WEIGHTED_LABELS) -> Any:
    """Return the Arrow schema of a label file, with the description of the labels as metadata."""
    arrow, _ = load_parquet()
    types = {
        "int32": arrow.int32(),
        "int64": arrow.int64(),
        "float64": arrow.float64(),
        "name": arrow.dictionary(arrow.int32(), arrow.string()),
    }
    fields = []
    for column in columns:
        metadata = {"meaning": column.meaning} | ({"unit": column.unit} if column.unit else {})
        fields.append(arrow.field(column.name, types[column.kind], column.optional, metadata))
    return arrow.schema(fields, _metadata(about))


def _metadata(about: LabelFileDescription) -> dict[str, str]:
    """Return the metadata of the file."""
    metadata = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "frame_of_reference": FRAME_OF_REFERENCE,
        "units": "metres, radians",
        "dataset": about.dataset,
        "root": str(about.root),
        "categories": json.dumps(list(about.categories)),
        "round": str(about.round),
        "policy": about.policy,
        "zero_weight": about.zero_weight,
        "version": about.code_version,
    }
    return {f"curate.{key}": value for key, value in metadata.items()}


def _groups(blocks: Iterable[LabelRows], size: int) -> Iterator[list[tuple[Any, ...]]]:
    """Yield the same rows in groups of `size` rows; the last group may be smaller."""
    return batched(chain.from_iterable(block.rows for block in blocks), size)


def _batch(arrow: Any, schema: Any, rows: LabelRows) -> Any:
    """Return a record batch of the rows."""
    columns = []
    for field in schema:
        values = rows[field.name]
        if not field.nullable and None in values:
            row = values.index(None)
            raise DataError(
                f"frame {rows['frame'][row]}: label {rows['k'][row]} has no {field.name}"
            )
        try:
            columns.append(arrow.array(values, field.type))
        except (arrow.ArrowException, OverflowError) as error:
            raise DataError(
                f"column {field.name}: not all values are of type {field.type}: {one_line(error)}"
            ) from None
    return arrow.record_batch(columns, schema)


def _is_export(path: Path) -> bool:
    arrow, parquet = load_parquet()
    try:
        metadata = parquet.read_schema(path).metadata or {}
    except arrow.ArrowException:
        return False
    return bool(metadata.get(b"curate.format") == FORMAT.encode())
