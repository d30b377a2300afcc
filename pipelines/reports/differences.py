"""What became of a policy's labels from one round to another."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from curate.evaluation.label_changes import LabelChanges, compare_labels
from pipelines.labels.columns import LabelColumns, as_rounds, read_blocks
from pipelines.workspace.workspace import Workspace

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
    """Return the difference.

    Args:
        workspace: see `Workspace`.
        rounds: earlier and later.
        policy: whose weights.
        listed: how many changed labels to list.

    Raises:
        WorkspaceError: if the policy has weighted nothing in one of the rounds.
    """
    found = Comparison(listed)
    for before, after in read_blocks(workspace, rounds, policy):
        found.add(before, after)
    return found.finish(rounds, policy)


@dataclass
class Comparison:
    """Two rounds compared a block of frames at a time.

    Attributes:
        listed: how many changed labels are kept.
        sums: the numbers of `COLUMNS` of each category.
        labels: those whose weight changed most so far, the largest change first.
    """

    listed: int
    sums: dict[str, np.ndarray] = field(default_factory=dict)
    labels: list[ChangedLabel] = field(default_factory=list)

    def add(self, before: LabelColumns, after: LabelColumns) -> None:
        """The labels of the same frames in both rounds more."""
        changes = compare_labels(*as_rounds(before, after))
        names = tuple(dict.fromkeys((*before.category_names, *after.category_names)))
        for number, name in enumerate(names):
            self.sums[name] = self.sums.get(name, 0) + _sums(changes, number)
        found = [*self.labels, *_listed(changes, before, after, self.listed)]
        found.sort(key=lambda each: -abs(each.weight_after - each.weight_before))
        self.labels = found[: self.listed]

    def finish(self, rounds: tuple[int, int], policy: str) -> Difference:
        """Return the difference, with the sums over all categories."""
        everything = np.sum([*self.sums.values()], axis=0)
        rows = tuple(_row(name, sums) for name, sums in (self.sums | {"all": everything}).items())
        return Difference(rounds, policy, rows, tuple(self.labels))


def _row(name: str, sums: np.ndarray) -> dict[str, Any]:
    """Return a row of `COLUMNS`: counts, then two sums of weights."""
    counts, weights = map(int, sums[:-2]), map(float, sums[-2:])
    return dict(zip(COLUMNS, (name, *counts, *weights), strict=True))


def _sums(changes: LabelChanges, category: int) -> np.ndarray:
    """(10,) float64 what `COLUMNS` say of a category."""
    before, after = (side.categories == category for side in (changes.before, changes.after))
    paired = before[changes.pairs[:, 0]]
    change = changes.weight_change[paired]
    values = (
        *(before.sum(), after.sum(), paired.sum()),
        *(after[changes.gained].sum(), before[changes.lost].sum()),
        (changes.iou[paired] < MOVED_BELOW).sum(),
        *((change >= CHANGED_BY).sum(), (change <= -CHANGED_BY).sum()),
        *(changes.before.weights[before].sum(), changes.after.weights[after].sum()),
    )
    return np.array(values, dtype=np.float64)


def _listed(
    changes: LabelChanges, before: LabelColumns, after: LabelColumns, count: int
) -> list[ChangedLabel]:
    """Return the most changed labels."""
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
