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


@pytest.mark.parametrize("count", [0, 1, 4, 49, 50, 51, 100, 149])
def test_rows_and_columns_are_stored_alike(database: Database, count: int) -> None:
    """To the last bit, however many rows a statement takes; null stays null."""
    keys = range(1000, 1000 + count)
    rows = [(1, 1, k, "Car", k / 7777, *[k / 3] * 7, None) for k in keys]
    weights = [(1, 1, k, "spsl", k / 3 if k % 2 else None, k / 7777, k / 9999) for k in keys]
    with database.writing() as connection:
        bulk.insert(connection, "prediction", rows)
        columns = [[row[i] for row in weights] for i in range(7)]
        values = dict(zip(bulk.columns("weight"), columns, strict=True))
        bulk.insert_columns(connection, "weight", values | {"round": 1, "policy": "spsl"})
        table = bulk.table("prediction")
        found = bulk.select(connection, select(table).where(table.c.k >= 1000).order_by(table.c.k))
        assert found == rows
        table = bulk.table("weight")
        assert bulk.select(connection, select(table).order_by(table.c.k)) == weights


@pytest.mark.parametrize("block", [1, 5, COUNT, 50_000])
def test_columns_come_out_whole_and_in_order(
    database: Database, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    """To the last bit, the first and the last row among them; null is NaN."""
    monkeypatch.setattr(bulk, "FETCHED_ROWS", block)
    monkeypatch.setattr(bulk, "BLOCK_ROWS", block)
    table = bulk.table("prediction").c

    def ordered(column):
        return select(column).order_by(table.k)

    with database.reading() as connection:
        keys = bulk.integers(connection, ordered(table.k))
        scores = bulk.numbers(connection, ordered(table.score))
        ious = bulk.numbers(connection, ordered(table.iou))
        names = [
            row[0] for part in bulk.blocks(connection, ordered(table.category)) for row in part
        ]
    assert keys.tolist() == list(range(COUNT))
    assert scores.tolist() == [k / 7 for k in range(COUNT)]
    assert np.array_equal(ious, [k / 9 if k % 2 else np.nan for k in range(COUNT)], equal_nan=True)
    assert names == [f"é{k}\t\\N\n" for k in range(COUNT)]
