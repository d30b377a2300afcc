"""Select the labels of a round to review, with other labels of their frames as context."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from sqlalchemy import ColumnElement, Connection, func, select

from curate.detections import empty_boxes
from curate.errors import ConfigError, LeakageError, WorkspaceError
from curate.evaluation.label_changes import compare_labels
from curate.geometry.overlap import bev_iou
from curate.review.human_labels import SAME_OBJECT_IOU
from curate.review.sheet import FIRST_PROPOSAL_K, Sheet, ShownBox, ShownFrame
from db import bulk
from db.models import BOX_COLUMNS
from db.views import WEIGHTED_LABELS
from pipelines.labels.by_frame import weighted_round
from pipelines.labels.columns import as_rounds, read_columns
from pipelines.workspace.splits import SPLITS
from pipelines.workspace.workspace import Workspace

ORDERS = ("uncertain", "lowest", "changed", "proposals")
EVEN_ODDS = 0.5
"""The nearer a weight is to this, the less certain the label is."""
CONTEXT_WEIGHT = 0.1
"""Other labels of the same frames are shown as context if their weight is at least this."""


LabelKeys = Collection[tuple[str, int]]
"""Labels by frame name and number k."""


@dataclass(frozen=True)
class ReviewRequest:
    """Which labels to review.

    Attributes:
        count: maximum number of labels.
        order: what comes first. uncertain: weight nearest to 0.5; lowest: lowest weight, ties by
            highest score; changed: largest change of the weight since the previous round;
            proposals: no labels, but the proposals of `curate propose` with the most points.
        frames: only labels of these frames, which are exported even without labels; empty for all.
        categories: only labels of these categories; empty for all.
    """

    count: int = 100
    order: str = "uncertain"
    frames: Sequence[str] = field(default_factory=tuple)
    categories: Sequence[str] = field(default_factory=tuple)


def make_sheet(
    workspace: Workspace, round_number: int | None, policy: str, editor: str, request: ReviewRequest
) -> Sheet:
    """Return the selected labels, with other labels of their frames as context.

    Args:
        workspace: see `Workspace`.
        round_number: None for the last that the policy has weighted.
        policy: policy of the weights.
        editor: name of the file format.
        request: see `ReviewRequest`.

    Raises:
        ConfigError: if the order, a frame or a category is unknown.
        LeakageError: if a frame is not unlabeled.
        WorkspaceError: if the policy has weighted nothing, or no label is selected.
    """
    request = _checked(workspace, request)
    number = _weighted_round(workspace, round_number, policy)
    selected: LabelKeys | None = None
    proposed: Mapping[str, list[ShownBox]] = {}
    if request.order == "changed":
        selected = _changed(workspace, number, policy, request)
    elif request.order == "proposals":
        selected, proposed = (), _proposed(workspace, number, request)
    with workspace.database.reading() as connection:
        if selected is None:
            selected = _first(connection, number, policy, request)
        names = sorted({*request.frames, *proposed, *(frame for frame, _ in selected)})
        frames = tuple(
            ShownFrame(
                name,
                (*_shown(connection, number, policy, name, selected), *proposed.get(name, ())),
            )
            for name in names
        )
    if not frames:
        raise WorkspaceError(
            f"round {number}: {policy} has no such label to review; all of them have a human "
            "decision, or --category is too narrow"
        )
    configured = workspace.config.dataset.categories
    others = {box.category for frame in frames for box in frame.boxes} - {*configured}
    categories = (*configured, *sorted(others))
    return Sheet(number, policy, editor, categories, frames)


def _checked(workspace: Workspace, request: ReviewRequest) -> ReviewRequest:
    """Return the request with the ids of its frames, which may be spelled otherwise."""
    if request.order not in ORDERS:
        raise ConfigError(f"--by {request.order}: use one of {', '.join(ORDERS)}")
    categories = workspace.config.dataset.categories
    for category in request.categories:
        if category not in categories:
            raise ConfigError(f"--category {category}: use one or more of {', '.join(categories)}")
    everywhere, unlabeled = workspace.frame_names(*SPLITS), workspace.frames("unlabeled")
    frames = [
        everywhere.require(name, "--frames", error_type=ConfigError) for name in request.frames
    ]
    for frame in frames:
        if frame not in unlabeled:
            raise LeakageError(
                f"--frames: frame {frame} is not unlabeled; only labels of unlabeled frames can "
                "be reviewed"
            )
    return replace(request, frames=tuple(dict.fromkeys(frames)))


def _weighted_round(workspace: Workspace, number: int | None, policy: str) -> int:
    """Return the requested round, or the last one with weights of the policy."""
    found = weighted_round(workspace, policy, number)
    if found is None:
        option = "" if number is None else f" --round {number}"
        raise WorkspaceError(
            f"{policy} has weighted no labels{option and f' of round {number}'} yet; "
            f"run `curate solve{option} --policy {policy}`"
        )
    return found


def _first(connection: Connection, number: int, policy: str, request: ReviewRequest) -> LabelKeys:
    """Return the labels that come first in the requested order."""
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


def _changed(workspace: Workspace, number: int, policy: str, request: ReviewRequest) -> LabelKeys:
    """Return the labels with the largest change of the weight since the previous round."""
    if number < 2:
        raise ConfigError("--by changed: round 1 has no previous round; use --by uncertain")
    before, after = (read_columns(workspace, each, policy) for each in (number - 1, number))
    changes = compare_labels(*as_rounds(before, after))
    rows = changes.largest(len(changes.before) + len(changes.after))[0][:, 1]
    human = _human_labels(workspace, number, policy)
    selected: dict[tuple[str, int], None] = {}
    for row in rows[rows >= 0].tolist():
        key = after.frame_names[after.frames[row]], int(after.k[row])
        category = after.category_names[after.categories[row]]
        matches = (not request.frames or key[0] in request.frames) and (
            not request.categories or category in request.categories
        )
        if matches and key not in human:
            selected[key] = None
        if len(selected) == request.count:
            break
    return selected.keys()


def _proposed(
    workspace: Workspace, number: int, request: ReviewRequest
) -> Mapping[str, list[ShownBox]]:
    """Return the stored proposals with the most points, by frame, without decided ones.

    Raises:
        WorkspaceError: if there is none to review.
    """
    table, frame = bulk.table("proposal"), bulk.table("frame")
    names = ("n", "category", *BOX_COLUMNS)
    query = (
        select(frame.c.frame, *(table.c[name] for name in names))
        .join(frame, frame.c.id == table.c.frame_id)
        .where(table.c.round == number, frame.c.split == "unlabeled")
        .order_by(table.c.points.desc(), frame.c.frame, table.c.n)
    )
    if request.frames:
        query = query.where(frame.c.frame.in_(request.frames))
    if request.categories:
        query = query.where(table.c.category.in_(request.categories))
    decided = decided_boxes(workspace)
    found: dict[str, list[ShownBox]] = {}
    for name, n, category, *box in workspace.database.rows(query):
        if sum(map(len, found.values())) == request.count:
            break
        place = tuple(map(float, box))
        if (bev_iou(np.array([place]), decided.get(name, empty_boxes())) > SAME_OBJECT_IOU).any():
            continue
        shown = ShownBox(FIRST_PROPOSAL_K + int(n), str(category), place, 0.0, 0.0, asked=True)
        found.setdefault(str(name), []).append(shown)
    if not found:
        raise WorkspaceError(
            f"round {number} has no such proposals to review; run `curate propose --round {number}`"
        )
    return found


def decided_boxes(workspace: Workspace) -> Mapping[str, np.ndarray]:
    """Return the boxes that people decided about, by frame."""
    label, frame = bulk.table("human_label"), bulk.table("frame")
    query = select(frame.c.frame, *(label.c[name] for name in BOX_COLUMNS)).join(
        frame, frame.c.id == label.c.frame_id
    )
    rows = bulk.grouped(workspace.database.rows(query))
    return {name: np.array(boxes, dtype=np.float64) for name, boxes in rows.items()}


def _human_labels(workspace: Workspace, number: int, policy: str) -> LabelKeys:
    labels = WEIGHTED_LABELS.c
    query = select(labels.frame, labels.k).where(
        labels.round == number, labels.policy == policy, labels.provenance == "human"
    )
    return {(str(frame), int(k)) for frame, k in workspace.database.rows(query)}


def _shown(
    connection: Connection, number: int, policy: str, name: str, selected: LabelKeys
) -> list[ShownBox]:
    """Return the selected boxes of a frame, and the others with at least `CONTEXT_WEIGHT`."""
    labels = WEIGHTED_LABELS.c
    names = ("k", "category", *BOX_COLUMNS, "score", "weight", "provenance")
    query = (
        select(*(labels[each] for each in names))
        .where(labels.round == number, labels.policy == policy, labels.frame == name)
        .order_by(labels.k)
    )
    shown = []
    for k, category, *box, score, weight, provenance in bulk.select(connection, query):
        asked = (name, k) in selected
        if asked or weight >= CONTEXT_WEIGHT:
            human = provenance == "human"
            place = tuple(np.array(box, dtype=np.float64).tolist())
            shown.append(
                ShownBox(int(k), str(category), place, float(score), float(weight), asked, human)
            )
    return shown
