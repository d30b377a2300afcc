"""Weighted labels as one Parquet file: a row per label with its evidence, its weight, and units.

Source: the Apache Parquet format (parquet.apache.org). The columns are those of `weighted_labels`,
typed; what is unknown is null. The metadata of each field says its unit and meaning, that of the
file (keys `curate.*`) the frame of reference, round, policy, data set, categories and version.
Rows are streamed in row groups, so that millions of labels need no more memory than one group.
"""

import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, ClassVar

from curate.errors import ConfigError, DataError, one_line
from curate.exporters.base import LabelFileDescription, LabelSet, Row, bad_weight, refuse_link
from curate.exporters.columns import WEIGHTED_LABELS
from curate.files.batches import batched
from curate.files.parquet import load_parquet

FORMAT = "curate weighted labels, Parquet"
FORMAT_VERSION = "1"
FRAME_OF_REFERENCE = "LiDAR: x forward, y left, z up; x, y, z is the centre of the box"
ROWS_PER_GROUP = 65_536


class ParquetExporter:
    """An `Exporter` that writes the weighted labels of X_u as Parquet; ground truth is not in it.

    Args:
        rows_per_group: of a row group.

    Raises:
        ConfigError: pyarrow is not installed.
    """

    name: ClassVar[str] = "parquet"
    suffix: ClassVar[str] = ".parquet"

    def __init__(self, rows_per_group: int = ROWS_PER_GROUP) -> None:
        load_parquet()
        self.rows_per_group = rows_per_group

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`."""
        _refuse_foreign(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
        try:
            count = self._write(partial, labels)
            with partial.open("rb") as written:
                os.fsync(written.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
        return count

    def _write(self, path: Path, labels: LabelSet) -> int:
        arrow, parquet = load_parquet()
        schema = label_schema(labels.description)
        count = 0
        with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
            for rows in _groups(labels.labels, self.rows_per_group):
                writer.write_batch(_batch(arrow, schema, rows), row_group_size=len(rows))
                count += len(rows)
        return count


def label_schema(about: LabelFileDescription) -> Any:
    """The Arrow schema of a label file, with what the labels are about as its metadata."""
    arrow, _ = load_parquet()
    types = {
        "int32": arrow.int32(),
        "int64": arrow.int64(),
        "float64": arrow.float64(),
        "name": arrow.dictionary(arrow.int32(), arrow.string()),
    }
    fields = []
    for name, column in WEIGHTED_LABELS.items():
        told = {"meaning": column.meaning} | ({"unit": column.unit} if column.unit else {})
        fields.append(arrow.field(name, types[column.kind], column.optional, told))
    return arrow.schema(fields, _metadata(about))


def _metadata(about: LabelFileDescription) -> dict[str, str]:
    """What the file says of all its rows."""
    told = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "frame_of_reference": FRAME_OF_REFERENCE,
        "units": "metres, radians",
        "dataset": about.dataset,
        "root": str(about.root),
        "categories": json.dumps(list(about.categories)),
        "round": str(about.round),
        "policy": about.policy,
        "version": about.code_version,
    }
    return {f"curate.{key}": value for key, value in told.items()}


def _groups(rows: Iterable[Row], size: int) -> Iterator[list[Row]]:
    """The rows in groups, each checked; DataError at a weight that cannot be."""
    for group in batched(rows, size):
        for row in group:
            if not 0 <= row[-1] <= 1:
                raise bad_weight(row[1], row[2], row[-1])
        yield group


def _batch(arrow: Any, schema: Any, rows: list[Row]) -> Any:
    """A record batch of the rows."""
    columns = []
    for field, values in zip(schema, zip(*rows, strict=True), strict=True):
        if not field.nullable and None in values:
            row = rows[values.index(None)]
            raise DataError(f"frame {row[1]}: label {row[2]} has no {field.name}")
        try:
            columns.append(arrow.array(values, field.type))
        except (arrow.ArrowException, OverflowError) as error:
            raise DataError(
                f"column {field.name}: not all of it is {field.type}: {one_line(error)}"
            ) from None
    return arrow.record_batch(columns, schema)


def _refuse_foreign(path: Path) -> None:
    """ConfigError where something would be lost that is no former export."""
    refuse_link(path)
    if not path.exists():
        return
    arrow, parquet = load_parquet()
    try:
        former = parquet.read_schema(path).metadata or {}
    except (arrow.ArrowException, OSError):
        former = {}
    if former.get(b"curate.format") != FORMAT.encode():
        raise ConfigError(f"{path}: is there and is no former export; name another file")
