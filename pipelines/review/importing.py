"""curate review import: store what people decided, in one transaction or not at all."""

import getpass
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import Connection, select

from curate.datasets.frame_names import FrameNames
from curate.detections import as_categories
from curate.errors import ConfigError, DataError, LeakageError
from curate.review.edits import Decision, EditedBox, FrameEdits, check_boxes, compare_frame
from curate.review.human_labels import (
    ACCEPTED,
    ADDED,
    MOVED,
    REJECTED,
    HumanLabels,
    overlapping_objects,
    superseded,
)
from curate.review.sheet import MANIFEST, Sheet, ShownFrame, read_sheet
from curate.review.table import ExplicitDecisions, read_table
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.labels.human_labels import SEEN_COLUMNS, read_human_labels, refresh_all_matches
from pipelines.registry import EDITORS
from pipelines.workspace.splits import SPLITS
from pipelines.workspace.workspace import Workspace

ALL_FRAMES = "all"
# Number of overlaps that an error message lists.
_LISTED = 5
_SHARED = ("frame_id", "item", "decision", "category", "from_round", *BOX_COLUMNS, *SEEN_COLUMNS)

LabelRow = dict[str, Any]
"""The columns `_SHARED` of a row of `human_label`."""


@dataclass(frozen=True)
class ReviewImport:
    """What an import did, or would do.

    Attributes:
        review: its id.
        frames: number of frames with edits or decisions.
        missing: number of frames of the review without either.
        accepted, rejected, moved, added: numbers of decisions.
        untouched: number of boxes without a decision; they do not change.
        replaced: number of earlier decisions of other reviews about the same objects.
        changed: whether the decisions differ from those stored before.
        from_round: the decisions count in this round and later ones.
        dry_run: whether nothing was stored.
    """

    review: str
    frames: int
    missing: int
    accepted: int
    rejected: int
    moved: int
    added: int
    untouched: int
    replaced: int
    changed: bool
    from_round: int
    dry_run: bool


def apply_review(
    workspace: Workspace,
    folder: Path,
    *,
    edited: Path | None = None,
    accept: Collection[str] = (),
    reviewer: str | None = None,
    from_round: int | None = None,
    dry_run: bool = False,
) -> ReviewImport:
    """Read an edited review and store its decisions; they replace those of its earlier import.

    Args:
        workspace: see `Workspace`.
        folder: the exported folder.
        edited: file or folder that the editor wrote, if it is elsewhere.
        accept: frames with unchanged boxes to accept; "all" for all of them.
        reviewer: who decided; None for the name of the user.
        from_round: first round in which the decisions count; None for the reviewed one.
        dry_run: whether to store nothing and only return the numbers.

    Raises:
        DataError: if something is missing or damaged, or belongs to another workspace or review.
        LeakageError: if a frame is not unlabeled.
        ConfigError: if `accept` contains a frame that is not in the review.
    """
    sheet = read_sheet(folder)
    keys = _keys(workspace, folder, sheet)
    edits = _read_edits(workspace, folder, sheet, edited or folder, accept)
    first = sheet.round if from_round is None else from_round
    rows = [
        _row(keys[each.frame], decision, first) for each in edits for decision in each.decisions
    ]
    who = reviewer or _user()
    with workspace.database.reading() as connection:
        changed = _stored(connection, sheet.id) != sorted(rows, key=repr)
        replaced = _superseded(connection, sheet.id, rows)
    if changed and not dry_run:
        with workspace.database.writing() as connection:
            _store(connection, sheet.id, rows, who)
    decided = [decision.decision for each in edits for decision in each.decisions]
    return ReviewImport(
        review=sheet.id,
        frames=len(edits),
        missing=len(sheet.frames) - len(edits),
        accepted=decided.count(ACCEPTED),
        rejected=decided.count(REJECTED),
        moved=decided.count(MOVED),
        added=decided.count(ADDED),
        untouched=sum(each.untouched for each in edits),
        replaced=len(replaced),
        changed=changed,
        from_round=first,
        dry_run=dry_run,
    )


