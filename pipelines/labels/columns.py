"""The labels of rounds as aligned columns, all at once or a block of frames at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from sqlalchemy import Connection, select

from curate.evaluation.label_changes import RoundLabels
from curate.files.batches import batched
from db import bulk
from db.evidence import weighted_label_columns
from db.models import BOX_COLUMNS
from db.views import weighted_labels
from pipelines.labels.by_frame import check_weights, unweighted
from pipelines.workspace.workspace import Workspace

_CHUNK = 50_000
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
    """All labels of a round.

    Raises:
        WorkspaceError: the policy has weighted nothing in that round.
        DataError: a weight is not in [0, 1].
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
    """The labels of one frame; there may be none."""
    with workspace.database.reading() as connection:
        return _read(workspace, connection, round_number, policy, [frame])


def read_blocks(
    workspace: Workspace, rounds: Sequence[int], policy: str
) -> Iterator[tuple[LabelColumns, ...]]:
    """The labels of some rounds, the same frames of each at a time, in the order of their names.

    So much of millions of labels is in memory as a thousand frames hold.

    Raises:
        WorkspaceError: the policy has weighted nothing in one of the rounds.
        DataError: a weight is not in [0, 1].
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
    """The labels of a round, of all frames or of the wanted ones."""
    view = weighted_labels(connection)
    labels, numbers = view.c, numeric_columns(connection)
    values = (*BOX_COLUMNS, *numbers)
    # Not ordered: the database would write millions of whole rows to its disk to sort them.
    query = select(
        labels.frame, labels.k, labels.category, *(labels[name] for name in values)
    ).where(labels.round == round_number, labels.policy == policy)
    queries = [query]
    if wanted is not None:
        parts = batched(wanted, _ASKED_FRAMES)
        queries = [query.where(labels.frame.in_(part)) for part in parts]
    frames: dict[str, int] = {}
    categories = {name: i for i, name in enumerate(workspace.config.dataset.categories)}
    keys, tables = [np.zeros((0, 3), np.int64)], [np.zeros((0, len(values)))]
    streaming = connection.execution_options(stream_results=True)
    for rows in chain.from_iterable(streaming.execute(each).partitions(_CHUNK) for each in queries):
        names, places_in_frame, kinds, *columns = zip(*rows, strict=True)
        places = [frames.setdefault(name, len(frames)) for name in names]
        own = [categories.setdefault(name, len(categories)) for name in kinds]
        keys.append(np.array([places, places_in_frame, own], dtype=np.int64).T)
        tables.append(np.array(columns, dtype=np.float64).T)
    return ordered(list(frames), tuple(categories), joined(keys), joined(tables), numbers)


def joined(chunks: list[np.ndarray]) -> np.ndarray:
    """All chunks below each other; each is let go as soon as it is copied."""
    end = sum(map(len, chunks))
    whole = np.empty((end, chunks[0].shape[1]), chunks[0].dtype)
    while chunks:
        chunk = chunks.pop()
        whole[end - len(chunk) : end] = chunk
        end -= len(chunk)
    return whole


def ordered(
    names: list[str],
    categories: tuple[str, ...],
    key: np.ndarray,
    table: np.ndarray,
    columns: Sequence[str],
) -> LabelColumns:
    """The columns by frame and k, whatever the order in which the database gave them."""
    rank = np.empty(len(names), np.int64)
    rank[np.argsort(np.array(names), kind="stable")] = np.arange(len(names))
    frames = rank[key[:, 0]]
    order = np.lexsort([key[:, 1], frames])
    if (order[1:] < order[:-1]).any():
        frames, key, table = frames[order], key[order], table[order]
    numbers = {name: table[:, 7 + i] for i, name in enumerate(columns)}
    return LabelColumns(
        sorted(names), frames, key[:, 1], key[:, 2], categories, table[:, :7], numbers
    )


def as_rounds(before: LabelColumns, after: LabelColumns) -> tuple[RoundLabels, RoundLabels]:
    """Both rounds with one numbering of frames and categories."""
    frames = {name: i for i, name in enumerate(before.frame_names)}
    categories = {name: i for i, name in enumerate(before.category_names)}
    frame = np.array(
        [frames.setdefault(name, len(frames)) for name in after.frame_names], dtype=np.int64
    )
    category = [categories.setdefault(name, len(categories)) for name in after.category_names]
    return (
        RoundLabels(before.frames, before.categories, before.boxes, before.weights),
        RoundLabels(
            frame[after.frames], np.array(category)[after.categories], after.boxes, after.weights
        ),
    )
