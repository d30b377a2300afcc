"""How good the labels of simulated frames are, by the truth that the simulation wrote beside them.

Nothing of it is stored: the ground truth of X_u never enters the database.
"""

from collections.abc import Sequence

import numpy as np
from sqlalchemy import select

from curate.evaluation.reliability import (
    auroc,
    match_to_ground_truth,
    weighted_precision,
    weighted_recall,
)
from curate.geometry.projection import image_rectangles
from db import bulk
from pipelines.workspace.workspace import Workspace


def label_quality(
    workspace: Workspace, round_number: int, policies: Sequence[str]
) -> list[tuple[str, int, int, float, float, float]]:
    """Per policy: labels, labels with weight, weighted precision and recall in percent, AUROC."""
    keys = workspace.frames("unlabeled")
    found = workspace.predictions(round_number, list(keys.values()))
    right: dict[tuple[int, int], bool] = {}
    objects = 0
    for name, key in keys.items():
        frame = workspace.dataset.read(name, points=False)
        rectangles = image_rectangles(found[key].boxes, frame.calibration, frame.image_size)
        verdict = match_to_ground_truth(
            found[key], workspace.dataset.annotations(name), rectangles=rectangles
        )
        objects += sum(verdict.ground_truths.values())
        for k in np.flatnonzero(verdict.counted):
            right[key, int(k)] = bool(verdict.correct[k])
    rows = []
    for policy in policies:
        weights = _weights(workspace, round_number, policy)
        judged = [label for label in weights if label in right]
        v = np.array([weights[label] for label in judged])
        truth = np.array([right[label] for label in judged], dtype=bool)
        rows.append(
            (
                policy,
                len(weights),
                int((v > 0).sum()),
                100 * weighted_precision(v, truth),
                100 * weighted_recall(v, truth, objects),
                auroc(v, truth),
            )
        )
    return rows


def _weights(workspace: Workspace, round_number: int, policy: str) -> dict[tuple[int, int], float]:
    table = bulk.table("weight")
    query = select(table.c.frame_id, table.c.k, table.c.v).where(
        table.c.round == round_number, table.c.policy == policy
    )
    return {(frame, k): v for frame, k, v in workspace.database.rows(query)}
