"""The stored human labels, and the predictions of each round that match them."""

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
from db.labels import label_box, with_fused_boxes
from db.models import BOX_COLUMNS
from pipelines.workspace.workspace import Workspace

# SQLite limits the number of parameters of a statement.
_FRAMES_PER_STATEMENT = 400

SEEN_COLUMNS = tuple(f"seen_{name}" for name in BOX_COLUMNS)
FIRST_K = 1_000_000
"""In `weighted_labels`, a human label without a matching prediction has k = FIRST_K + n."""


@dataclass(frozen=True)
class StoredLabels:
    """The n human labels of one frame.

    Attributes:
        n: (n,) int64 number of each label within the frame.
        labels: the labels.
    """

    n: np.ndarray
    labels: HumanLabels


@dataclass(frozen=True)
class HumanObject:
    """An object that a person accepted, moved or added.

    Attributes:
        k: its number in `weighted_labels`.
        decision: accepted, moved or added.
        category: its category.
        box: x, y, z, length, width, height, yaw in the LiDAR frame.
    """

    k: int
    decision: str
    category: str
    box: tuple[float, ...]


@dataclass(frozen=True)
class DecidedLabels:
    """The decisions of people about one frame, as they change its labels in a round.

    Attributes:
        rejected: k of the predictions that a person rejected: weight 0.
        replaced: k of the predictions that an object replaces.
        objects: the objects, by k: weight 1.
    """

    rejected: frozenset[int]
    replaced: frozenset[int]
    objects: tuple[HumanObject, ...]

    @property
    def by_k(self) -> Mapping[int, str]:
        """The decision about each label of `weighted_labels` that a person decided about."""
        return dict.fromkeys(self.rejected, REJECTED) | {
            each.k: each.decision for each in self.objects
        }


def read_human_labels(
    connection: Connection,
    frame_ids: Collection[int] | None = None,
    *,
    until_round: int | None = None,
    exclude_review: str | None = None,
) -> dict[int, StoredLabels]:
    """Return the human labels by frame key.

    Args:
        connection: connection to the database.
        frame_ids: keys of the frames; None for all.
        until_round: number of a round; only the labels that are valid in it are returned.
        exclude_review: id of a review; its labels are not returned.
    """
    table = bulk.table("human_label")
    names = ("frame_id", "n", "decision", "category", *BOX_COLUMNS, *SEEN_COLUMNS)
    query = select(*(table.c[name] for name in names)).order_by(table.c.frame_id, table.c.n)
    if until_round is not None:
        query = query.where(table.c.from_round <= until_round)
    if exclude_review is not None:
        query = query.where(table.c.review != exclude_review)
    return {
        frame_id: _stored(rows)
        for frame_id, rows in bulk.grouped(bulk.select(connection, query)).items()
        if frame_ids is None or frame_id in frame_ids
    }


def refresh_matches(
    connection: Connection, round_number: int, frame_ids: Collection[int] | None = None
) -> int:
    """Match the predictions of a round with the human labels again, and store the matches.

    Args:
        connection: connection in the transaction that changed predictions or human labels.
        round_number: number e of the round.
        frame_ids: keys of the frames; None for all.

    Returns:
        The number of matched predictions.
    """
    match = bulk.table("human_match")
    delete = match.delete().where(match.c.round == round_number)
    if frame_ids is None:
        connection.execute(delete)
    for batch in batched(sorted(frame_ids or ()), _FRAMES_PER_STATEMENT):
        connection.execute(delete.where(match.c.frame_id.in_(batch)))
    labels = read_human_labels(connection, frame_ids, until_round=round_number)
    rows: list[dict[str, Any]] = []
    for batch in batched(labels, _FRAMES_PER_STATEMENT):
        predictions = _predictions(connection, round_number, batch)
        for frame_id, predicted in predictions.items():
            rows += _match_rows(round_number, frame_id, predicted, labels[frame_id])
    bulk.insert_rows(connection, "human_match", rows)
    return len(rows)