def _keys(workspace: Workspace, folder: Path, sheet: Sheet) -> dict[str, int]:
    """Return the keys of unlabeled frames, if this workspace exported the review."""
    table = bulk.table("review")
    exported = workspace.database.rows(select(table.c.id).where(table.c.id == sheet.id))
    if not exported:
        raise DataError(
            f"{folder / MANIFEST}: review {sheet.id} was not exported from the workspace "
            f"{workspace.root}; specify its workspace with --workspace"
        )
    everywhere, unlabeled = workspace.frames(*SPLITS), workspace.frames("unlabeled")
    for shown in sheet.frames:
        if shown.frame not in everywhere:
            raise DataError(f"{folder / MANIFEST}: frame '{shown.frame}' is not in this workspace")
        if shown.frame not in unlabeled:
            raise LeakageError(
                f"{folder / MANIFEST}: frame {shown.frame} is no longer unlabeled; "
                "human labels are for unlabeled frames only"
            )
    return unlabeled


def _read_edits(
    workspace: Workspace, folder: Path, sheet: Sheet, path: Path, accept: Collection[str]
) -> list[FrameEdits]:
    editor = EDITORS.build(sheet.editor, offered={}, options={})
    edited = editor.read(path, sheet, partial(workspace.dataset.read, points=False))
    table = read_table(folder, sheet)
    frames = FrameNames(shown.frame for shown in sheet.frames)
    accepted = {
        name
        if name == ALL_FRAMES
        else frames.require(name, "--accept: in this review", error_type=ConfigError)
        for name in accept
    }
    edits = []
    for shown in sheet.frames:
        explicit = table.get(shown.frame, ExplicitDecisions())
        if shown.frame not in edited and not (explicit.boxes or explicit.accept_rest):
            continue
        boxes = edited.get(shown.frame, _as_shown(shown))
        check_boxes(boxes, sheet.categories)
        rest = explicit.accept_rest or not {shown.frame, ALL_FRAMES}.isdisjoint(accepted)
        edits.append(compare_frame(shown, boxes, explicit.boxes, accept_rest=rest))
    _check_overlaps(edits)
    return edits


def _check_overlaps(edits: Sequence[FrameEdits]) -> None:
    """Raise DataError if two objects of a frame overlap."""
    found = []
    for each in edits:
        rows = [_row(0, decision, 1) for decision in each.decisions]
        for pair in overlapping_objects(_by_frame(rows)[0]) if rows else ():
            one, other = (_name(each.decisions[place]) for place in pair)
            found.append(f"{one} and {other} of frame {each.frame}")
    if found:
        more = f" and {len(found) - _LISTED} more" if len(found) > _LISTED else ""
        raise DataError(
            f"two objects cannot overlap: reject one of {'; '.join(found[:_LISTED])}{more}"
        )


def _name(decision: Decision) -> str:
    number = "new box" if decision.number is None else f"box {decision.number}"
    return f"{number} ({decision.category})"


def _as_shown(shown: ShownFrame) -> list[EditedBox]:
    return [EditedBox(box.category, box.box, shown.frame) for box in shown.boxes]


def _row(frame_id: int, decision: Decision, from_round: int) -> LabelRow:
    """Return the columns `_SHARED`."""
    seen = decision.seen or (None,) * len(SEEN_COLUMNS)
    what = (frame_id, decision.number, decision.decision, decision.category, from_round)
    return dict(zip(_SHARED, (*what, *decision.box, *seen), strict=True))


def _stored(connection: Connection, review: str) -> list[LabelRow]:
    """Return the stored decisions of a review, without reviewer and time."""
    table = bulk.table("human_label")
    query = select(*(table.c[name] for name in _SHARED)).where(table.c.review == review)
    rows = bulk.select(connection, query)
    return sorted((dict(zip(_SHARED, row, strict=True)) for row in rows), key=repr)


