"""Tests of what no exporter is given."""

from dataclasses import replace

import pytest
from support.exported import toy_labels

from curate.errors import DataError


@pytest.mark.parametrize("weight", ["abc", b"\x00\xff", None])
def test_weights_that_are_no_numbers_are_refused(weight):
    """SQLite keeps what another program writes into a column of numbers."""
    labels = toy_labels()
    rows = [*labels.labels[:2], (*labels.labels[2][:-1], weight)]
    with pytest.raises(DataError, match="weights of 000001 are no numbers"):
        replace(labels, labels=rows)
