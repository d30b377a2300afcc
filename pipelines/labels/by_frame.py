"""Weighted labels by frame, as pictures and exporters take them."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from sqlalchemy import BindParameter, Connection, bindparam, func, or_, select

from curate.detections import Detections
from curate.errors import WorkspaceError
from curate.exporters.base import bad_weight
from db import bulk
from db.models import BOX_COLUMNS
from db.views import WEIGHTED_LABELS
from pipelines.workspace.workspace import Workspace


@dataclass(frozen=True)
class FrameLabels:
    """The labels of one frame.

    Attributes:
        frame: its name.
        labels: boxes in the LiDAR frame, scores, categories.
        weights: (n,) of one policy.
        points: (n,) LiDAR points inside each box; None where they were not counted.
    """

    frame: str
    labels: Detections
    weights: np.ndarray
    points: np.ndarray | None


def weighted_round(workspace: Workspace, policy: str, number: int | None = None) -> int | None:
    """The round asked for, or the last one; None where the policy has weighted nothing in it."""
    weight = bulk.table("weight")
    query = select(func.max(weight.c.round)).where(weight.c.policy == policy)
    if number is not None:
        query = query.where(weight.c.round == number)
    with workspace.database.reading() as connection:
        found: int | None = connection.execute(query).scalar_one()
    return found


def read_labels(workspace: Workspace, round_number: int, policy: str) -> Iterator[FrameLabels]:
    """The frames that have labels, in the order of their names.

    Raises:
        WorkspaceError: the policy has weighted nothing in that round.
        DataError: a weight is not in [0, 1].
    """
    labels = WEIGHTED_LABELS.c
    names = ("frame", "category", "score", *BOX_COLUMNS, "weight", "points")
    query = (
        select(*(labels[name] for name in names))
        .where(labels.round == round_number, labels.policy == policy)
        .order_by(labels.frame, labels.k)
    )
    with workspace.database.reading() as connection:
        check_weights(connection, round_number, policy)
        rows = bulk.select(connection, query)
    if not rows:
        raise unweighted(round_number, policy)
    for frame, group in groupby(rows, key=lambda row: str(row[0])):
        own = list(group)
        counts = [row[-1] for row in own]
        yield FrameLabels(
            frame,
            Detections.from_rows([(*row[1:10], None) for row in own]),
            np.array([row[10] for row in own], dtype=np.float64),
            None if None in counts else np.array(counts),
        )


def unweighted(round_number: int, policy: str) -> WorkspaceError:
    """What is wrong where a policy has weighted nothing in a round."""
    return WorkspaceError(
        f"round {round_number} has no labels weighted by {policy}; "
        f"run `curate solve --round {round_number} --policy {policy}`"
    )


def check_weights(
    connection: Connection, round_number: int, policy: str, frame: str | None = None
) -> None:
    """DataError where a weight of a round, or of one frame in it, is not in [0, 1].

    No policy makes one, but SQLite keeps whatever else writes into the table.
    """
    weight, frames = bulk.table("weight"), bulk.table("frame")
    # A value in the text of the query lets the policy's own index answer it.
    chosen: BindParameter[str] = bindparam("policy", policy, literal_execute=True)
    # Text and NaN are beyond 1, in the order of either database.
    impossible = or_(weight.c.v < 0, weight.c.v > 1, weight.c.v.is_(None))
    query = (
        select(frames.c.frame, weight.c.k, weight.c.v)
        .join(frames, frames.c.id == weight.c.frame_id)
        .where(weight.c.round == round_number, weight.c.policy == chosen, impossible)
        .limit(1)
    )
    if frame is not None:
        query = query.where(frames.c.frame == frame)
    for row in bulk.select(connection, query):
        raise bad_weight(*row)
