"""The labels of rounds as aligned columns, all at once or a block of frames at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, Float, Integer, Select, Text, select, type_coerce

from curate.evaluation.label_changes import RoundLabels
from curate.files.batches import batched
from db import bulk
from db.evidence import weighted_label_columns
from db.models import BOX_COLUMNS
from db.views import weighted_labels
from pipelines.labels.by_frame import check_weights, unweighted
from pipelines.workspace.workspace import Workspace

_BLOCK_FRAMES = 1000
# SQLite looks so few frames up one by one; for more it would walk through the whole round.
_ASKED_FRAMES = 8


@dataclass(frozen=True)
class LabelColumns:
    """The n labels of a round with the weights of one policy, by frame and k.

    Attributes:
        frame_names: name of each frame that has labels.
        frames: (n,) int64 place in `frame_names`.
        k: (n,) int64.
        categories: (n,) int64 place in `category_names`.
        category_names: those of the configuration.
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
        """(n,) in [0, 1]."""
        return self.numbers["weight"]


def numeric_columns(connection: Connection) -> list[str]:
    """Return the numeric columns of `weighted_labels` beside the keys and the box."""
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
        found = _read(workspace, connection, round_number, policy)
    if not len(found):
        raise unweighted(round_number, policy)
    return found


def read_frame_columns(
    workspace: Workspace, round_number: int, policy: str, frame: str
) -> LabelColumns:
    """Return the labels of one frame; there may be none."""
    with workspace.database.reading() as connection:
        return _read(workspace, connection, round_number, policy, [frame])


def read_blocks(
    workspace: Workspace, rounds: Sequence[int], policy: str
) -> Iterator[tuple[LabelColumns, ...]]:
    """The labels of some rounds, the same frames of each at a time, in the order of their names.

    So much of millions of labels is in memory as a thousand frames hold.

    Raises:
        WorkspaceError: if the policy has weighted nothing in one of the rounds.
        DataError: if a weight is not in [0, 1].
    """
    frame = bulk.table("frame").c.frame
    labels = dict.fromkeys(rounds, 0)
    with workspace.database.reading() as connection:
        for each in labels:
            check_weights(connection, each, policy)
        names = sorted(row[0] for row in bulk.select(connection, select(frame)))
        for block in batched(names, _BLOCK_FRAMES):
            found = {each: _read(workspace, connection, each, policy, block) for each in labels}
            labels = {each: count + len(found[each]) for each, count in labels.items()}
            yield tuple(found[each] for each in rounds)
    for each, count in labels.items():
        if not count:
            raise unweighted(each, policy)


def _read(
    workspace: Workspace,
    connection: Connection,
    round_number: int,
    policy: str,
    wanted: Sequence[str] | None = None,
) -> LabelColumns:
    """Return the labels of a round, of all frames or of the wanted ones."""
    view = weighted_labels(connection).c
    kinds: dict[str, Any] = {"frame": Text(), "k": Integer(), "category": Text()}
    kinds |= dict.fromkeys((*BOX_COLUMNS, *numeric_columns(connection)), Float())
    # Not ordered: the database would write millions of whole rows to its disk to sort them.
    columns = [type_coerce(view[name], kind).label(name) for name, kind in kinds.items()]
    query: Select[Any] = select(*columns)
    query = query.where(view.round == round_number, view.policy == policy)
    queries = [query]
    if wanted is not None:
        queries = [query.where(view.frame.in_(part)) for part in batched(wanted, _ASKED_FRAMES)]
    parts = [bulk.select_columns(connection, each) for each in queries]
    found = {name: np.concatenate([part[name] for part in parts]) for name in kinds}
    return ordered(found, workspace.config.dataset.categories)


def ordered(found: dict[str, np.ndarray], categories: tuple[str, ...]) -> LabelColumns:
    """Return (n,) columns by frame and k, whatever the order in which the database gave them.

    Args:
        found: frame, k, category, the box and further numbers by name.
        categories: that come first in the numbering.
    """
    names, frames = np.unique(found["frame"], return_inverse=True)
    order = np.lexsort([found["k"], frames])
    present, own = np.unique(found["category"], return_inverse=True)
    categories = tuple(dict.fromkeys((*categories, *present.tolist())))
    number = np.array([categories.index(name) for name in present], dtype=np.int64)
    keys = ("frame", "k", "category", *BOX_COLUMNS)
    return LabelColumns(
        names.tolist(),
        frames[order],
        found["k"][order],
        number[own[order]],
        categories,
        np.stack([found[name][order] for name in BOX_COLUMNS], axis=1),
        {name: values[order] for name, values in found.items() if name not in keys},
    )


def as_rounds(before: LabelColumns, after: LabelColumns) -> tuple[RoundLabels, RoundLabels]:
    """Both rounds with one numbering of frames and categories."""
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
