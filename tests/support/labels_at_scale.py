"""A workspace with any number of labels, all with evidence, without frame files."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from sqlalchemy import text
from sqlalchemy.schema import CreateIndex, DropIndex

from db import bulk
from pipelines.workspace.config import make_config
from pipelines.workspace.workspace import Workspace
from support.stored_tuples import COLUMNS, store

EACH = 50  # labels per frame
BATCH_FRAMES = 2000
DRAWN_FRAMES = 20_000  # the others are copies of them, with slightly different numbers
CATEGORIES = ("Car", "Pedestrian", "Cyclist")
SHARES = (0.7, 0.2, 0.1)


def filled_workspace(root: Path, frames: int, database: str | None = None) -> Workspace:
    """Return a new workspace with `EACH` labels per frame in its first round."""
    run = {"database": database} if database else {}
    document = {"dataset": {"root": root}, "run": run}
    workspace = Workspace.create(root, make_config(document, "test"))
    with workspace.database.writing() as connection:
        store(connection, "frame", _frames(frames))
        store(connection, "round", [(1, 3, None, "{}", "0", 0)])
    # An index by value would cost a seek for each of the millions of inserted rows.
    indices = sorted(bulk.table("prediction").indexes, key=lambda index: str(index.name))
    with workspace.database.writing() as connection:
        for index in indices:
            connection.execute(DropIndex(index))
    generator = np.random.default_rng(0)
    drawn = min(frames, DRAWN_FRAMES)
    for first in range(1, drawn + 1, BATCH_FRAMES):
        keys = _keys(first, min(first + BATCH_FRAMES, drawn + 1))
        with workspace.database.writing() as connection:
            for table, rows in _evidence(generator, keys):
                store(connection, table, rows)
    for first in range(drawn, frames, drawn):
        with workspace.database.writing() as connection:
            for statement in _copies(first, min(drawn, frames - first)):
                connection.execute(text(statement))
    with workspace.database.writing() as connection:
        for index in indices:
            connection.execute(CreateIndex(index))
    return workspace


def _frames(count: int) -> Iterator[bulk.Row]:
    for i in range(count):
        yield ("kitti", f"{i:06d}", "unlabeled", f"{i}.bin", f"{i}.png", f"{i}.txt", None)


def _keys(first: int, end: int) -> list[bulk.Row]:
    return [(1, frame, k) for frame in range(first, end) for k in range(EACH)]


def _evidence(
    generator: np.random.Generator, keys: list[bulk.Row]
) -> Iterator[tuple[str, list[bulk.Row]]]:
    """Return the tables and their rows; every tenth label has no match."""
    count = len(keys)
    boxes = generator.normal(0, 10, (7, count)).tolist()
    categories = generator.choice(CATEGORIES, count, p=SHARES).tolist()
    scores, *rho = generator.random((3, count)).tolist()
    losses = generator.exponential(1, count)
    unmatched = generator.random(count) < 0.1
    matched = np.where(unmatched, None, losses).tolist()
    counts = (~unmatched).astype(int).tolist()
    yield "prediction", _joined(keys, categories, scores, *boxes, [None] * count)
    yield "consistency", _joined(keys, matched, [1] * count, counts)
    yield "point_prior", _joined(keys, [5] * count, [10.0] * count, rho[0])
    yield "semantic_prior", _joined(keys, [5] * count, [10] * count, rho[1])


def _copies(first: int, count: int) -> Iterator[str]:
    """Return statements that copy the first frames; all weights stay distinct."""
    shrunk = {name: f"{name} * {1 - 1e-9 * first!r}" for name in ("loss", "rho_diff", "score")}
    for name in ("prediction", "consistency", "point_prior", "semantic_prior"):
        chosen = {column: column for column in COLUMNS[name]}
        chosen |= {column: shrunk[column] for column in shrunk if column in chosen}
        chosen["frame_id"] = f"frame_id + {first}"
        yield (
            f"INSERT INTO {name} ({', '.join(chosen)}) SELECT {', '.join(chosen.values())} "
            f"FROM {name} WHERE round = 1 AND frame_id <= {count} ORDER BY frame_id, k"
        )


def _joined(keys: list[bulk.Row], *columns: list) -> list[bulk.Row]:
    return [(*key, *row) for key, row in zip(keys, zip(*columns, strict=True), strict=True)]
