"""What is known of the labels of a round, read from the database in columns.

Every table of evidence is scanned in the order of its key, and one column at a time: a join of them
costs a seek per label and table, and rows of many columns cost an object per value at once.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import BigInteger, ColumnElement, Connection, Select, and_, case, cast, func, select

from curate.detections import as_categories, empty_boxes
from curate.errors import WorkspaceError
from curate.weighting.base import Evidence, Memory
from db import bulk
from db.columns import Columns, reading_columns
from db.models import BOX_COLUMNS
from pipelines.labels.sources import prepare_table, rho_columns, sources_of
from pipelines.workspace.workspace import Workspace

_K_BITS = 32
# Compiling the loop that reads them takes a second, as long as the driver takes for so many.
MANY_FRAMES = 10_000


@dataclass(frozen=True)
class LabelKeys:
    """The keys and categories of the n labels of some frames, by frame and k.

    Attributes:
        frame_id: (n,) int64.
        k: (n,) int64.
        category: (n,) int64 place in `category_names`.
        category_names: those that occur.
    """

    frame_id: np.ndarray
    k: np.ndarray
    category: np.ndarray
    category_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.k)


def read_evidence(
    workspace: Workspace,
    round_number: int,
    frames: Sequence[int],
    *,
    boxes: bool = False,
    columns: Collection[str] | None = None,
) -> tuple[LabelKeys, Evidence]:
    """The evidence of all labels of some frames, and their keys.

    Args:
        workspace: see `Workspace`.
        round_number: e.
        frames: keys of the frames.
        boxes: whether to read the boxes, which few policies look at.
        columns: of "category", "score", "iou" and "loss", those to read; None for all. The others
            are NaN, or "" for the category.
    """
    wanted = {"category", "score", "iou", "loss"} if columns is None else set(columns)
    for source in sources_of(workspace.config.run.priors):
        prepare_table(workspace, source)
    rho = rho_columns(workspace.config.run.priors)
    database, many = workspace.database, len(frames) >= MANY_FRAMES
    with (
        database.reading() as connection,
        reading_columns(database, connection, many=many) as asked,
    ):
        scan = _Scan(connection, asked, round_number, frames)
        keys = scan.keys()
        names = as_categories(keys.category_names) if "category" in wanted else None
        return keys, Evidence(
            frame_index=keys.frame_id,
            category=scan.blank("") if names is None else names[keys.category],
            score=scan.numbers("prediction", "score") if "score" in wanted else scan.blank(),
            loss=scan.numbers("consistency", "loss") if "loss" in wanted else scan.blank(),
            rho={column: scan.numbers(table, column) for column, table in rho.items()},
            iou=scan.numbers("prediction", "iou") if "iou" in wanted else scan.blank(),
            boxes=scan.boxes() if boxes else empty_boxes(),
        )


class _Scan:
    """Reads columns of a round, aligned with the predictions of some frames."""

    def __init__(
        self,
        connection: Connection,
        asked: Columns,
        round_number: int,
        frames: Sequence[int],
    ) -> None:
        self._connection = connection
        self._asked = asked
        self._round = round_number
        self._all, self._category, self._category_names = self._read_predictions()
        wanted = np.isin(self._all >> _K_BITS, np.asarray(frames, dtype=np.int64))
        self._wanted = slice(None) if wanted.all() else np.flatnonzero(wanted)

    def keys(self) -> LabelKeys:
        """Keys and categories."""
        own = self._all[self._wanted]
        category = self._category[self._wanted]
        return LabelKeys(own >> _K_BITS, own & ((1 << _K_BITS) - 1), category, self._category_names)

    def numbers(self, table: str, column: str) -> np.ndarray:
        """(n,) float64; NaN for null, and where the table has no row of a label."""
        found = self._asked.numbers(_ordered(self._round, table, bulk.table(table).c[column]))
        if len(found) != len(self._all):
            # Every row belongs to a prediction, so only their number can differ.
            spread = np.full(len(self._all), np.nan)
            spread[np.searchsorted(self._all, self._read_keys(table))] = found
            found = spread
        return found[self._wanted]

    def boxes(self) -> np.ndarray:
        """(n, 7) in the LiDAR frame."""
        return np.stack([self.numbers("prediction", name) for name in BOX_COLUMNS], axis=1)

    def blank(self, value: float | str = np.nan) -> np.ndarray:
        """(n,) the value in place of a column that nobody asks for; it takes no memory."""
        return np.broadcast_to(np.array(value), self._all[self._wanted].shape)

    def _read_predictions(self) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
        """(n,) int64 keys as of `_read_keys`, (n,) int64 number of each category, their names.

        The database makes one number of all three, of which one object per label comes.
        """
        columns = bulk.table("prediction").c
        names = sorted(_category_names(self._connection, self._round))
        if not names:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), ()
        bits = len(names).bit_length()
        number = case({name: i for i, name in enumerate(names)}, value=columns.category)
        frame = cast(columns.frame_id, BigInteger) * (1 << _K_BITS)
        place = cast(columns.k, BigInteger) * (1 << bits)
        found = self._asked.integers(_ordered(self._round, "prediction", frame + place + number))
        frame_bits = found & -(1 << _K_BITS)
        keys = frame_bits + ((found - frame_bits) >> bits)
        return keys, found & ((1 << bits) - 1), tuple(names)

    def _read_keys(self, table: str) -> np.ndarray:
        """(n,) int64 frame and k of each row in one ascending number."""
        columns = bulk.table(table).c
        key = cast(columns.frame_id, BigInteger) * (1 << _K_BITS) + columns.k
        return self._asked.integers(_ordered(self._round, table, key))


def _category_names(connection: Connection, round_number: int) -> Iterator[str]:
    """Those of a round's predictions, each found by a seek in their index."""
    columns = bulk.table("prediction").c
    least = select(func.min(columns.category)).where(columns.round == round_number)
    name = connection.execute(least).scalar_one()
    while name is not None:
        yield name
        name = connection.execute(least.where(columns.category > name)).scalar_one()


