"""The rows of `weighted_labels` for one round and policy, in the order of frame name and k.

The view answers any query, but to read all of its rows it sorts them by the name of their frame.
Here the frames are sorted instead, and their rows are read from the tables behind the view, some
hundred frames at a time:

    frames by name   000003  000007  000009 | 000010 ...     a block of frames
    query            weight JOIN prediction ... WHERE frame_id IN (1, 2, 3) ORDER BY frame_id, k

The few frames that people decided about are read from the view, which knows what a decision
changes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Any

from sqlalchemy import Connection, Select, column, exists, select

from curate.files.batches import batched
from db import bulk
from db.views import undecided_labels, weighted_labels

_BLOCK_FRAMES = 256
# SQLite looks up this many frames of the view one by one; with more it would scan the whole round.
_FRAMES_PER_QUERY = 8


@dataclass(frozen=True)
class StoredRows:
    """The weighted labels of a round and policy in the database.

    Attributes:
        connection: connection to the database.
        round_number: number e of the round.
        policy: policy that weighted the labels.
    """

    connection: Connection
    round_number: int
    policy: str

    def frames(self) -> list[str]:
        """Return the sorted names of the frames with labels."""
        weight, frame = bulk.table("weight").c, bulk.table("frame").c
        own = (weight.round == self.round_number, weight.policy == self.policy)
        query = select(frame.frame).where(
            frame.split == "unlabeled", exists().where(weight.frame_id == frame.id, *own)
        )
        undecided = {name for (name,) in bulk.select(self.connection, query)}
        undecided.difference_update(self._names[key] for key in self._decided)
        rows = self._of_decided(["frame"], sorted(self._decided))
        return sorted(undecided | {name for (name,) in rows})

    def blocks(
        self,
        names: Sequence[str],
        frames: Sequence[str] | None = None,
        size: int = _BLOCK_FRAMES,
    ) -> Iterator[list[bulk.Row]]:
        """Yield the rows of blocks of frames, sorted by frame name and k; a block may be empty.

        Args:
            names: the columns to read.
            frames: names of the frames, sorted; None for all.
            size: number of frames of a block.
        """
        chosen = None if frames is None else set(frames)
        keys = sorted(self._names, key=self._names.__getitem__)
        if chosen is not None:
            keys = [key for key in keys if self._names[key] in chosen]
        columns = [*names, *(name for name in ("frame", "k") if name not in names)]
        by_frame = itemgetter(columns.index("frame"), columns.index("k"))
        query = undecided_labels(self.connection, columns)
        parameters = {"round": self.round_number, "policy": self.policy}
        for block in batched(keys, size):
            decided = [key for key in block if key in self._decided]
            undecided = [key for key in block if key not in self._decided]
            rows: list[bulk.Row] = []
            if undecided:
                bound = query.bindparams(**parameters, frames=undecided)
                rows = list(bulk.select(self.connection, bound))
            if decided:
                rows += self._of_decided(columns, decided)
            if decided or undecided != sorted(undecided):
                rows.sort(key=by_frame)
            yield rows if len(columns) == len(names) else [row[: len(names)] for row in rows]

    def _of_decided(self, columns: Sequence[str], keys: Sequence[int]) -> list[bulk.Row]:
        """Return the rows of some frames that people decided about, from the view."""
        view = weighted_labels(self.connection)
        query: Select[Any] = select(*map(column, columns))  # type: ignore[assignment]
        query = query.select_from(view).where(
            view.c.round == self.round_number, view.c.policy == self.policy
        )
        rows: list[bulk.Row] = []
        for batch in batched(keys, _FRAMES_PER_QUERY):
            of_batch = view.c.frame.in_([self._names[key] for key in batch])
            rows += bulk.select(self.connection, query.where(of_batch))
        return rows

    @cached_property
    def _names(self) -> dict[int, str]:
        """The names of the unlabeled frames by key, sorted by name."""
        frame = bulk.table("frame").c
        query = select(frame.id, frame.frame).where(frame.split == "unlabeled")
        rows = sorted(bulk.select(self.connection, query), key=itemgetter(1))
        return dict(rows)

    @cached_property
    def _decided(self) -> set[int]:
        """The keys of the unlabeled frames that people decided about."""
        label = bulk.table("human_label").c
        rows = bulk.select(self.connection, select(label.frame_id).distinct())
        return {key for (key,) in rows if key in self._names}
