"""All labels of a round as aligned columns, for figures over millions of them."""

from dataclasses import dataclass

import numpy as np
from sqlalchemy import select

from curate.errors import WorkspaceError
from curate.label_changes import RoundLabels
from db.models import BOX_COLUMNS
from db.views import WEIGHTED_LABELS
from pipelines.workspace import Workspace

NUMBERS = ("score", "loss", "points", "rho_diff", "rho_anno", "rho_det", "lambda_u", "weight")
_CHUNK = 50_000


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


def read_columns(workspace: Workspace, round_number: int, policy: str) -> LabelColumns:
    """The labels of a round, read in chunks.

    Raises:
        WorkspaceError: the policy has weighted nothing in that round.
    """
    labels = WEIGHTED_LABELS.c
    values = (*BOX_COLUMNS, *NUMBERS)
    # Not ordered: the database would write millions of whole rows to its disk to sort them.
    query = select(
        labels.frame, labels.k, labels.category, *(labels[name] for name in values)
    ).where(labels.round == round_number, labels.policy == policy)
    frames: dict[str, int] = {}
    categories = {name: i for i, name in enumerate(workspace.config.dataset.categories)}
    keys, tables = [np.zeros((0, 3), np.int64)], [np.zeros((0, len(values)))]
    with workspace.database.reading() as connection:
        result = connection.execution_options(stream_results=True).execute(query)
        for rows in result.partitions(_CHUNK):
            names, numbers, kinds, *columns = zip(*rows, strict=True)
            places = [frames.setdefault(name, len(frames)) for name in names]
            own = [categories.setdefault(name, len(categories)) for name in kinds]
            keys.append(np.array([places, numbers, own], dtype=np.int64).T)
            tables.append(np.array(columns, dtype=np.float64).T)
    key, table = _joined(keys), _joined(tables)
    if not len(key):
        raise WorkspaceError(
            f"round {round_number} has no labels weighted by {policy}; "
            f"run `curate solve --round {round_number} --policy {policy}`"
        )
    return _ordered(list(frames), tuple(categories), key, table)


def _joined(chunks: list[np.ndarray]) -> np.ndarray:
    """All chunks below each other; each is let go as soon as it is copied."""
    end = sum(map(len, chunks))
    whole = np.empty((end, chunks[0].shape[1]), chunks[0].dtype)
    while chunks:
        chunk = chunks.pop()
        whole[end - len(chunk) : end] = chunk
        end -= len(chunk)
    return whole


def _ordered(
    names: list[str], categories: tuple[str, ...], key: np.ndarray, table: np.ndarray
) -> LabelColumns:
    """The columns by frame and k, whatever the order in which the database gave them."""
    rank = np.empty(len(names), np.int64)
    rank[np.argsort(np.array(names), kind="stable")] = np.arange(len(names))
    frames = rank[key[:, 0]]
    order = np.lexsort([key[:, 1], frames])
    if (order[1:] < order[:-1]).any():
        frames, key, table = frames[order], key[order], table[order]
    numbers = {name: table[:, 7 + i] for i, name in enumerate(NUMBERS)}
    return LabelColumns(
        sorted(names), frames, key[:, 1], key[:, 2], categories, table[:, :7], numbers
    )


def as_rounds(before: LabelColumns, after: LabelColumns) -> tuple[RoundLabels, RoundLabels]:
    """Both rounds with one numbering of frames and categories."""
    frames = {name: i for i, name in enumerate(before.frame_names)}
    categories = {name: i for i, name in enumerate(before.category_names)}
    frame = np.array([frames.setdefault(name, len(frames)) for name in after.frame_names])
    category = [categories.setdefault(name, len(categories)) for name in after.category_names]
    return (
        RoundLabels(before.frames, before.categories, before.boxes, before.weights),
        RoundLabels(
            frame[after.frames], np.array(category)[after.categories], after.boxes, after.weights
        ),
    )
