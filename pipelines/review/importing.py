"""curate review import: what people decided, stored in one transaction or not at all."""

import getpass
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import Connection, select

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
# How many faults an error names.
_NAMED = 5
_SHARED = ("frame_id", "item", "decision", "category", "from_round", *BOX_COLUMNS, *SEEN_COLUMNS)

LabelRow = dict[str, Any]
"""The columns `_SHARED` of a row of `human_label`."""


@dataclass(frozen=True)
class ReviewImport:
    """What an import did, or would do.

    Attributes:
        review: its id.
        frames: with an answer.
        without_answer: frames of the review that did not come back.
        accepted, rejected, moved, added: decisions.
        untouched: boxes on which nothing was said; they stay what they were.
        replaced: earlier decisions of other reviews about the same objects.
        changed: whether anything is different from what was stored before.
        from_round: the decisions count in this round and later ones.
        dry_run: nothing was stored.
    """

    review: str
    frames: int
    without_answer: int
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
    answer: Path | None = None,
    accept: Collection[str] = (),
    reviewer: str | None = None,
    from_round: int | None = None,
    dry_run: bool = False,
) -> ReviewImport:
    """Read an answer and stores its decisions in place of those of an earlier import of it.

    Args:
        workspace: see `Workspace`.
        folder: as it was exported.
        answer: what the editor wrote, where that lies elsewhere.
        accept: frames whose unchanged boxes are accepted; "all" for all of them.
        reviewer: who decided; None for the name of the user.
        from_round: first round in which the decisions count; None for the reviewed one.
        dry_run: only says what would be stored.

    Raises:
        DataError: if something is missing, damaged, or of another workspace or review.
        LeakageError: if a frame is not unlabeled.
        ConfigError: `accept` names no frame of the review.
    """
    sheet = read_sheet(folder)
    keys = _keys(workspace, folder, sheet)
    answers = _answers(workspace, folder, sheet, answer or folder, accept)
    first = sheet.round if from_round is None else from_round
    rows = [
        _row(keys[each.frame], decision, first) for each in answers for decision in each.decisions
    ]
    who = reviewer or _user()
    with workspace.database.reading() as connection:
        changed = _stored(connection, sheet.id) != sorted(rows, key=repr)
        gone = _superseded(connection, sheet.id, rows)
    if changed and not dry_run:
        with workspace.database.writing() as connection:
            _store(connection, sheet.id, rows, who)
    decided = [decision.decision for each in answers for decision in each.decisions]
    return ReviewImport(
        review=sheet.id,
        frames=len(answers),
        without_answer=len(sheet.frames) - len(answers),
        accepted=decided.count(ACCEPTED),
        rejected=decided.count(REJECTED),
        moved=decided.count(MOVED),
        added=decided.count(ADDED),
        untouched=sum(each.untouched for each in answers),
        replaced=len(gone),
        changed=changed,
        from_round=first,
        dry_run=dry_run,
    )


def _keys(workspace: Workspace, folder: Path, sheet: Sheet) -> dict[str, int]:
    """Return the keys of the frames of a review that this workspace has handed out."""
    table = bulk.table("review")
    known = workspace.database.rows(select(table.c.id).where(table.c.id == sheet.id))
    if not known:
        raise DataError(
            f"{folder / MANIFEST}: review {sheet.id} was not exported from the workspace "
            f"{workspace.root}; name its own with --workspace"
        )
    everywhere, unlabeled = workspace.frames(*SPLITS), workspace.frames("unlabeled")
    for shown in sheet.frames:
        if shown.frame not in everywhere:
            raise DataError(f"{folder / MANIFEST}: no frame is named '{shown.frame}' here")
        if shown.frame not in unlabeled:
            raise LeakageError(
                f"{folder / MANIFEST}: frame {shown.frame} is not unlabeled any more; "
                "human labels are for unlabeled frames only"
            )
    return unlabeled


def _answers(
    workspace: Workspace, folder: Path, sheet: Sheet, answer: Path, accept: Collection[str]
) -> list[FrameEdits]:
    editor = EDITORS.build(sheet.editor, offered={}, options={})
    edited = editor.read(answer, sheet, partial(workspace.dataset.read, points=False))
    words = read_table(folder, sheet)
    names = {shown.frame for shown in sheet.frames}
    for name in accept:
        if name not in {*names, ALL_FRAMES}:
            raise ConfigError(f"--accept: frame '{name}' is not in this review")
    answers = []
    for shown in sheet.frames:
        said = words.get(shown.frame, ExplicitDecisions())
        if shown.frame not in edited and not (said.boxes or said.accept_rest):
            continue
        boxes = edited.get(shown.frame, _as_shown(shown))
        check_boxes(boxes, sheet.categories)
        rest = said.accept_rest or not {shown.frame, ALL_FRAMES}.isdisjoint(accept)
        answers.append(compare_frame(shown, boxes, said.boxes, accept_rest=rest))
    _check_overlaps(answers)
    return answers


