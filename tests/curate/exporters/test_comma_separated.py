"""Weighted labels as CSV."""

import csv

from support.exported import rows_of, toy_labels

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
