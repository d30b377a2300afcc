"""Labels of rounds as aligned columns: all at once, or a block of frames at a time."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from sqlalchemy import Connection

from curate.evaluation.label_changes import RoundLabels
from db import bulk
from db.evidence import weighted_label_columns
from db.models import BOX_COLUMNS
from pipelines.labels.by_frame import check_weights, not_weighted_error
from pipelines.labels.stored_rows import StoredRows
from pipelines.workspace.workspace import Workspace

_BLOCK_FRAMES = 1000


@dataclass(frozen=True)
class LabelColumns:
    """The n labels of a round with the weights of one policy, sorted by frame name and k.

    Attributes:
        frame_names: sorted names of the frames with labels.
        frames: (n,) int64 index into `frame_names`.
        k: (n,) int64 number of the label within its frame.
        categories: (n,) int64 index into `category_names`.
        category_names: the configured categories, then others that occur.
        boxes: (n, 7) in the LiDAR frame.
        numbers: (n,) float64 columns of `weighted_labels` by name; NaN for null.
    """

    frame_names: list[str]
    frames: np.ndarray
    k: np.ndarray
    categories: np.ndarray
    category_names: tuple[str, ...]
    boxes: np.ndarray
    numbers: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def weights(self) -> np.ndarray:
        """(n,) weights in [0, 1]."""
        return self.numbers["weight"]


def numeric_columns(connection: Connection) -> list[str]:
    """Return the names of the numeric columns of `weighted_labels` without keys and box."""
    return [
        column.name
        for column in weighted_label_columns(connection)
        if column.kind != "name" and column.name not in ("round", "k", *BOX_COLUMNS)
    ]


def read_columns(workspace: Workspace, round_number: int, policy: str) -> LabelColumns:
    """Return all labels of a round.

    Raises:
        WorkspaceError: if the policy has weighted nothing in that round.
        DataError: if a weight is not in [0, 1].
    """
    with workspace.database.reading() as connection:
        check_weights(connection, round_number, policy)
        found = _read(workspace, StoredRows(connection, round_number, policy))
    if not len(found):
        raise not_weighted_error(round_number, policy)
    return found


def read_frame_columns(
    workspace: Workspace, round_number: int, policy: str, frame: str
) -> LabelColumns:
    """Return the labels of one frame; there may be none."""
    with workspace.database.reading() as connection:
        return _read(workspace, StoredRows(connection, round_number, policy), [frame])


def read_blocks(
    workspace: Workspace, rounds: Sequence[int], policy: str
) -> Iterator[tuple[LabelColumns, ...]]:
    """Yield the labels of some rounds in blocks of frames; a block has the same frames of each.

    The frames are in the order of their names. Only the labels of a thousand frames per round are
    in memory at a time.

    Raises:
        WorkspaceError: if the policy has weighted nothing in one of the rounds.
        DataError: if a weight is not in [0, 1].
    """
    labels = dict.fromkeys(rounds, 0)
    with workspace.database.reading() as connection:
        for each in labels:
            check_weights(connection, each, policy)
        kinds = _kinds(connection)
        stored = [StoredRows(connection, each, policy) for each in labels]
        for block in zip(
            *(each.blocks(tuple(kinds), size=_BLOCK_FRAMES) for each in stored), strict=True
        ):
            found = {
                each: ordered(_columns(kinds, [rows]), workspace.config.dataset.categories)
                for each, rows in zip(labels, block, strict=True)
            }
            labels = {each: count + len(found[each]) for each, count in labels.items()}
            yield tuple(found[each] for each in rounds)
    for each, count in labels.items():
        if not count:
            raise not_weighted_error(each, policy)


def _read(
    workspace: Workspace, stored: StoredRows, frames: Sequence[str] | None = None
) -> LabelColumns:
    """Return the labels of a round, of all frames or of those with the given names."""
    kinds = _kinds(stored.connection)
    found = _columns(kinds, stored.blocks(tuple(kinds), frames))
    return ordered(found, workspace.config.dataset.categories)


def _kinds(connection: Connection) -> Mapping[str, type]:
    """Return the columns to read, and the type of their values."""
    texts = {"frame": str, "k": int, "category": str}
    return texts | dict.fromkeys((*BOX_COLUMNS, *numeric_columns(connection)), float)


def _columns(kinds: Mapping[str, type], blocks: Iterable[list[bulk.Row]]) -> dict[str, Any]:
    """Return rows as columns: lists of text, and arrays of numbers with NaN for null."""
    found: dict[str, Any] = {name: [] for name in kinds}
    for rows in blocks:
        for (name, kind), values in zip(kinds.items(), zip(*rows, strict=True), strict=False):
            found[name].append(values if kind is str else np.array(values, dtype=kind))
    for name, kind in kinds.items():
        parts = found[name]
        if kind is str:
            found[name] = list(chain.from_iterable(parts))
        else:
            found[name] = np.concatenate([np.zeros(0, kind), *parts])
    return found


def ordered(found: Mapping[str, Any], categories: tuple[str, ...]) -> LabelColumns:
    """Return columns sorted by frame name and k.

    Args:
        found: columns of n values by name, in any order: frame and category (lists of str), k, the
            box, further numbers (arrays).
        categories: the configured categories, which are numbered first.
    """
    names = sorted(set(found["frame"]))
    categories = tuple(dict.fromkeys((*categories, *sorted(set(found["category"])))))
    frames = _numbers(found["frame"], names)
    order = np.lexsort([found["k"], frames])
    keys = ("frame", "k", "category", *BOX_COLUMNS)
    return LabelColumns(
        names,
        frames[order],
        found["k"][order],
        _numbers(found["category"], categories)[order],
        categories,
        np.stack([found[name][order] for name in BOX_COLUMNS], axis=1),
        {name: values[order] for name, values in found.items() if name not in keys},
    )


def _numbers(values: Sequence[str], names: Sequence[str]) -> np.ndarray:
    """Return (n,) int64 the index of each value among the names."""
    place = {name: number for number, name in enumerate(names)}
    return np.fromiter(map(place.__getitem__, values), np.int64, len(values))


def as_rounds(before: LabelColumns, after: LabelColumns) -> tuple[RoundLabels, RoundLabels]:
    """Return both rounds with a common numbering of frames and categories."""
    frames = np.union1d(np.array(before.frame_names, str), np.array(after.frame_names, str))
    names = tuple(dict.fromkeys((*before.category_names, *after.category_names)))
    one, other = (
        RoundLabels(
            np.searchsorted(frames, np.array(each.frame_names, str))[each.frames],
            np.array([names.index(name) for name in each.category_names])[each.categories],
            each.boxes,
            each.weights,
        )
        for each in (before, after)
    )
    return one, other
