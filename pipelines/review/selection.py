"""Which labels of a round people are asked about, and what they are shown around them."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np
from sqlalchemy import ColumnElement, Connection, func, select

from curate.errors import ConfigError, LeakageError, WorkspaceError
from curate.evaluation.label_changes import compare_labels
from curate.review.sheet import Sheet, ShownBox, ShownFrame
from db import bulk
from db.models import BOX_COLUMNS
from db.views import WEIGHTED_LABELS
from pipelines.labels.by_frame import weighted_round
from pipelines.labels.columns import as_rounds, read_columns
from pipelines.workspace.splits import SPLITS
from pipelines.workspace.workspace import Workspace

ORDERS = ("uncertain", "lowest", "changed")
EVEN_ODDS = 0.5
"""The least certain label is the one whose weight is nearest to this."""
CONTEXT_WEIGHT = 0.1
"""Labels of the same frames are shown as context from this weight on."""

Asked = Collection[tuple[str, int]]
"""Frames and numbers of labels."""


@dataclass(frozen=True)
class ReviewRequest:
    """Which labels are wanted.

    Attributes:
        count: how many at most.
        order: uncertain: weight nearest to 0.5 first; lowest: lowest weight first, of equal ones
            the highest score; changed: largest change of the weight since the round before.
        frames: only in these, which are shown in any case; none for all.
        categories: only of these; none for all.
    """

    count: int = 100
    order: str = "uncertain"
    frames: Sequence[str] = field(default_factory=tuple)
    categories: Sequence[str] = field(default_factory=tuple)


def make_sheet(
    workspace: Workspace, round_number: int | None, policy: str, editor: str, request: ReviewRequest
) -> Sheet:
    """Return the wanted labels with the other kept labels of their frames around them.

    Args:
        workspace: see `Workspace`.
        round_number: None for the last that the policy has weighted.
        policy: whose weights.
        editor: name of the format.
        request: see `ReviewRequest`.

    Raises:
        ConfigError: if no such order, frame or category.
        LeakageError: if a frame is not unlabeled.
        WorkspaceError: if the policy has weighted nothing, or no label is wanted.
    """
    _check(workspace, request)
    number = _weighted_round(workspace, round_number, policy)
    asked = _changed(workspace, number, policy, request) if request.order == "changed" else None
    with workspace.database.reading() as connection:
        if asked is None:
            asked = _first(connection, number, policy, request)
        names = sorted({*request.frames, *(frame for frame, _ in asked)})
        frames = tuple(
            ShownFrame(name, tuple(_shown(connection, number, policy, name, asked)))
            for name in names
        )
    if not frames:
        raise WorkspaceError(
            f"round {number}: {policy} has no such label to ask about; people have decided on all "
            "of them, or --category is too narrow"
        )
    known = {*workspace.config.dataset.categories}
    others = {box.category for frame in frames for box in frame.boxes} - known
    categories = (*workspace.config.dataset.categories, *sorted(others))
    return Sheet(number, policy, editor, categories, frames)


def _check(workspace: Workspace, request: ReviewRequest) -> None:
    if request.order not in ORDERS:
        raise ConfigError(f"--by {request.order}: use one of {', '.join(ORDERS)}")
    known = workspace.config.dataset.categories
    for category in request.categories:
        if category not in known:
            raise ConfigError(f"--category {category}: use some of {', '.join(known)}")
    everywhere, unlabeled = workspace.frames(*SPLITS), workspace.frames("unlabeled")
    for frame in request.frames:
        if frame not in everywhere:
            raise ConfigError(f"--frames: no frame is named '{frame}' here")
        if frame not in unlabeled:
            raise LeakageError(
                f"--frames: frame {frame} is not unlabeled; ground truth of labeled and val frames "
                "is what labels are held against, only labels of unlabeled frames are reviewed"
            )


def _weighted_round(workspace: Workspace, number: int | None, policy: str) -> int:
    """Return the round asked for, or the last one; it must have weights of the policy."""
    found = weighted_round(workspace, policy, number)
    if found is None:
        where = "" if number is None else f" --round {number}"
        raise WorkspaceError(
            f"{policy} has weighted no labels{where and f' of round {number}'} yet; "
            f"run `curate solve{where} --policy {policy}`"
        )
    return found


def _first(connection: Connection, number: int, policy: str, request: ReviewRequest) -> Asked:
    """Return the labels that come first in the wanted order."""
    labels = WEIGHTED_LABELS.c
    orders: dict[str, list[ColumnElement]] = {
        "uncertain": [func.abs(labels.weight - EVEN_ODDS)],
        "lowest": [labels.weight, labels.score.desc()],
    }
    query = select(labels.frame, labels.k).where(
        labels.round == number, labels.policy == policy, labels.provenance == "detector"
    )
    if request.frames:
        query = query.where(labels.frame.in_(request.frames))
    if request.categories:
        query = query.where(labels.category.in_(request.categories))
    query = query.order_by(*orders[request.order], labels.frame, labels.k).limit(request.count)
    return {(str(frame), int(k)) for frame, k in bulk.select(connection, query)}


def _changed(workspace: Workspace, number: int, policy: str, request: ReviewRequest) -> Asked:
    """Return the labels whose weight changed most since the round before."""
    if number < 2:
        raise ConfigError("--by changed: round 1 has no round before it; use --by uncertain")
    before, after = (read_columns(workspace, each, policy) for each in (number - 1, number))
    changes = compare_labels(*as_rounds(before, after))
    rows = changes.largest(len(changes.before) + len(changes.after))[0][:, 1]
    human = _human_labels(workspace, number, policy)
    asked: dict[tuple[str, int], None] = {}
    for row in rows[rows >= 0].tolist():
        key = after.frame_names[after.frames[row]], int(after.k[row])
        category = after.category_names[after.categories[row]]
        wanted = (not request.frames or key[0] in request.frames) and (
            not request.categories or category in request.categories
        )
        if wanted and key not in human:
            asked[key] = None
        if len(asked) == request.count:
            break
    return asked.keys()


def _human_labels(workspace: Workspace, number: int, policy: str) -> Asked:
    labels = WEIGHTED_LABELS.c
    query = select(labels.frame, labels.k).where(
        labels.round == number, labels.policy == policy, labels.provenance == "human"
    )
    return {(str(frame), int(k)) for frame, k in workspace.database.rows(query)}


def _shown(
    connection: Connection, number: int, policy: str, name: str, asked: Asked
) -> list[ShownBox]:
    """Return the boxes of a frame: those asked about, others of some weight, and human labels."""
    labels = WEIGHTED_LABELS.c
    names = ("k", "category", *BOX_COLUMNS, "score", "weight", "provenance")
    query = (
        select(*(labels[each] for each in names))
        .where(labels.round == number, labels.policy == policy, labels.frame == name)
        .order_by(labels.k)
    )
    shown = []
    for k, category, *box, score, weight, provenance in bulk.select(connection, query):
        wanted = (name, k) in asked
        if wanted or weight >= CONTEXT_WEIGHT:
            human = provenance == "human"
            place = tuple(np.array(box, dtype=np.float64).tolist())
            shown.append(
                ShownBox(int(k), str(category), place, float(score), float(weight), wanted, human)
            )
    return shown