def _superseded(
    connection: Connection, review: str, rows: Sequence[LabelRow]
) -> list[tuple[int, int]]:
    """Return the keys of the decisions of other reviews that the new ones replace."""
    later = _by_frame(rows)
    former = read_human_labels(connection, later.keys(), exclude_review=review)
    return [
        (frame_id, n)
        for frame_id, stored in former.items()
        for n in stored.n[superseded(stored.labels, later[frame_id])].tolist()
    ]


def _store(connection: Connection, review: str, rows: Sequence[LabelRow], reviewer: str) -> None:
    """Replace the review's earlier decisions, and those that the new ones supersede."""
    label, table = bulk.table("human_label"), bulk.table("review")
    of_review = label.c.review == review
    before = bulk.select(connection, select(label.c.frame_id).where(of_review).distinct())
    replaced = _superseded(connection, review, rows)
    connection.execute(label.delete().where(of_review))
    for frame_id, n in replaced:
        connection.execute(label.delete().where(label.c.frame_id == frame_id, label.c.n == n))
    now = datetime.now(UTC).isoformat(timespec="seconds")
    frame_ids = {row["frame_id"] for row in rows}
    kept = read_human_labels(connection, frame_ids)
    taken = {frame_id: set(stored.n.tolist()) for frame_id, stored in kept.items()}
    common = {
        "split": "unlabeled", "review": review, "reviewer": reviewer, "decided_at": now
    }  # fmt: skip
    numbers = [_free_number(taken.setdefault(row["frame_id"], set())) for row in rows]
    new = [{**row, "n": n, **common} for row, n in zip(rows, numbers, strict=True)]
    bulk.insert_rows(connection, "human_label", new)
    refresh_all_matches(
        connection, {row[0] for row in before} | {key for key, _ in replaced} | frame_ids
    )
    connection.execute(table.update().where(table.c.id == review).values(imported_at=now))


def clear(workspace: Workspace, reviews: Collection[str] = (), frames: Collection[str] = ()) -> int:
    """Delete human labels of reviews, of frames, or all; the weights of the policies count again.

    Returns:
        The number of deleted labels.

    Raises:
        ConfigError: if a review or a frame is unknown.
    """
    label, review = bulk.table("human_label"), bulk.table("review")
    with workspace.database.writing() as connection:
        known = {row[0] for row in bulk.select(connection, select(review.c.id))}
        keys = workspace.frames("unlabeled")
        for name in {*reviews} - known:
            raise ConfigError(f"unknown review {name}; `curate review list` shows the reviews")
        unlabeled = FrameNames(keys)
        frames = [
            unlabeled.require(name, "--frames: among the unlabeled frames", error_type=ConfigError)
            for name in frames
        ]
        query = select(label.c.frame_id, label.c.n)
        if reviews:
            query = query.where(label.c.review.in_(reviews))
        if frames:
            query = query.where(label.c.frame_id.in_([keys[name] for name in frames]))
        deleted = bulk.select(connection, query)
        for frame_id, n in deleted:
            connection.execute(label.delete().where(label.c.frame_id == frame_id, label.c.n == n))
        refresh_all_matches(connection, {frame_id for frame_id, _ in deleted})
    return len(deleted)


def _by_frame(rows: Iterable[LabelRow]) -> Mapping[int, HumanLabels]:
    """Return the labels of each frame."""
    found: dict[int, list[LabelRow]] = {}
    for row in rows:
        found.setdefault(row["frame_id"], []).append(row)
    return {
        frame_id: HumanLabels(
            as_categories([row["decision"] for row in of_frame]),
            as_categories([row["category"] for row in of_frame]),
            np.array([[row[name] for name in BOX_COLUMNS] for row in of_frame], dtype=np.float64),
            np.array([[row[name] for name in SEEN_COLUMNS] for row in of_frame], dtype=np.float64),
        )
        for frame_id, of_frame in found.items()
    }


def _free_number(taken: set[int]) -> int:
    """Return the smallest number that is not taken, and add it to the taken ones."""
    n = next(n for n in range(len(taken) + 1) if n not in taken)
    taken.add(n)
    return n


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"