def refresh_all_matches(connection: Connection, frame_ids: Collection[int]) -> None:
    """Match the predictions of all rounds with the human labels again, see `refresh_matches`."""
    table = bulk.table("round")
    for (number,) in bulk.select(connection, select(table.c.number)):
        refresh_matches(connection, number, frame_ids)


def fingerprint(workspace: Workspace, round_number: int) -> str | None:
    """Return a hash of the human labels that are valid in a round; None if there are none."""
    table = bulk.table("human_label")
    names = ("frame_id", "decision", "category", *BOX_COLUMNS, *SEEN_COLUMNS)
    query = select(*(table.c[name] for name in names)).where(table.c.from_round <= round_number)
    rows = workspace.database.rows(query)
    return hashlib.sha256(repr(sorted(map(repr, rows))).encode()).hexdigest()[:32] if rows else None


def counts(workspace: Workspace, round_number: int) -> dict[str, int]:
    """Return the number of human labels valid in a round, by decision."""
    table = bulk.table("human_label")
    query = select(table.c.decision).where(table.c.from_round <= round_number)
    found = [row[0] for row in workspace.database.rows(query)]
    return {name: found.count(name) for name in sorted(set(found))}


def decided_frames(workspace: Workspace, round_number: int) -> int:
    """Return the number of frames with human labels that are valid in a round."""
    table = bulk.table("human_label")
    query = select(table.c.frame_id).where(table.c.from_round <= round_number).distinct()
    return len(workspace.database.rows(query))


def decided_labels(workspace: Workspace, round_number: int, frame_id: int) -> DecidedLabels:
    """Return what people decided about a frame, as far as it is valid in a round.

    Args:
        workspace: the workspace.
        round_number: number of the round.
        frame_id: key of the frame.
    """
    match = bulk.table("human_match").c
    query = select(match.k, match.n, match.leads).where(
        match.round == round_number, match.frame_id == frame_id
    )
    with workspace.database.reading() as connection:
        found = read_human_labels(connection, [frame_id], until_round=round_number).get(frame_id)
        matches = bulk.select(connection, query)
    if found is None:
        return DecidedLabels(frozenset(), frozenset(), ())
    decisions = dict(zip(found.n.tolist(), found.labels.decisions.tolist(), strict=True))
    rejected = {k for k, n, _ in matches if decisions[n] == REJECTED}
    lead = {n: k for k, n, leads in matches if leads}
    objects = [
        HumanObject(lead.get(n, FIRST_K + n), decision, category, tuple(box))
        for n, decision, category, box in zip(
            found.n.tolist(),
            found.labels.decisions.tolist(),
            found.labels.categories.tolist(),
            found.labels.boxes.tolist(),
            strict=True,
        )
        if decision != REJECTED
    ]
    replaced = {k for k, _, _ in matches} - rejected
    return DecidedLabels(
        frozenset(rejected), frozenset(replaced), tuple(sorted(objects, key=lambda each: each.k))
    )


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
    """Return, by frame key, k, category and box of the labels of some frames."""
    table = bulk.table("prediction")
    query = (
        select(table.c.frame_id, table.c.k, table.c.category, *label_box().values())
        .select_from(with_fused_boxes(table))
        .where(table.c.round == round_number, table.c.frame_id.in_(frame_ids))
        .order_by(table.c.frame_id, table.c.k)
    )
    return bulk.grouped(bulk.select(connection, query))


def _match_rows(
    round_number: int, frame_id: int, predicted: Sequence[bulk.Row], stored: StoredLabels
) -> Iterable[dict[str, Any]]:
    boxes = np.array([row[2:] for row in predicted], dtype=np.float64)
    matches = match_human_labels(boxes, as_categories([row[1] for row in predicted]), stored.labels)
    for i in np.flatnonzero(matches.label >= 0).tolist():
        yield {
            "round": round_number,
            "frame_id": frame_id,
            "k": predicted[i][0],
            "n": int(stored.n[matches.label[i]]),
            "iou": float(matches.iou[i]),
            "leads": int(matches.leads[i]),
        }
