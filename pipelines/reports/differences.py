"""Compare a policy's labels of two rounds."""

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
"""A label has moved if the IoU of its boxes is below this, KITTI's IoU threshold for cars."""
CHANGED_BY = 0.05
"""A weight has changed if it differs by at least this."""


@dataclass(frozen=True)
class ChangedLabel:
    """A label with a changed weight.

    Attributes:
        change: gained, lost, moved or weight.
        frame: its frame.
        category: its category.
        k_before: k in the earlier round; None for a gained label.
        k_after: k in the later round; None for a lost label.
        iou: BEV IoU of both boxes; None for a gained or lost label.
        weight_before: weight in the earlier round; 0 for a gained label.
        weight_after: weight in the later round; 0 for a lost label.
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
    """The difference between two rounds.

    Attributes:
        rounds: numbers of the earlier and the later round.
        policy: the policy that gave the weights.
        categories: a row of `COLUMNS` per category, then a row of totals.
        labels: the labels with the largest change of weight, the largest first.
    """

    rounds: tuple[int, int]
    policy: str
    categories: tuple[dict[str, Any], ...]
    labels: tuple[ChangedLabel, ...]


def compare_rounds(
    workspace: Workspace, rounds: tuple[int, int], policy: str, listed: int
) -> Difference:
    """Return the difference between two rounds.

    Args:
        workspace: see `Workspace`.
        rounds: numbers of the earlier and the later round.
        policy: the policy that gave the weights.
        listed: number of changed labels to list.

    Raises:
        WorkspaceError: if the policy has weighted nothing in one of the rounds.
    """
    found = Comparison(listed)
    for before, after in read_blocks(workspace, rounds, policy):
        found.add(before, after)
    return found.finish(rounds, policy)


@dataclass
class Comparison:
    """Compare two rounds block by block.

    Attributes:
        listed: number of changed labels to keep.
        sums: the numbers of `COLUMNS` by category.
        labels: the labels with the largest change of weight so far, the largest first.
    """

    listed: int
    sums: dict[str, np.ndarray] = field(default_factory=dict)
    labels: list[ChangedLabel] = field(default_factory=list)

    def add(self, before: LabelColumns, after: LabelColumns) -> None:
        """Add a block with the labels of the same frames in both rounds."""
        changes = compare_labels(*as_rounds(before, after))
        names = tuple(dict.fromkeys((*before.category_names, *after.category_names)))
        for number, name in enumerate(names):
            self.sums[name] = self.sums.get(name, 0) + _sums(changes, number)
        found = [*self.labels, *_listed(changes, before, after, self.listed)]
        found.sort(key=lambda each: -abs(each.weight_after - each.weight_before))
        self.labels = found[: self.listed]

    def finish(self, rounds: tuple[int, int], policy: str) -> Difference:
        """Return the difference, with totals over all categories."""
        total = np.sum([*self.sums.values()], axis=0)
        rows = tuple(_row(name, sums) for name, sums in (self.sums | {"all": total}).items())
        return Difference(rounds, policy, rows, tuple(self.labels))


def _row(name: str, sums: np.ndarray) -> dict[str, Any]:
    """Return a row of `COLUMNS`: counts, then two sums of weights."""
    counts, weights = map(int, sums[:-2]), map(float, sums[-2:])
    return dict(zip(COLUMNS, (name, *counts, *weights), strict=True))


def _sums(changes: LabelChanges, category: int) -> np.ndarray:
    """Return (10,) float64 the numbers of `COLUMNS` for a category."""
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
    """Return the labels with the largest change of weight."""
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
