"""Evaluate the labels of simulated frames against the ground truth that the simulation wrote.

The results are not stored, because ground truth of X_u must never enter the database.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy import select

from curate.evaluation.reliability import (
    auroc,
    rank_labels,
    weighted_precision,
    weighted_recall,
)
from db import bulk
from pipelines.labels.matching import match_in_frame, match_settings
from pipelines.workspace.workspace import Workspace, read_truth


@dataclass(frozen=True)
class JudgedLabels:
    """Which labels of simulated frames are correct.

    Attributes:
        correct: whether a label is correct, by frame key and k; without neutral labels.
        objects: number of objects of the frames.
    """

    correct: Mapping[tuple[int, int], bool]
    objects: int


def label_quality(
    workspace: Workspace, round_number: int, policies: Sequence[str]
) -> list[tuple[str, int, int, float, float, float]]:
    """Return a row per policy with the quality of its labels.

    Returns:
        Rows of policy, number of labels, number of labels with a weight above 0, weighted precision
        and weighted recall in percent, and AUROC; NaN for a figure that cannot be computed.
    """
    judged = judge_labels(workspace, round_number)
    rows = []
    for policy in policies:
        weights = _weights(workspace, round_number, policy)
        counted = [label for label in weights if label in judged.correct]
        v = np.array([weights[label] for label in counted])
        above_zero = sum(weight > 0 for weight in weights.values())
        is_correct = np.array([judged.correct[label] for label in counted], dtype=bool)
        rows.append(
            (
                policy,
                len(weights),
                above_zero,
                100 * weighted_precision(v, is_correct),
                100 * weighted_recall(v, is_correct, judged.objects),
                auroc(v, is_correct) if rank_labels(v) else math.nan,
            )
        )
    return rows


def judge_labels(workspace: Workspace, round_number: int) -> JudgedLabels:
    """Compare the labels of a round with the label files of the simulation."""
    keys = workspace.frames("unlabeled")
    found = workspace.labels(round_number, list(keys.values()))
    correct: dict[tuple[int, int], bool] = {}
    objects = 0
    settings = match_settings(workspace.config, "bev")
    for name, key in keys.items():
        truth = read_truth(workspace.config, workspace.dataset, name)
        matches = match_in_frame(workspace, name, found[key], truth, settings)
        objects += sum(matches.ground_truths.values())
        for k in np.flatnonzero(matches.counted):
            correct[key, int(k)] = bool(matches.correct[k])
    return JudgedLabels(correct, objects)


def _weights(workspace: Workspace, round_number: int, policy: str) -> dict[tuple[int, int], float]:
    table = bulk.table("weight")
    query = select(table.c.frame_id, table.c.k, table.c.v).where(
        table.c.round == round_number, table.c.policy == policy
    )
    return {(frame, k): v for frame, k, v in workspace.database.rows(query)}
