"""What is known of the labels of a round, read from the database in columns."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import FromClause, Select, and_, select

from curate.detections import Columns, empty_boxes
from curate.errors import WorkspaceError
from curate.weighting.base import Evidence, Memory
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.labels.sources import prepare_table, rho_columns, sources_of
from pipelines.workspace.workspace import Workspace


@dataclass(frozen=True)
class LabelKeys(Columns):
    """The keys and categories of the n labels of some frames, by frame and k.

    Attributes:
        frame_id: (n,) int64.
        k: (n,) int64.
        category: (n,) str.
    """

    frame_id: np.ndarray
    k: np.ndarray
    category: np.ndarray


def read_evidence(
    workspace: Workspace,
    round_number: int,
    frames: Sequence[int],
    *,
    boxes: bool = False,
    columns: Collection[str] | None = None,
) -> tuple[LabelKeys, Evidence]:
    """Return the evidence of all labels of some frames, and their keys.

    Args:
        workspace: see `Workspace`.
        round_number: e.
        frames: keys of the frames.
        boxes: whether to read the boxes, which few policies look at.
        columns: of "category", "score", "iou" and "loss", those that the evidence holds; None for
            all. The others are NaN and not read. The category is read in any case, for the keys
            hold it and solve counts labels by it: to count in SQL takes nearly twice as long as
            to read it. The evidence has "" in its place.
    """
    wanted = {"category", "score", "iou", "loss"} if columns is None else set(columns)
    for source in sources_of(workspace.config.run.priors):
        prepare_table(workspace, source)
    rho = rho_columns(workspace.config.run.priors)
    measured = {"score": "prediction", "iou": "prediction", "loss": "consistency"}
    tables = {name: table for name, table in measured.items() if name in wanted} | rho
    if boxes:
        tables |= dict.fromkeys(BOX_COLUMNS, "prediction")
    with workspace.database.reading() as connection:
        found = bulk.select_columns(connection, _aligned(round_number, tables))
    inside = np.isin(found["frame_id"], np.asarray(frames, dtype=np.int64))
    if not inside.all():
        found = {name: column[inside] for name, column in found.items()}
    keys = LabelKeys(found["frame_id"], found["k"], found["category"])
    missing = np.broadcast_to(np.nan, len(keys))
    return keys, Evidence(
        frame_index=keys.frame_id,
        category=keys.category if "category" in wanted else np.broadcast_to("", len(keys)),
        score=found.get("score", missing),
        loss=found.get("loss", missing),
        rho={column: found[column] for column in rho},
        iou=found.get("iou", missing),
        boxes=np.stack([found[name] for name in BOX_COLUMNS], axis=1) if boxes else empty_boxes(),
    )


def _aligned(round_number: int, tables: Mapping[str, str]) -> Select[Any]:
    """Return the predictions of a round by frame and k, each with columns of several tables.

    Args:
        round_number: e.
        tables: the table of each column; null where it has no row of a label.
    """
    label = bulk.table("prediction")
    joined: FromClause = label
    for name in dict.fromkeys(tables.values()):
        table = bulk.table(name)
        if table is not label:
            same = and_(*(table.c[key] == label.c[key] for key in ("round", "frame_id", "k")))
            joined = joined.outerjoin(table, same)
    columns = [bulk.table(table).c[name] for name, table in tables.items()]
    return (
        select(label.c.frame_id, label.c.k, label.c.category, *columns)
        .select_from(joined)
        .where(label.c.round == round_number)
        .order_by(label.c.frame_id, label.c.k)
    )


def read_memory(workspace: Workspace, round_number: int, policy: str) -> Memory:
    """Return the labels of a round that a policy has weighed and not dropped.

    Raises:
        WorkspaceError: if the policy has not weighed that round.
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
        found = bulk.select_columns(connection, query)
    boxes = np.stack([found.pop(name) for name in BOX_COLUMNS], axis=1)
    return Memory(frame_index=found.pop("frame_id"), boxes=boxes, **found)


def solved_fingerprint(workspace: Workspace, round_number: int, policy: str) -> str | None:
    """What the stored weights of a round and policy were made from; None where there are none."""
    task = bulk.table("task")
    mine = {"round": round_number, "stage": "solve", "variant": policy}
    query = select(task.c.fingerprint).where(*(task.c[name] == at for name, at in mine.items()))
    found = workspace.database.rows(query)
    return found[0][0] if found else None