def _ordered(round_number: int, table: str, chosen: ColumnElement[Any]) -> Select[Any]:
    """A column of a round, by frame and k."""
    columns = bulk.table(table).c
    query = select(chosen).where(columns.round == round_number)
    return query.order_by(columns.frame_id, columns.k)


def read_memory(workspace: Workspace, round_number: int, policy: str) -> Memory:
    """The labels of a round that a policy has weighed and not dropped.

    Raises:
        WorkspaceError: the policy has not weighed that round.
    """
    weight, prediction = bulk.table("weight"), bulk.table("prediction")
    same = and_(*(weight.c[key] == prediction.c[key] for key in ("round", "frame_id", "k")))
    columns = [
        prediction.c[name] for name in ("frame_id", "category", "score", "iou", *BOX_COLUMNS)
    ]
    query = (
        select(*columns, weight.c.v)
        .select_from(weight.join(prediction, same))
        .where(weight.c.round == round_number, weight.c.policy == policy)
        .order_by(prediction.c.frame_id, prediction.c.k)
    )
    if solved_fingerprint(workspace, round_number, policy) is None:
        raise WorkspaceError(
            f"policy {policy} remembers round {round_number}, which it has not weighed; "
            f"run `curate solve --policy {policy} --round {round_number}`"
        )
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, query)
    frame_index, category, *numbers = zip(*rows, strict=True) if rows else [()] * (5 + 7)
    score, iou, *boxes, v = (np.array(column, dtype=np.float64) for column in numbers)
    return Memory(
        frame_index=np.array(frame_index, dtype=np.int64),
        category=as_categories(category),
        score=score,
        iou=iou,
        boxes=np.stack(boxes, axis=1),
        v=v,
    )


def solved_fingerprint(workspace: Workspace, round_number: int, policy: str) -> str | None:
    """What the stored weights of a round and policy were made from; None where there are none."""
    task = bulk.table("task")
    mine = {"round": round_number, "stage": "solve", "variant": policy}
    query = select(task.c.fingerprint).where(*(task.c[name] == at for name, at in mine.items()))
    with workspace.database.reading() as connection:
        found = bulk.select(connection, query)
    return found[0][0] if found else None