def _check_overlaps(answers: Sequence[FrameEdits]) -> None:
    """Raise DataError if two objects of an answer lie in each other."""
    found = []
    for answer in answers:
        rows = [_row(0, decision, 1) for decision in answer.decisions]
        for pair in overlapping_objects(_by_frame(rows)[0]) if rows else ():
            one, other = (_called(answer.decisions[place]) for place in pair)
            found.append(f"{one} and {other} of frame {answer.frame}")
    if found:
        more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
        raise DataError(
            f"two objects cannot lie in each other: reject one of {'; '.join(found[:_NAMED])}{more}"
        )


def _called(decision: Decision) -> str:
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
    """What is stored of a review, without who and when."""
    table = bulk.table("human_label")
    query = select(*(table.c[name] for name in _SHARED)).where(table.c.review == review)
    rows = bulk.select(connection, query)
    return sorted((dict(zip(_SHARED, row, strict=True)) for row in rows), key=repr)


def _superseded(
    connection: Connection, review: str, rows: Sequence[LabelRow]
) -> list[tuple[int, int]]:
    """Keys of the decisions of other reviews that new ones take the place of."""
    later = _by_frame(rows)
    former = read_human_labels(connection, later.keys(), exclude_review=review)
    return [
        (frame_id, n)
        for frame_id, stored in former.items()
        for n in stored.n[superseded(stored.labels, later[frame_id])].tolist()
    ]


def _store(connection: Connection, review: str, rows: Sequence[LabelRow], reviewer: str) -> None:
    """Put decisions in place of those of the review's earlier import, and what they overrule."""
    label, table = bulk.table("human_label"), bulk.table("review")
    mine = label.c.review == review
    before = bulk.select(connection, select(label.c.frame_id).where(mine).distinct())
    gone = _superseded(connection, review, rows)
    connection.execute(label.delete().where(mine))
    for frame_id, n in gone:
        connection.execute(label.delete().where(label.c.frame_id == frame_id, label.c.n == n))
    now = datetime.now(UTC).isoformat(timespec="seconds")
    frame_ids = {row["frame_id"] for row in rows}
    kept = read_human_labels(connection, frame_ids)
    taken = {frame_id: set(stored.n.tolist()) for frame_id, stored in kept.items()}
    everywhere = {
        "split": "unlabeled", "review": review, "reviewer": reviewer, "decided_at": now
    }  # fmt: skip
    numbers = [_free(taken.setdefault(row["frame_id"], set())) for row in rows]
    new = [{**row, "n": n, **everywhere} for row, n in zip(rows, numbers, strict=True)]
    bulk.insert_rows(connection, "human_label", new)
    refresh_all_matches(
        connection, {row[0] for row in before} | {key for key, _ in gone} | frame_ids
    )
    connection.execute(table.update().where(table.c.id == review).values(imported_at=now))


def clear(workspace: Workspace, reviews: Collection[str] = (), frames: Collection[str] = ()) -> int:
    """Forget human labels, of reviews or of frames or all; the policies' weights count again.

    Returns:
        How many labels there were.

    Raises:
        ConfigError: if no such review or frame.
    """
    label, review = bulk.table("human_label"), bulk.table("review")
    with workspace.database.writing() as connection:
        known = {row[0] for row in bulk.select(connection, select(review.c.id))}
        keys = workspace.frames("unlabeled")
        for name in {*reviews} - known:
            raise ConfigError(f"no review {name} here; `curate review list` lists them")
        for name in {*frames} - keys.keys():
            raise ConfigError(f"--frames: no unlabeled frame is named '{name}' here")
        query = select(label.c.frame_id, label.c.n)
        if reviews:
            query = query.where(label.c.review.in_(reviews))
        if frames:
            query = query.where(label.c.frame_id.in_([keys[name] for name in frames]))
        gone = bulk.select(connection, query)
        for frame_id, n in gone:
            connection.execute(label.delete().where(label.c.frame_id == frame_id, label.c.n == n))
        refresh_all_matches(connection, {frame_id for frame_id, _ in gone})
    return len(gone)


def _by_frame(rows: Iterable[LabelRow]) -> Mapping[int, HumanLabels]:
    """Return the labels of each frame."""
    found: dict[int, list[LabelRow]] = {}
    for row in rows:
        found.setdefault(row["frame_id"], []).append(row)
    return {
        frame_id: HumanLabels(
            as_categories([row["decision"] for row in own]),
            as_categories([row["category"] for row in own]),
            np.array([[row[name] for name in BOX_COLUMNS] for row in own], dtype=np.float64),
            np.array([[row[name] for name in SEEN_COLUMNS] for row in own], dtype=np.float64),
        )
        for frame_id, own in found.items()
    }


def _free(taken: set[int]) -> int:
    """Return the least number that is not taken; takes it."""
    n = next(n for n in range(len(taken) + 1) if n not in taken)
    taken.add(n)
    return n


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"
