"""What became of a policy's labels from one round to another."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from curate.label_changes import LabelChanges, compare_labels
from pipelines.label_columns import LabelColumns, as_rounds, read_columns
from pipelines.workspace import Workspace

COLUMNS = (
    "category", "before", "after", "matched", "gained", "lost", "moved", "heavier", "lighter",
    "weight_before", "weight_after",
)  # fmt: skip
MOVED_BELOW = 0.7
"""A label has moved where its boxes overlap by less than this, KITTI's bound for a car."""
CHANGED_BY = 0.05
"""A weight counts as changed from this difference on."""


@dataclass(frozen=True)
class ChangedLabel:
    """A label whose weight changed.

    Attributes:
        change: gained, lost, moved or weight.
        frame: its frame.
        category: its category.
        k_before: its number in the earlier round, None where it is gained.
        k_after: its number in the later round, None where it is lost.
        iou: BEV IoU of both boxes; None without both.
        weight_before: 0 where it is gained.
        weight_after: 0 where it is lost.
    """

    change: str
    frame: str
    category: str
    k_before: int | None
    k_after: int | None
    iou: float | None
    weight_before: float
    weight_after: float


@dataclass(frozen=True)
class Difference:
    """Two rounds compared.

    Attributes:
        rounds: both numbers.
        policy: whose weights.
        categories: a row of `COLUMNS` per category, then one for all of them.
        labels: whose weight changed most, the largest change first.
    """

    rounds: tuple[int, int]
    policy: str
    categories: tuple[dict[str, Any], ...]
    labels: tuple[ChangedLabel, ...]


def compare_rounds(
    workspace: Workspace, rounds: tuple[int, int], policy: str, listed: int
) -> Difference:
    """The difference.

    Args:
        workspace: see `Workspace`.
        rounds: earlier and later.
        policy: whose weights.
        listed: how many changed labels to list.

    Raises:
        WorkspaceError: the policy has weighted nothing in one of the rounds.
    """
    before, after = (read_columns(workspace, number, policy) for number in rounds)
    return difference_of(before, after, rounds, policy, listed)


def difference_of(
    before: LabelColumns, after: LabelColumns, rounds: tuple[int, int], policy: str, listed: int
) -> Difference:
    """The difference of labels that are read already; see `compare_rounds`."""
    changes = compare_labels(*as_rounds(before, after))
    names = tuple(dict.fromkeys((*before.category_names, *after.category_names)))
    rows = [_row(changes, name, number) for number, name in enumerate(names)]
    rows.append(_row(changes, "all", None))
    return Difference(rounds, policy, tuple(rows), tuple(_listed(changes, before, after, listed)))


def _row(changes: LabelChanges, name: str, category: int | None) -> dict[str, Any]:
    """A row of `COLUMNS`."""
    before, after = (
        np.full(len(side), True) if category is None else side.categories == category
        for side in (changes.before, changes.after)
    )
    paired = before[changes.pairs[:, 0]]
    change = changes.weight_change[paired]
    values = (
        *(name, int(before.sum()), int(after.sum()), int(paired.sum())),
        *(int(after[changes.gained].sum()), int(before[changes.lost].sum())),
        int((changes.iou[paired] < MOVED_BELOW).sum()),
        *(int((change >= CHANGED_BY).sum()), int((change <= -CHANGED_BY).sum())),
        *(float(changes.before.weights[before].sum()), float(changes.after.weights[after].sum())),
    )
    return dict(zip(COLUMNS, values, strict=True))


def _listed(
    changes: LabelChanges, before: LabelColumns, after: LabelColumns, count: int
) -> list[ChangedLabel]:
    """The most changed labels."""
    found = []
    for old, new in changes.largest(count)[0].tolist():
        side, row = (after, new) if new >= 0 else (before, old)
        pair = changes.iou[changes.pairs[:, 0] == old] if old >= 0 and new >= 0 else np.zeros(0)
        overlap = float(pair[0]) if len(pair) else None
        found.append(
            ChangedLabel(
                _kind(new, overlap),
                side.frame_names[side.frames[row]],
                side.category_names[side.categories[row]],
                int(before.k[old]) if old >= 0 else None,
                int(after.k[new]) if new >= 0 else None,
                overlap,
                float(before.weights[old]) if old >= 0 else 0.0,
                float(after.weights[new]) if new >= 0 else 0.0,
            )
        )
    return found


def _kind(new: int, overlap: float | None) -> str:
    if overlap is None:
        return "lost" if new < 0 else "gained"
    return "moved" if overlap < MOVED_BELOW else "weight"
