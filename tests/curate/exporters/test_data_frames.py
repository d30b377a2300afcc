"""Exported labels as DataFrames of pandas and polars."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.exported import block, label, rows_of, toy_labels, with_rows

import curate.exporters.data_frames
from curate.errors import ConfigError, DataError
from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from curate.exporters.coco import CocoExporter
from curate.exporters.columns import WEIGHTED_LABELS
from curate.exporters.comma_separated import CsvExporter
from curate.exporters.data_frames import read_labels
from curate.exporters.parquet import ParquetExporter
from curate.exporters.sqlite import SqliteExporter
from curate.priors.base import Column

EXPORTERS = (SqliteExporter, CsvExporter, ParquetExporter)
LIBRARIES = ("pandas", "polars")
FURTHER = (
    Column("hits", "int64", "", "frames of the track", optional=True),
    Column("speed", "float64", "m/s", "of the track"),
    Column("track", "name", "", "of the sequence"),
)


@pytest.fixture(params=EXPORTERS, ids=lambda exporter: exporter.name)
def exporter(request):
    """Return each format that stores all labels with their weights."""
    if request.param is ParquetExporter:
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    return request.param()


@pytest.fixture(params=LIBRARIES)
def library(request):
    """Return each library."""
    pytest.importorskip(request.param, reason=f"{request.param} is not installed")
    return request.param


def as_rows(table):
    """Return the rows of a DataFrame; missing values are None."""
    records = table.to_dicts() if hasattr(table, "to_dicts") else table.to_dict("records")
    return [
        {
            name: None if value is None or value != value else value  # noqa: PLR0124 - NaN
            for name, value in row.items()
        }
        if hasattr(table, "to_dicts")
        else {name: _plain(value) for name, value in row.items()}
        for row in records
    ]


def _plain(value):
    import pandas as pd

    return None if pd.isna(value) else value


def test_every_value_is_read_back(tmp_path, exporter, library):
    """To the last bit, in order, and "000001" is not a number."""
    labels = toy_labels()
    path = tmp_path / f"labels{exporter.suffix}"
    exporter.write(path, labels)
    table = read_labels(str(path), library)
    assert tuple(table.columns) == WEIGHTED_LABEL_COLUMNS
    assert as_rows(table) == rows_of(labels)
    assert table["frame"].to_list() == ["000001"] * 3
    assert math.isclose(table["weight"].sum(), 0.75 + 1 / 3)


def test_types_are_those_of_the_columns(tmp_path, exporter, library):
    """The same for every format, with or without missing values."""
    path = tmp_path / f"labels{exporter.suffix}"
    exporter.write(path, toy_labels())
    table = read_labels(path, library)
    names = {
        "pandas": {"float64": "float64", "name": "string"},
        "polars": {"float64": "Float64", "name": "String"},
    }[library]
    types = dict(zip(table.columns, map(str, table.dtypes), strict=True))
    assert types == {column.name: names.get(column.kind, "Int64") for column in WEIGHTED_LABELS}


def test_an_export_without_labels_has_the_columns(tmp_path, exporter, library):
    """With their types, so that a notebook needs no special case."""
    path = tmp_path / f"labels{exporter.suffix}"
    exporter.write(path, toy_labels())
    types = list(map(str, read_labels(path, library).dtypes))
    exporter.write(path, with_rows(toy_labels(), []))
    table = read_labels(path, library)
    assert len(table) == 0
    assert list(map(str, table.dtypes)) == types


def test_further_evidence_is_read(tmp_path, exporter, library):
    """With its types: text that looks like a number stays text."""
    more = [{"hits": None, "speed": 2.0, "track": "007"}, {"hits": 3, "speed": 0.5, "track": "1"}]
    rows = [label("000001", k) | own for k, own in enumerate(more)]
    columns = (*WEIGHTED_LABELS, *FURTHER)
    names = [column.name for column in columns]
    labels = replace(toy_labels(), columns=columns, labels=[block(rows, names)])
    path = tmp_path / f"labels{exporter.suffix}"
    exporter.write(path, labels)
    assert as_rows(read_labels(path, library)) == rows


def test_many_labels_are_read_in_blocks(tmp_path, exporter, library, monkeypatch):
    """In the order of the file, across blocks."""
    monkeypatch.setattr(curate.exporters.data_frames, "BLOCK_ROWS", 4)
    rows = [label("000001", k, weight=k / 10) for k in range(10)]
    path = tmp_path / f"labels{exporter.suffix}"
    exporter.write(path, with_rows(toy_labels(), rows))
    table = read_labels(path, library)
    assert table["k"].to_list() == list(range(10))
    assert np.allclose(table["weight"].to_numpy(), np.arange(10) / 10)


def test_pandas_is_the_default(tmp_path):
    """If both are installed."""
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    SqliteExporter().write(tmp_path / "labels.sqlite", toy_labels())
    assert isinstance(read_labels(tmp_path / "labels.sqlite"), pandas.DataFrame)


@pytest.mark.parametrize(
    ("as_", "message"),
    [
        ("arrow", "unknown library 'arrow'; use pandas or polars"),
        ("polars", "read_labels needs polars: pip install"),
        (None, "read_labels needs pandas or polars: pip install"),
    ],
)
def test_a_missing_library_is_reported(tmp_path, monkeypatch, as_, message):
    """With what to do."""
    monkeypatch.setattr(curate.exporters.data_frames, "find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=message):
        read_labels(tmp_path / "labels.sqlite", as_)


def test_a_file_without_weighted_labels_is_rejected(tmp_path):
    """A missing file, another format, or a file of another program."""
    with pytest.raises(DataError, match="cannot be read: No such file"):
        read_labels(tmp_path / "labels.sqlite")
    CocoExporter().write(tmp_path / "labels.json", toy_labels())
    with pytest.raises(DataError, match="reads the formats sqlite, csv and parquet"):
        read_labels(tmp_path / "labels.json")
    (tmp_path / "mine.csv").write_text("frame,score\n1,0.5\n")
    with pytest.raises(DataError, match="not exported labels"):
        read_labels(tmp_path / "mine.csv")
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pyarrow.table({"frame": ["1"]}), tmp_path / "mine.parquet")
    with pytest.raises(DataError, match="is not an export of curate"):
        read_labels(tmp_path / "mine.parquet")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"0.75", b"heavy", ":2: could not convert string to float: 'heavy'"),
        (b",pspsl,0.75", b"", ":2: "),
        (b"Car", b"C\xffr", "not UTF-8 text"),
    ],
)
def test_a_damaged_csv_is_reported(tmp_path, old, new, message):
    """With the line if it is known."""
    path = tmp_path / "labels.csv"
    CsvExporter().write(path, toy_labels())
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(DataError, match=message):
        read_labels(path)


def test_a_damaged_parquet_file_is_reported(tmp_path):
    """A truncated file."""
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    path = tmp_path / "labels.parquet"
    ParquetExporter().write(path, toy_labels())
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DataError, match=r"labels\.parquet: cannot be read"):
        read_labels(path)
