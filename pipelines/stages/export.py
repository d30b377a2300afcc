"""export: the weighted labels of a round as files that trainers read."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import ColumnElement, Connection, Select, func, select

import curate
from curate.errors import WorkspaceError
from curate.exporters.base import Exporter, LabelFileDescription, LabelSet
from curate.exporters.sqlite import SqliteExporter, refuse_foreign
from db import bulk
from db.models import BOX_COLUMNS
from db.views import WEIGHTED_LABELS
from pipelines.assembly import open_policy
from pipelines.engine.progress import Progress
from pipelines.engine.stage import Product, RoundContext, RoundJob, Settings
from pipelines.firewall.rules import enforce
from pipelines.labels.by_frame import refuse_bad_weights
from pipelines.labels.human_labels import fingerprint
from pipelines.workspace.workspace import Workspace, sha256

CURRENT = "labels.sqlite"
_CHUNK = 10_000


def settings(workspace: Workspace, context: RoundContext, _policy: str) -> Settings:
    """What the exported file depends on beside weights and ground truth: what people decided."""
    human = fingerprint(workspace, context.number)
    return {"format": 1} if human is None else {"format": 1, "human": human}


def file(workspace: Workspace, context: RoundContext, policy: str) -> Path:
    """The exported file of a round and policy."""
    return workspace.root / "exports" / f"round-{context.number:02d}-{policy}.sqlite"


def guard(workspace: Workspace, context: RoundContext, policy: str) -> None:
    """LeakageError where ground truth would reach what it must not, see `firewall`.

    DataError where a weight is not in [0, 1].
    """
    enforce(workspace, context.number, file(workspace, context, policy))
    with workspace.database.reading() as connection:
        refuse_bad_weights(connection, context.number, policy)


def run(workspace: Workspace, job: RoundJob, _progress: Progress) -> Product:
    """Writes the round's file; `labels.sqlite` becomes a copy where the policy is the trainer's."""
    path = file(workspace, job.context, job.policy)
    current = path.with_name(CURRENT) if job.policy == workspace.config.run.method else None
    if current:
        refuse_foreign(current)
    unlabeled = open_policy(workspace.config, job.policy).uses_unlabeled
    labels = write_label_file(workspace, path, job.context.number, job.policy if unlabeled else "")
    written = [path]
    if current:
        partial = path.with_suffix(".partial")
        shutil.copyfile(path, partial)
        partial.replace(current)
        written.append(current)

    def write(connection: Connection) -> None:
        for each in written:
            register_label_file(connection, workspace, each, job.context.number, job.policy)

    return Product(f"{labels} labels in {workspace.relative(path)}", write)


def register_label_file(
    connection: Connection, workspace: Workspace, path: Path, round_number: int, policy: str
) -> None:
    """Stores the hash of a label file in place of an earlier one's."""
    table, name = bulk.table("label_file"), workspace.relative(path)
    connection.execute(table.delete().where(table.c.path == name))
    row = {"path": name, "round": round_number, "policy": policy, "sha256": sha256(path)}
    bulk.insert_rows(connection, "label_file", [row])


def write_label_file(workspace: Workspace, path: Path, round_number: int, policy: str) -> int:
    """The file that the trainer reads, with the labels that a policy weighted; none for policy "".

    Returns:
        How many labels were written.
    """
    return SqliteExporter().write(path, label_set(workspace, round_number, policy))


def export_as(
    workspace: Workspace, exporter: Exporter, round_number: int, policy: str, path: Path
) -> int:
    """Writes a policy's labels in some format; returns how many.

    Raises:
        WorkspaceError: the policy has weighted nothing in that round.
        LeakageError: ground truth would reach what it must not.
    """
    enforce(workspace, round_number)
    labels = label_set(workspace, round_number, policy)
    if not len(labels.labels):
        raise WorkspaceError(
            f"round {round_number} has no labels weighted by {policy}; "
            f"run `curate solve --policy {policy}`"
        )
    return exporter.write(path, labels)


def label_set(workspace: Workspace, round_number: int, policy: str) -> LabelSet:
    """X_l with its ground truth, and X_u with the labels that a policy weighted in a round."""
    description = LabelFileDescription(
        dataset=workspace.config.dataset.kind,
        root=workspace.config.dataset.root,
        categories=workspace.config.dataset.categories,
        round=round_number,
        policy=policy,
        code_version=curate.__version__,
    )
    labels = StoredLabels(workspace, round_number, policy)
    with workspace.database.reading() as connection:
        refuse_bad_weights(connection, round_number, policy)
        frames = _frames(connection, labels.frames(connection))
        truth = _ground_truth(connection)
    read = partial(workspace.dataset.read, points=False)
    return LabelSet(description, frames, truth, labels, read, workspace.dataset.read)


@dataclass(frozen=True)
class StoredLabels:
    """The rows of `weighted_labels` of a round and policy, by frame and k, read as they are walked.

    Attributes:
        workspace: that holds them.
        round_number: that made them.
        policy: that weighted them.
    """

    workspace: Workspace
    round_number: int
    policy: str

    def __len__(self) -> int:
        """How many there are."""
        with self.workspace.database.reading() as connection:
            return int(connection.execute(self._of(func.count())).scalar_one())

    def __iter__(self) -> Iterator[bulk.Row]:
        """A few thousand at a time: two million labels would fill the memory."""
        query = self._of(*WEIGHTED_LABELS.c).order_by(WEIGHTED_LABELS.c.frame, WEIGHTED_LABELS.c.k)
        with self.workspace.database.reading() as connection:
            result = connection.execution_options(stream_results=True).execute(query)
            for rows in result.partitions(_CHUNK):
                yield from map(tuple, rows)

    def frames(self, connection: Connection) -> set[str]:
        """The frames that have labels."""
        query = self._of(WEIGHTED_LABELS.c.frame).distinct()
        return {row[0] for row in bulk.select(connection, query)}

    def _of(self, *columns: ColumnElement[Any]) -> Select[Any]:
        labels = WEIGHTED_LABELS.c
        chosen = (labels.round == self.round_number, labels.policy == self.policy)
        return select(*columns).select_from(WEIGHTED_LABELS).where(*chosen)


def _frames(connection: Connection, with_labels: set[str]) -> list[bulk.Row]:
    """All labeled frames, with or without objects, and the unlabeled ones that have labels.

    An unlabeled frame in which the teacher found nothing is left out: no weight vouches for its
    emptiness, and as background it would teach what the teacher has missed.
    """
    frame = bulk.table("frame")
    paths = (frame.c.points_path, frame.c.image_path, frame.c.calibration_path)
    query = select(frame.c.frame, frame.c.split, *paths).where(frame.c.split != "val")
    rows = bulk.select(connection, query.order_by(frame.c.frame))
    return [row for row in rows if row[1] == "labeled" or row[0] in with_labels]


def _ground_truth(connection: Connection) -> list[bulk.Row]:
    truth, frame = bulk.table("ground_truth"), bulk.table("frame")
    names = ("k", "category", *BOX_COLUMNS, "truncated", "occluded")
    query = (
        select(frame.c.frame, *(truth.c[name] for name in names))
        .join(frame, frame.c.id == truth.c.frame_id)
        .where(frame.c.split == "labeled", truth.c.x.is_not(None))
        .order_by(frame.c.frame, truth.c.k)
    )
    return list(bulk.select(connection, query))
