"""The stored decisions of people, and the predictions of each round that they speak for."""

import hashlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, select

from curate.detections import as_categories
from curate.files.batches import batched
from curate.review.human_labels import REJECTED, HumanLabels, match_human_labels
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.workspace.workspace import Workspace

# Frames that one statement names; SQLite takes some thousands of parameters.
_ASKED_AT_ONCE = 400

SEEN_COLUMNS = tuple(f"seen_{name}" for name in BOX_COLUMNS)
FIRST_K = 1_000_000
"""Human labels for which no prediction stands have k from here on in `weighted_labels`."""


@dataclass(frozen=True)
class StoredLabels:
    """The human labels of one frame with their numbers.

    Attributes:
        n: (n,) int64, their key within the frame.
        labels: see `HumanLabels`.
    """

    n: np.ndarray
    labels: HumanLabels


def read_human_labels(
    connection: Connection,
    frame_ids: Collection[int] | None = None,
    *,
    until_round: int | None = None,
    but_of: str | None = None,
) -> dict[int, StoredLabels]:
    """Return the human labels by frame key.

    Args:
        connection: to the database.
        frame_ids: of which frames; None for all.
        until_round: only those that count in this round.
        but_of: leaves those of a review out.
    """
    table = bulk.table("human_label")
    names = ("frame_id", "n", "decision", "category", *BOX_COLUMNS, *SEEN_COLUMNS)
    query = select(*(table.c[name] for name in names)).order_by(table.c.frame_id, table.c.n)
    if until_round is not None:
        query = query.where(table.c.from_round <= until_round)
    if but_of is not None:
        query = query.where(table.c.review != but_of)
    return {
        frame_id: _stored(rows)
        for frame_id, rows in bulk.grouped(bulk.select(connection, query)).items()
        if frame_ids is None or frame_id in frame_ids
    }


def refresh_matches(
    connection: Connection, round_number: int, frame_ids: Collection[int] | None = None
) -> int:
    """Find anew which predictions of a round the human labels speak for.

    Args:
        connection: of the transaction that changed predictions or human labels.
        round_number: e.
        frame_ids: of which frames; None for all.

    Returns:
        How many predictions it is.
    """
    match = bulk.table("human_match")
    gone = match.delete().where(match.c.round == round_number)
    if frame_ids is None:
        connection.execute(gone)
    for batch in batched(sorted(frame_ids or ()), _ASKED_AT_ONCE):
        connection.execute(gone.where(match.c.frame_id.in_(batch)))
    labels = read_human_labels(connection, frame_ids, until_round=round_number)
    rows: list[dict[str, Any]] = []
    for batch in batched(labels, _ASKED_AT_ONCE):
        predictions = _predictions(connection, round_number, batch)
        for frame_id, predicted in predictions.items():
            rows += _match_rows(round_number, frame_id, predicted, labels[frame_id])
    bulk.insert_rows(connection, "human_match", rows)
    return len(rows)


def refresh_all_matches(connection: Connection, frame_ids: Collection[int]) -> None:
    """`refresh_matches` for every round."""
    table = bulk.table("round")
    for (number,) in bulk.select(connection, select(table.c.number)):
        refresh_matches(connection, number, frame_ids)


def fingerprint(workspace: Workspace, round_number: int) -> str | None:
    """What the human labels that count in a round change about it; None without any."""
    table = bulk.table("human_label")
    names = ("frame_id", "decision", "category", *BOX_COLUMNS, *SEEN_COLUMNS)
    query = select(*(table.c[name] for name in names)).where(table.c.from_round <= round_number)
    rows = workspace.database.rows(query)
    return hashlib.sha256(repr(sorted(map(repr, rows))).encode()).hexdigest()[:32] if rows else None


def counts(workspace: Workspace, round_number: int) -> dict[str, int]:
    """Return how many human labels of each decision count in a round."""
    table = bulk.table("human_label")
    query = select(table.c.decision).where(table.c.from_round <= round_number)
    found = [row[0] for row in workspace.database.rows(query)]
    return {name: found.count(name) for name in sorted(set(found))}


def human_boxes(workspace: Workspace, round_number: int, frame_id: int) -> np.ndarray:
    """Return (n, 7) boxes of the objects of a frame that people decided on, in the LiDAR frame."""
    with workspace.database.reading() as connection:
        found = read_human_labels(connection, [frame_id], until_round=round_number)
    if frame_id not in found:
        return np.zeros((0, 7))
    labels = found[frame_id].labels
    boxes: np.ndarray = labels.boxes[labels.decisions != REJECTED]
    return boxes


def _stored(rows: Sequence[bulk.Row]) -> StoredLabels:
    n, decisions, categories, *numbers = zip(*rows, strict=True)
    table = np.array(numbers, dtype=np.float64).T
    labels = HumanLabels(
        as_categories(decisions), as_categories(categories), table[:, :7], table[:, 7:]
    )
    return StoredLabels(np.array(n, dtype=np.int64), labels)


def _predictions(
    connection: Connection, round_number: int, frame_ids: Sequence[int]
) -> Mapping[int, list[bulk.Row]]:
    """Number, category and box of the predictions of some frames of a round."""
    table = bulk.table("prediction")
    names = ("frame_id", "k", "category", *BOX_COLUMNS)
    query = (
        select(*(table.c[name] for name in names))
        .where(table.c.round == round_number, table.c.frame_id.in_(frame_ids))
        .order_by(table.c.frame_id, table.c.k)
    )
    return bulk.grouped(bulk.select(connection, query))


def _match_rows(
    round_number: int, frame_id: int, predicted: Sequence[bulk.Row], stored: StoredLabels
) -> Iterable[dict[str, Any]]:
    boxes = np.array([row[2:] for row in predicted], dtype=np.float64)
    spoken = match_human_labels(boxes, as_categories([row[1] for row in predicted]), stored.labels)
    for place in np.flatnonzero(spoken.label >= 0).tolist():
        yield {
            "round": round_number,
            "frame_id": frame_id,
            "k": predicted[place][0],
            "n": int(stored.n[spoken.label[place]]),
            "iou": float(spoken.iou[place]),
            "leads": int(spoken.leads[place]),
        }
