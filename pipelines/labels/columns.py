"""Labels of rounds as aligned columns: all at once, or a block of frames at a time."""

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
from pipelines.labels.by_frame import check_weights, not_weighted_error
from pipelines.workspace.workspace import Workspace

_BLOCK_FRAMES = 1000
# SQLite looks up this many frames one by one; with more it would scan the whole round.
_FRAMES_PER_QUERY = 8


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
        found = _read(workspace, connection, round_number, policy)
    if not len(found):
        raise not_weighted_error(round_number, policy)
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
    """Yield the labels of some rounds in blocks of frames; a block has the same frames of each.

    The frames are in the order of their names. Only the labels of a thousand frames per round are
    in memory at a time.

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
            raise not_weighted_error(each, policy)


def _read(
    workspace: Workspace,
    connection: Connection,
    round_number: int,
    policy: str,
    frames: Sequence[str] | None = None,
) -> LabelColumns:
    """Return the labels of a round, of all frames or of those with the given names."""
    view = weighted_labels(connection).c
    kinds: dict[str, Any] = {"frame": Text(), "k": Integer(), "category": Text()}
    kinds |= dict.fromkeys((*BOX_COLUMNS, *numeric_columns(connection)), Float())
    # Without ORDER BY: to sort millions of rows, the database would write them to the disk.
    columns = [type_coerce(view[name], kind).label(name) for name, kind in kinds.items()]
    query: Select[Any] = select(*columns)
    query = query.where(view.round == round_number, view.policy == policy)
    queries = [query]
    if frames is not None:
        batches = batched(frames, _FRAMES_PER_QUERY)
        queries = [query.where(view.frame.in_(batch)) for batch in batches]
    parts = [bulk.select_columns(connection, each) for each in queries]
    found = {name: np.concatenate([part[name] for part in parts]) for name in kinds}
    return ordered(found, workspace.config.dataset.categories)


def ordered(found: dict[str, np.ndarray], categories: tuple[str, ...]) -> LabelColumns:
    """Return columns sorted by frame name and k.

    Args:
        found: (n,) columns by name, in any order: frame, k, category, the box, further numbers.
        categories: the configured categories, which are numbered first.
    """
    names, frames = np.unique(found["frame"], return_inverse=True)
    order = np.lexsort([found["k"], frames])
    present, inverse = np.unique(found["category"], return_inverse=True)
    categories = tuple(dict.fromkeys((*categories, *present.tolist())))
    number = np.array([categories.index(name) for name in present], dtype=np.int64)
    keys = ("frame", "k", "category", *BOX_COLUMNS)
    return LabelColumns(
        names.tolist(),
        frames[order],
        found["k"][order],
        number[inverse[order]],
        categories,
        np.stack([found[name][order] for name in BOX_COLUMNS], axis=1),
        {name: values[order] for name, values in found.items() if name not in keys},
    )


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
