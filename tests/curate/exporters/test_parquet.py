"""Weighted labels as Parquet."""

import json
from dataclasses import replace

import pytest
from support.exported import block, rows_of, toy_labels, with_rows

from curate.errors import ConfigError, DataError
from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from curate.exporters.parquet import ParquetExporter

parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")


def test_every_column_is_read_back_to_the_last_bit(tmp_path):
    """In the order of the view; unknown values are null."""
    labels = toy_labels()
    assert ParquetExporter().write(tmp_path / "a.parquet", labels) == 3
    table = parquet.read_table(tmp_path / "a.parquet")
    assert tuple(table.column_names) == WEIGHTED_LABEL_COLUMNS
    assert table.to_pylist() == rows_of(labels)


def test_columns_have_types_units_and_meanings(tmp_path):
    """Readers of the file see them."""
    ParquetExporter().write(tmp_path / "a.parquet", toy_labels())
    schema = parquet.read_schema(tmp_path / "a.parquet")
    types = {field.name: str(field.type) for field in schema}
    assert {types[name] for name in ("x", "yaw", "score", "loss", "weight")} == {"double"}
    assert {types[name] for name in ("round", "k", "points")} == {"int32"}
    assert "string" in types["frame"]
    assert schema.field("x").metadata[b"unit"] == b"m"
    assert schema.field("yaw").metadata[b"unit"] == b"rad"
    assert all(field.metadata[b"meaning"] for field in schema)
    assert [field.name for field in schema if field.nullable] == [
        "loss", "points", "points_threshold", "rho_diff", "mask_pixels", "box_pixels", "rho_anno",
        "rho_det", "lambda_u",
    ]  # fmt: skip


def test_the_file_describes_itself(tmp_path):
    """Frame of reference, units, round, policy, version."""
    ParquetExporter().write(tmp_path / "a.parquet", toy_labels())
    metadata = parquet.read_schema(tmp_path / "a.parquet").metadata
    described = {
        key.decode().removeprefix("curate."): value.decode() for key, value in metadata.items()
    }
    assert described["frame_of_reference"].startswith("LiDAR: x forward, y left, z up")
    assert described["units"] == "metres, radians"
    assert (described["round"], described["policy"], described["version"]) == ("1", "pspsl", "1")
    assert (described["dataset"], described["root"]) == ("kitti", "/data")
    assert described["zero_weight"] == "ignore"
    assert json.loads(described["categories"]) == ["Car", "Pedestrian", "Cyclist"]


def test_rows_are_streamed_in_groups(tmp_path):
    """Without holding all of them in memory."""
    labels = toy_labels()

    class Streamed:
        """Blocks of one row that cannot be indexed."""

        def __iter__(self):
            for row in rows_of(labels):
                yield block([row])

    streamed = replace(labels, labels=Streamed())
    assert ParquetExporter(rows_per_group=2).write(tmp_path / "a.parquet", streamed) == 3
    found = parquet.ParquetFile(tmp_path / "a.parquet").metadata
    assert [found.row_group(i).num_rows for i in range(found.num_row_groups)] == [2, 1]


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("score", None, "frame 000001: label 2 has no score"),
        ("k", 2**40, "column k: not all values are of type int32"),
        ("points", "many", "column points: not all values are of type int32"),
    ],
)
def test_an_invalid_value_is_reported(tmp_path, column, value, message):
    """In one line, and no file is left."""
    labels = toy_labels()
    rows = rows_of(labels)
    changed = with_rows(labels, [*rows[:-1], rows[-1] | {column: value}])
    with pytest.raises(DataError, match=message) as caught:
        ParquetExporter().write(tmp_path / "a.parquet", changed)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_without_pyarrow_the_extra_is_reported(monkeypatch):
    """With a command that can be pasted."""
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(ConfigError, match=r"pip install 'curate-pseudo-labels\[parquet\]'"):
        ParquetExporter()
