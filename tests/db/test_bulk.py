"""The bulk paths: every row goes in and comes out, whatever the size of a block."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select

from db import bulk
from db.session import Database

ENGINES = ("sqlite", "postgresql")
COUNT = 23


@pytest.fixture
def database(tmp_path: Path, new_url: Callable[[], str | None]) -> Database:
    """A database with a few predictions."""
    database = Database(new_url() or f"sqlite:///{tmp_path / 'curate.db'}")
    with database.writing() as connection:
        bulk.insert(connection, "frame", [("kitti", "x", "unlabeled", "p", "i", "c", None)])
        bulk.insert(connection, "round", [(1, 1, None, "{}", "0", 0)])
        rows = [
            (1, 1, k, f"é{k}\t\\N\n", k / 7, *[k / 3] * 7, k / 9 if k % 2 else None)
            for k in range(COUNT)
        ]
        bulk.insert(connection, "prediction", rows)
    return database


@pytest.mark.parametrize("block", [1, 5, COUNT, 50_000])
def test_columns_come_out_whole_and_in_order(
    database: Database, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    """To the last bit, the first and the last row among them; null is NaN."""
    monkeypatch.setattr(bulk, "BLOCK_ROWS", block)
    table = bulk.table("prediction").c

    def ordered(column):
        return select(column).order_by(table.k)

    with database.reading() as connection:
        keys = bulk.integers(connection, ordered(table.k))
        scores = bulk.numbers(connection, ordered(table.score))
        ious = bulk.numbers(connection, ordered(table.iou))
        names = [name for part in bulk.stream(connection, ordered(table.category)) for name in part]
    assert keys.tolist() == list(range(COUNT))
    assert scores.tolist() == [k / 7 for k in range(COUNT)]
    assert np.array_equal(ious, [k / 9 if k % 2 else np.nan for k in range(COUNT)], equal_nan=True)
    assert names == [f"é{k}\t\\N\n" for k in range(COUNT)]
