"""The content of the page of a frame: image, labels, neighbouring frames, other weights."""

import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Table, and_, select

from curate.errors import ConfigError
from curate.priors.base import Column
from curate.viewing.canvas import jpeg
from db import bulk
from db.evidence import OWN_TABLES, PROBABILITY, evidence_table, label_columns, read_declarations
from db.labels import label_box, with_fused_boxes
from db.models import BOX_COLUMNS
from pipelines.labels.by_frame import chosen_round
from pipelines.labels.human_labels import DecidedLabels, decided_labels
from pipelines.reports.pictures import frame_picture
from pipelines.workspace.workspace import Workspace

_KEPT_PICTURES = 24


@dataclass(frozen=True)
class ShownFrame:
    """A frame in a round under a policy.

    Attributes:
        name: of the frame.
        split: of the frame.
        round: number.
        policy: policy of the weights.
        columns: names of the columns of the labels.
        labels: a row per label, as in `weighted_labels`: objects of people replace predictions.
        decisions: what a person decided about a label, by k.
        choices: (round, policy) of all weights that the frame has.
        before: the previous frame of the same split; None at the start.
        after: the next frame of the same split; None at the end.
    """

    name: str
    split: str
    round: int
    policy: str
    columns: tuple[str, ...]
    labels: tuple[tuple[Any, ...], ...]
    decisions: Mapping[int, str]
    choices: tuple[tuple[int, str], ...]
    before: str | None
    after: str | None


