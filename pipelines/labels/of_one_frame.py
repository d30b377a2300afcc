"""The stored boxes of one frame in a round: labels, repredictions, ground truth outside X_u."""

from dataclasses import dataclass

import numpy as np
from sqlalchemy import select

from curate.datasets.frame_names import FrameNames
from curate.detections import Annotations, Detections, as_categories
from curate.errors import ConfigError
from curate.viewing.tags import ShownRepredictions
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.labels.by_frame import check_weights, not_weighted_error
from pipelines.labels.human_labels import DecidedLabels, decided_labels
from pipelines.workspace.splits import SPLITS
from pipelines.workspace.workspace import Workspace


@dataclass(frozen=True)
class FrameBoxes:
    """The boxes of a frame.

    Attributes:
        split: split of the frame.
        labels: the n labels by k: predictions, and in place of those that a human label replaces,
            the objects that people accepted, moved or added, with score 1.
        numbers: (n,) k of each label.
        weights: (n,) weights of one policy; 0 for labels that it dropped or a person rejected, 1
            for objects of people, NaN if it has weighted none of the frame's labels.
        decisions: (n,) str, what a person decided about each label: accepted, moved, added,
            rejected, or "".
        repredictions: the repredictions of all views, each with the weight of its matched label.
        truth: ground truth, with NaN boxes for DontCare; None for frames of X_u.
    """

    split: str
    labels: Detections
    numbers: np.ndarray
    weights: np.ndarray
    decisions: np.ndarray
    repredictions: ShownRepredictions
    truth: Annotations | None

    @property
    def truth_boxes(self) -> np.ndarray | None:
        """(m, 7) ground-truth boxes in the LiDAR frame, NaN for DontCare; None for X_u."""
        return None if self.truth is None else self.truth.boxes


def weighted_frame_names(
    workspace: Workspace, round_number: int, policy: str, limit: int
) -> list[str]:
    """Return the names of the first `limit` frames with labels of a policy in a round.

    A frame in which only a person found objects has labels, too.

    Raises:
        WorkspaceError: if the policy has weighted nothing in that round.
    """
    frame, weight = bulk.table("frame"), bulk.table("weight")
    query = (
        select(frame.c.frame)
        .join(weight, weight.c.frame_id == frame.c.id)
        .where(weight.c.round == round_number, weight.c.policy == policy)
        .distinct()
        .order_by(frame.c.frame)
        .limit(limit)
    )
    names = [row[0] for row in workspace.database.rows(query)]
    if not names:
        raise not_weighted_error(round_number, policy)
    human = bulk.table("human_label")
    query = (
        select(frame.c.frame)
        .join(human, human.c.frame_id == frame.c.id)
        .where(human.c.from_round <= round_number)
        .distinct()
    )
    decided = {row[0] for row in workspace.database.rows(query)}
    return sorted(decided.union(names))[:limit]


def decided_in_frame(workspace: Workspace, name: str, round_number: int) -> DecidedLabels:
    """Return what people decided about a frame, as far as it is valid in a round."""
    return decided_labels(workspace, round_number, _find(workspace, name)[1])


def read_frame(workspace: Workspace, name: str, round_number: int, policy: str) -> FrameBoxes:
    """Return the stored boxes of a frame, with the weights of a policy.

    Raises:
        ConfigError: if no frame has that name.
        DataError: if a weight is not in [0, 1].
    """
    split, key = _find(workspace, name)
    labels = workspace.labels(round_number, [key])[key]
    weights = _weights(workspace, round_number, (key, name), policy, len(labels))
    truth = None if split == "unlabeled" else workspace.ground_truth(split)[name]
    decided = decided_labels(workspace, round_number, key)
    weights[list(decided.rejected)] = 0.0
    repredictions = _repredictions(workspace, round_number, key, weights)
    return FrameBoxes(split, *_with_decisions(labels, weights, decided), repredictions, truth)


def _with_decisions(
    labels: Detections, weights: np.ndarray, decided: DecidedLabels
) -> tuple[Detections, np.ndarray, np.ndarray, np.ndarray]:
    """Return labels, k, weights and decisions, with the objects of people among the predictions."""
    kept = np.array([k for k in range(len(labels)) if k not in decided.replaced], dtype=np.int64)
    objects = Detections.from_rows(
        [(each.category, 1.0, *each.box, None) for each in decided.objects]
    )
    every = labels.select(kept).followed_by(objects)
    numbers = np.array([*kept.tolist(), *(each.k for each in decided.objects)], dtype=np.int64)
    weights = np.concatenate([weights[kept], np.ones(len(objects))])
    decisions = as_categories([decided.by_k.get(k, "") for k in numbers.tolist()])
    order = np.argsort(numbers, kind="stable")
    return every.select(order), numbers[order], weights[order], decisions[order]


def find_frame(workspace: Workspace, name: str) -> str:
    """Return the id of a frame from any of its names, see `FrameNames`.

    Raises:
        ConfigError: if no frame has that name, or several could have it.
    """
    frames = workspace.frames(*SPLITS)
    return name if name in frames else FrameNames(frames).require(name, error_type=ConfigError)


def _find(workspace: Workspace, name: str) -> tuple[str, int]:
    table = bulk.table("frame")
    query = select(table.c.split, table.c.id).where(table.c.frame == find_frame(workspace, name))
    found = workspace.database.rows(query)
    return found[0][0], found[0][1]


def _weights(
    workspace: Workspace, round_number: int, frame: tuple[int, str], policy: str, count: int
) -> np.ndarray:
    """Return the (count,) weights of a frame, given by key and name, in the order of k."""
    table = bulk.table("weight")
    key, name = frame
    selected = (table.c.round == round_number, table.c.policy == policy, table.c.frame_id == key)
    with workspace.database.reading() as connection:
        check_weights(connection, round_number, policy, name)
        found = bulk.select(connection, select(table.c.k, table.c.v).where(*selected))
    weights = np.full(count, 0.0 if found else np.nan)
    for k, v in found:
        weights[k] = v
    return weights


def _repredictions(
    workspace: Workspace, round_number: int, key: int, weights: np.ndarray
) -> ShownRepredictions:
    table = bulk.table("reprediction")
    query = (
        select(table.c.matched_k, *(table.c[name] for name in BOX_COLUMNS))
        .where(table.c.round == round_number, table.c.frame_id == key)
        .order_by(table.c.view, table.c.k)
    )
    rows = workspace.database.rows(query)
    boxes = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 7)
    matched = [0.0 if row[0] is None else float(weights[row[0]]) for row in rows]
    return ShownRepredictions(boxes, np.array(matched, dtype=np.float64))
