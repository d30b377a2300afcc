"""Weighted labels by frame, as pictures and exporters take them."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from sqlalchemy import select

from curate.detections import Detections
from curate.errors import WorkspaceError
from db import bulk
from db.models import BOX_COLUMNS
from db.views import WEIGHTED_LABELS
from pipelines.workspace import Workspace


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


def read_labels(workspace: Workspace, round_number: int, policy: str) -> Iterator[FrameLabels]:
    """The frames that have labels, in the order of their names.

    Raises:
        WorkspaceError: the policy has weighted nothing in that round.
    """
    labels = WEIGHTED_LABELS.c
    names = ("frame", "category", "score", *BOX_COLUMNS, "weight", "points")
    query = (
        select(*(labels[name] for name in names))
        .where(labels.round == round_number, labels.policy == policy)
        .order_by(labels.frame, labels.k)
    )
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, query)
    if not rows:
        raise WorkspaceError(
            f"round {round_number} has no labels weighted by {policy}; "
            f"run `curate solve --policy {policy}`"
        )
    for frame, group in groupby(rows, key=lambda row: str(row[0])):
        own = list(group)
        counts = [row[-1] for row in own]
        yield FrameLabels(
            frame,
            Detections.from_rows([(*row[1:10], None) for row in own]),
            np.array([row[10] for row in own], dtype=np.float64),
            None if None in counts else np.array(counts),
        )
