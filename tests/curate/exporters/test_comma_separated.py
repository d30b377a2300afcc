"""Weighted labels as CSV."""

import csv

from support.exported import toy_labels

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from curate.exporters.comma_separated import CsvExporter


def test_every_column_comes_back_to_the_last_bit(tmp_path):
    """In the order of the view; what is unknown is empty."""
    labels = toy_labels()
    CsvExporter().write(tmp_path / "labels.csv", labels)
    with (tmp_path / "labels.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == WEIGHTED_LABEL_COLUMNS
    assert len(rows) == len(labels.labels)
    for row, label in zip(rows, labels.labels, strict=True):
        for field, value in zip(row, label, strict=True):
            assert field == "" if value is None else type(value)(field) == value
