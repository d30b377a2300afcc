"""Reading the evidence of a round's labels as aligned columns, for the policies.

`prediction` has one row per label, and each table of evidence has at most one row with the same
key. Left joins of these tables therefore give exactly one row per label, in the order of the key:

    SELECT p.frame_id, p.k, p.category, p.score, c.loss, pp.rho_diff, sp.rho_anno
    FROM prediction AS p
    LEFT JOIN consistency AS c     ON (c.round, c.frame_id, c.k) = (p.round, p.frame_id, p.k)
    LEFT JOIN point_prior AS pp    ON ...the same key
    LEFT JOIN semantic_prior AS sp ON ...the same key
    WHERE p.round = 1 ORDER BY p.frame_id, p.k

    frame_id   k   category     score   loss   rho_diff   rho_anno
    7          0   Car          0.91    0.12   1.0        0.83
    7          1   Pedestrian   0.34    NaN    0.4        0.21      no view matched: no evidence L
    9          0   Car          0.55    0.70   0.9        NaN       frame 9 failed in semantic

Rows of frames that are not complete, such as frame 9, are then dropped. The first three columns
become `LabelKeys`, the others `Evidence`. `solve` computes a weight for each row, and stores it
with the row's keys.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Float, FromClause, Select, and_, select, type_coerce

from curate.detections import Columns, empty_boxes
from curate.errors import WorkspaceError
from curate.weighting.base import Evidence, Memory
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.labels.sources import prepare_table, rho_columns, sources_of
from pipelines.workspace.workspace import Workspace


@dataclass(frozen=True)
class LabelKeys(Columns):
    """The keys and categories of n labels, sorted by frame key and k.

    Attributes:
        frame_id: (n,) int64 key of the frame.
        k: (n,) int64 number of the label within its frame.
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
    """Return the keys of all labels of some frames, and their evidence.

    Args:
        workspace: the workspace.
        round_number: number e of the round.
        frames: keys of the frames.
        boxes: whether to read the boxes, which only few policies need.
        columns: those of "category", "score", "iou" and "loss" to return; None for all. The others
            are not read, and are NaN in the evidence ("" for the category). The keys have the
            category in any case: solve counts labels per category, which takes twice as long in
            SQL.
    """
    requested = {"category", "score", "iou", "loss"} if columns is None else set(columns)
    for source in sources_of(workspace.config.run.priors):
        prepare_table(workspace, source)
    rho = rho_columns(workspace.config.run.priors)
    measured = {"score": "prediction", "iou": "prediction", "loss": "consistency"}
    tables = {name: table for name, table in measured.items() if name in requested} | rho
    config = workspace.config
    if "semantic" in config.run.priors and config.semantic.outside == "expected":
        tables["box_pixels"] = "semantic_prior"
    if boxes:
        tables |= dict.fromkeys(BOX_COLUMNS, "prediction")
    with workspace.database.reading() as connection:
        found = bulk.select_columns(connection, aligned_query(round_number, tables))
    inside = np.isin(found["frame_id"], np.asarray(frames, dtype=np.int64))
    if not inside.all():
        found = {name: column[inside] for name, column in found.items()}
    keys = LabelKeys(found["frame_id"], found["k"], found["category"])
    missing = np.broadcast_to(np.nan, len(keys))
    return keys, Evidence(
        frame_index=keys.frame_id,
        category=keys.category if "category" in requested else np.broadcast_to("", len(keys)),
        score=found.get("score", missing),
        loss=found.get("loss", missing),
        rho={column: found[column] for column in rho},
        iou=found.get("iou", missing),
        boxes=np.stack([found[name] for name in BOX_COLUMNS], axis=1) if boxes else empty_boxes(),
        unseen=found.get("box_pixels", missing) == 0,
    )


def aligned_query(round_number: int, tables: Mapping[str, str]) -> Select[Any]:
    """Return the query for the predictions of a round with columns of several tables.

    Args:
        round_number: number e of the round.
        tables: table of each column; a label without a row in it gets null.
    """
    label = bulk.table("prediction")
    joined: FromClause = label
    for name in dict.fromkeys(tables.values()):
        table = bulk.table(name)
        if table is not label:
            same = and_(*(table.c[key] == label.c[key] for key in ("round", "frame_id", "k")))
            joined = joined.outerjoin(table, same)
    # As floats, because integers cannot be null in an array.
    columns = [
        type_coerce(bulk.table(table).c[name], Float()).label(name)
        for name, table in tables.items()
    ]
    return (
        select(label.c.frame_id, label.c.k, label.c.category, *columns)
        .select_from(joined)
        .where(label.c.round == round_number)
        .order_by(label.c.frame_id, label.c.k)
    )


def read_memory(workspace: Workspace, round_number: int, policy: str) -> Memory:
    """Return the labels of a round that a policy has weighted and not dropped.

    Raises:
        WorkspaceError: if the policy has not weighted that round.
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
            f"policy {policy} needs its weights of round {round_number}, which do not exist yet; "
            f"run `curate solve --policy {policy} --round {round_number}`"
        )
    with workspace.database.reading() as connection:
        found = bulk.select_columns(connection, query)
    boxes = np.stack([found.pop(name) for name in BOX_COLUMNS], axis=1)
    return Memory(frame_index=found.pop("frame_id"), boxes=boxes, **found)


def solved_fingerprint(workspace: Workspace, round_number: int, policy: str) -> str | None:
    """Return the fingerprint of a policy's stored weights of a round; None if there are none."""
    task = bulk.table("task")
    key = {"round": round_number, "stage": "solve", "variant": policy}
    query = select(task.c.fingerprint).where(
        *(task.c[name] == value for name, value in key.items())
    )
    found = workspace.database.rows(query)
    return found[0][0] if found else None
