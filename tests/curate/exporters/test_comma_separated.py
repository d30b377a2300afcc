"""Weighted labels as CSV."""

import csv
import io

import pytest
from support.exported import rows_of, toy_labels, with_rows

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from curate.exporters.comma_separated import CsvExporter


def test_every_column_is_read_back_to_the_last_bit(tmp_path):
    """In the order of the view; unknown values are empty."""
    labels = toy_labels()
    CsvExporter().write(tmp_path / "labels.csv", labels)
    with (tmp_path / "labels.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == WEIGHTED_LABEL_COLUMNS
    expected = rows_of(labels)
    assert len(rows) == len(expected)
    for row, own in zip(rows, expected, strict=True):
        for name, field in zip(header, row, strict=True):
            value = own[name]
            assert field == "" if value is None else type(value)(field) == value


@pytest.mark.parametrize(
    "name", ["a,b", 'a"b', "null", "a b", "nullius", "[1],[2]", "é", "a\\b", " x ", "000001"]
)
def test_names_and_numbers_are_those_that_the_module_csv_writes(tmp_path, name):
    """Most rows are written by another, faster writer; a reader finds no difference."""
    numbers = {"x": 1e16, "y": -1e-7, "z": 0.1 + 0.2, "length": 5.0, "score": 1e-5, "loss": None}
    labels = toy_labels()
    rows = [row | numbers | {"category": name} for row in rows_of(labels)]
    path = tmp_path / "labels.csv"
    CsvExporter().write(path, with_rows(labels, rows))
    written = io.StringIO(newline="")
    csv.writer(written).writerows(row.values() for row in rows)
    expected = list(csv.reader(io.StringIO(written.getvalue())))
    with path.open(newline="", encoding="utf-8") as file:
        _, *found = csv.reader(file)
    texts = {WEIGHTED_LABEL_COLUMNS.index(n) for n in ("frame", "category", "provenance", "policy")}
    for one, other in zip(found, expected, strict=True):
        for place, (mine, theirs) in enumerate(zip(one, other, strict=True)):
            assert mine == theirs or (place not in texts and float(mine) == float(theirs))
