"""Weighted labels by frame, as pictures and exporters take them."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from sqlalchemy import text

from curate.detections import Detections
from curate.errors import WorkspaceError
from pipelines.workspace import Workspace

_QUERY = """
    SELECT frame, category, score, x, y, z, length, width, height, yaw, weight, points
    FROM weighted_labels WHERE round = :round AND policy = :policy ORDER BY frame, k
"""


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
    with workspace.database.reading() as connection:
        key = {"round": round_number, "policy": policy}
        rows = connection.execute(text(_QUERY), key).fetchall()
    if not rows:
        raise WorkspaceError(
            f"round {round_number} has no labels weighted by {policy}; "
            f"run `curate solve --policy {policy}`"
        )
    for frame, group in groupby(rows, key=lambda row: str(row[0])):
        own = [tuple(row) for row in group]
        counts = [row[-1] for row in own]
        yield FrameLabels(
            frame,
            Detections.from_rows([row[1:10] for row in own]),
            np.array([row[10] for row in own], dtype=np.float64),
            None if None in counts else np.array(counts),
        )