class FramePages:
    """Frames of a workspace with their images; nothing is written.

    Images are drawn one at a time, and the last ones are kept in memory.

    Args:
        workspace: see `Workspace`.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._pictures: OrderedDict[tuple[Any, ...], bytes] = OrderedDict()
        self._drawing = threading.Lock()

    def find(
        self, name: str | None, key: int | None, round_number: int | None, policy: str | None
    ) -> ShownFrame:
        """Return a frame by name or by key.

        Args:
            name: None if the key is given.
            key: frame.id; None if the name is given.
            round_number: None for the last with predictions.
            policy: None for the configured one.

        Raises:
            ConfigError: if the frame is unknown, or has no weights of the policy in the round.
            WorkspaceError: if no round has predictions yet.
        """
        number = chosen_round(self._workspace, round_number)
        policy = policy or self._workspace.config.run.method
        found, name, split = self._key(name, key)
        choices = self._choices(found)
        if choices and (number, policy) not in choices:
            raise ConfigError(f"frame {name} has no weights by {policy} in round {number}")
        before, after = (self._neighbour(name, split, step) for step in (-1, 1))
        decided = decided_labels(self._workspace, number, found)
        columns, labels = self._labels(found, number, policy)
        columns, labels = _with_decisions(columns, labels, decided)
        return ShownFrame(
            name, split, number, policy, columns, labels, decided.by_k, choices, before, after
        )

    def picture(self, shown: ShownFrame) -> bytes:
        """Return the image of a frame as JPEG."""
        drawn = (shown.name, shown.round, shown.policy)
        key = (*drawn, shown.labels)  # new weights and decisions are drawn again
        with self._drawing:
            if key not in self._pictures:
                self._pictures[key] = jpeg(frame_picture(self._workspace, *drawn), quality=88)
            self._pictures.move_to_end(key)
            if len(self._pictures) > _KEPT_PICTURES:
                self._pictures.popitem(last=False)
            return self._pictures[key]

    def explanation(self, shown: ShownFrame, k: int) -> str:
        """Return the output of `curate explain` for a label.

        Raises:
            WorkspaceError: if the policy has not weighted it.
        """
        from pipelines.reports.explanation import explain_label

        found = explain_label(self._workspace, shown.name, k, shown.round, shown.policy)
        return found.as_text()

    def _key(self, name: str | None, key: int | None) -> tuple[int, str, str]:
        frame = bulk.table("frame")
        here = frame.c.id == key if name is None else frame.c.frame == name
        query = select(frame.c.id, frame.c.frame, frame.c.split).where(here)
        rows = self._execute(query)
        if not rows:
            raise ConfigError(f"no frame {key if name is None else repr(name)} in this workspace")
        return rows[0][0], rows[0][1], rows[0][2]

    def _choices(self, key: int) -> tuple[tuple[int, str], ...]:
        weight, number = bulk.table("weight"), bulk.table("round").c.number
        # The round is in the condition because the key of `weight` starts with it.
        query = (
            select(weight.c.round, weight.c.policy)
            .where(weight.c.round.in_(select(number)), weight.c.frame_id == key)
            .distinct()
            .order_by(weight.c.round, weight.c.policy)
        )
        return tuple((int(row[0]), str(row[1])) for row in self._execute(query))

    def _neighbour(self, name: str, split: str, step: int) -> str | None:
        frame = bulk.table("frame").c.frame
        beyond, order = (frame > name, frame) if step > 0 else (frame < name, frame.desc())
        query = select(frame).where(beyond, bulk.table("frame").c.split == split)
        rows = self._execute(query.order_by(order).limit(1))
        return str(rows[0][0]) if rows else None

    def _labels(
        self, key: int, number: int, policy: str
    ) -> tuple[tuple[str, ...], tuple[bulk.Row, ...]]:
        """Return the columns and the rows of the labels of a frame, of whatever split."""
        prediction, weight = bulk.table("prediction"), bulk.table("weight")
        with self._workspace.database.reading() as connection:
            declared = read_declarations(connection)
        stored = [name for name in OWN_TABLES.values() if name != weight.name]
        tables = [bulk.table(name) for name in ("consistency", *stored)]
        tables += [evidence_table(each) for each in declared if each.name not in OWN_TABLES]
        evidence = [
            column.name for column in label_columns(declared) if _is_evidence(column, tables)
        ]
        estimated = [column.name for column in PROBABILITY.columns if PROBABILITY in declared]
        weighted = ("rho_det", "lambda_u", *estimated, "v")
        names = ("k", "category", "x", "y", "score", *evidence, *weighted)
        joined: Any = with_fused_boxes(prediction)
        columns = {**prediction.c, **label_box()}
        for table in (*tables, weight):
            same_label = [
                table.c[name] == prediction.c[name] for name in ("round", "frame_id", "k")
            ]
            of_policy = [weight.c.policy == policy] if table is weight else []
            joined = joined.outerjoin(table, and_(*same_label, *of_policy))
            columns = {**table.c, **columns}
        query = (
            select(*(columns[name] for name in names))
            .select_from(joined)
            .where(prediction.c.round == number, prediction.c.frame_id == key)
            .order_by(prediction.c.k)
        )
        return names, tuple(self._execute(query))

    def _execute(self, query: Any) -> list[bulk.Row]:
        return list(self._workspace.database.rows(query))


def _with_decisions(
    names: tuple[str, ...], rows: Sequence[bulk.Row], decided: DecidedLabels
) -> tuple[tuple[str, ...], tuple[tuple[Any, ...], ...]]:
    """Return columns and rows with the decisions of people, in a column `decision` if any."""
    if not decided.by_k:
        return names, tuple(tuple(row) for row in rows)
    found = [dict(zip(names, row, strict=True)) for row in rows if row[0] not in decided.replaced]
    for label in found:
        if label["k"] in decided.rejected:
            label["v"] = 0.0
    for each in decided.objects:
        box = dict(zip(BOX_COLUMNS, each.box, strict=True))
        found.append({"k": each.k, "category": each.category, **box, "score": 1.0, "v": 1.0})
    names = (*names[:2], "decision", *names[2:])
    labels = sorted(found, key=lambda label: int(label["k"]))
    for label in labels:
        label["decision"] = decided.by_k.get(label["k"])
    return names, tuple(tuple(map(label.get, names)) for label in labels)


def _is_evidence(column: Column, tables: list[Table]) -> bool:
    """Return whether a column of `weighted_labels` is stored in one of the tables of evidence."""
    return any(column.name in table.c for table in tables if column.name not in ("round", "k"))
