"""Changes of the labels from one round to the next: labels are matched one to one by BEV IoU.

Rounds cannot be joined by key, because label k of one round is not label k of the next. As in the
label memories of MS3D and ST3D, two labels are the same object if their boxes overlap.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from curate.detections import Columns
from curate.errors import ConfigError
from curate.geometry.overlap import overlapping_pairs
from curate.shapes import Float, Int


@dataclass(frozen=True)
class RoundLabels(Columns):
    """The n labels of a round with the weights of one policy.

    Attributes:
        frames: (n,) integer; a frame has the same number in both rounds.
        categories: (n,) integer; a category has the same number in both rounds.
        boxes: (n, 7) in the LiDAR frame.
        weights: (n,) in [0, 1].
    """

    frames: Int[np.ndarray, " n"]
    categories: Int[np.ndarray, " n"]
    boxes: Float[np.ndarray, "n 7"]
    weights: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class LabelChanges:
    """The labels of two rounds and the pairs that are the same object.

    Attributes:
        before: n labels of the earlier round.
        after: m labels of the later round.
        pairs: (p, 2) rows in `before` and in `after` of the same object.
        iou: (p,) BEV IoU of each pair.
    """

    before: RoundLabels
    after: RoundLabels
    pairs: Int[np.ndarray, "p 2"]
    iou: Float[np.ndarray, " p"]

    @cached_property
    def lost(self) -> Int[np.ndarray, " lost"]:
        """Rows of `before` without a match, ascending."""
        return np.setdiff1d(np.arange(len(self.before)), self.pairs[:, 0])

    @cached_property
    def gained(self) -> Int[np.ndarray, " gained"]:
        """Rows of `after` without a match, ascending."""
        return np.setdiff1d(np.arange(len(self.after)), self.pairs[:, 1])

    @cached_property
    def weight_change(self) -> Float[np.ndarray, " p"]:
        """(p,) weight after minus weight before of each pair."""
        change: np.ndarray = (
            self.after.weights[self.pairs[:, 1]] - self.before.weights[self.pairs[:, 0]]
        )
        return change

    def largest(self, count: int) -> tuple[Int[np.ndarray, "c 2"], Float[np.ndarray, " c"]]:
        """Return up to `count` labels with the largest change of weight.

        The weight of a lost label changes to 0, that of a gained label from 0.

        Returns:
            (c, 2) rows in `before` and `after`, -1 for none, and (c,) changes, the largest first.
            Labels without a change are not included.
        """
        rows = np.concatenate([
            self.pairs,
            np.stack([self.lost, np.full(len(self.lost), -1)], axis=1),
            np.stack([np.full(len(self.gained), -1), self.gained], axis=1),
        ])  # fmt: skip
        change = np.concatenate([
            self.weight_change, -self.before.weights[self.lost], self.after.weights[self.gained]
        ])  # fmt: skip
        first = np.argsort(-np.abs(change), kind="stable")[:count]
        first = first[change[first] != 0]
        return rows[first], change[first]


def compare_labels(
    before: RoundLabels, after: RoundLabels, minimum_iou: float = 0.1
) -> LabelChanges:
    """Match labels of the same frame and category, the pair with the largest BEV IoU first.

    Args:
        before: labels of the earlier round.
        after: labels of the later round.
        minimum_iou: pairs with a BEV IoU at or below this are different objects.

    Raises:
        ConfigError: if minimum_iou is not in [0, 1).
    """
    if not 0 <= minimum_iou < 1:
        raise ConfigError(f"diff: the minimum IoU must be in [0, 1), not {minimum_iou}")
    groups = np.concatenate([_groups(before), _groups(after)])
    names, group = np.unique(groups, return_inverse=True)
    of_before, of_after = group[: len(before)], group[len(before) :]
    order_before, starts_before = _by_group(of_before, len(names))
    order_after, starts_after = _by_group(of_after, len(names))
    row, column, iou, _ = overlapping_pairs(
        before.boxes[order_before], starts_before, after.boxes[order_after], starts_after
    )
    near = iou > minimum_iou
    row, column, iou = order_before[row[near]], order_after[column[near]], iou[near]
    first = np.lexsort([column, row, -iou])
    taken = _take(row[first], column[first], len(before), len(after))
    kept = first[taken]
    kept = kept[np.argsort(row[kept])]
    return LabelChanges(before, after, np.stack([row[kept], column[kept]], axis=1), iou[kept])


def _groups(labels: RoundLabels) -> np.ndarray:
    """Return (n,) one number per frame and category: the frame in the high bits."""
    number: np.ndarray = labels.frames.astype(np.int64) * 2**20 + labels.categories
    return number


def _by_group(group: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows sorted by group, and the start of each group."""
    starts = np.concatenate([[0], np.cumsum(np.bincount(group, minlength=groups))])
    return np.argsort(group, kind="stable"), starts


def _take(rows: np.ndarray, columns: np.ndarray, n: int, m: int) -> np.ndarray:
    """Return the indices of the pairs that get both their row and their column, in their order."""
    free_row, free_column = [True] * n, [True] * m
    taken = []
    for index, (row, column) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True)):
        if free_row[row] and free_column[column]:
            free_row[row] = free_column[column] = False
            taken.append(index)
    return np.array(taken, dtype=np.int64)
