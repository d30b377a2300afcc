"""export: write the weighted labels of a round to files that trainers read."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from sqlalchemy import Connection, select

import curate
from curate.errors import WorkspaceError
from curate.exporters.base import (
    GROUND_TRUTH_COLUMNS,
    Block,
    Exporter,
    FrameFiles,
    LabelFileDescription,
    LabelRows,
    LabelSet,
)
from curate.exporters.sqlite import SqliteExporter, check_label_file_place
from curate.files.batches import batched
from curate.priors.base import Column
from db import bulk
from db.evidence import read_declarations, weighted_label_columns
from db.views import FAILED_FRAMES, WEIGHTED_LABELS
from pipelines.assembly import open_policy
from pipelines.engine.progress import Progress
from pipelines.engine.stage import Product, RoundContext, RoundJob, Settings
from pipelines.labels.by_frame import check_weights
from pipelines.labels.human_labels import fingerprint
from pipelines.labels.stored_rows import StoredRows
from pipelines.stages.methods import zero_weight_of
from pipelines.stages.vanished import check_labels, remember_labels
from pipelines.workspace.splits import HELD_OUT
from pipelines.workspace.workspace import Workspace, sha256

CURRENT = "labels.sqlite"
# SQLite limits the number of parameters of a statement.
_FRAMES_PER_QUERY = 400


def settings(workspace: Workspace, context: RoundContext, policy: str) -> Settings:
    """Return what the exported file depends on besides weights and ground truth.

    These are the human labels, the meaning of weight 0, and the columns of further evidence.
    """
    human = fingerprint(workspace, context.number)
    further = _further_columns(workspace)
    return {
        "format": 1,
        "zero_weight": zero_weight_of(workspace.config, policy),
        **({"columns": further} if further else {}),
        **({} if human is None else {"human": human}),
    }


def _further_columns(workspace: Workspace) -> list[str]:
    """Return the layout of the columns after the core ones, as text."""
    with workspace.database.reading() as connection:
        return [repr(each.layout) for each in read_declarations(connection)]


def file(workspace: Workspace, context: RoundContext, policy: str) -> Path:
    """Return the path of the exported SQLite file of a round and policy."""
    return default_path(workspace, context.number, policy, SqliteExporter())


def default_path(workspace: Workspace, round_number: int, policy: str, exporter: Exporter) -> Path:
    """Return the path of an export in the workspace: exports/round-01-pspsl.csv, for example.

    Folders, and files with a suffix that several formats share, have the format in their name:
    round-01-pspsl-kitti, round-01-pspsl-coco.json.
    """
    own_suffix = exporter.suffix == f".{exporter.name}"
    name = f"round-{round_number:02d}-{policy}" + ("" if own_suffix else f"-{exporter.name}")
    return workspace.root / "exports" / f"{name}{exporter.suffix}"


def missing_frames(workspace: Workspace, round_number: int, policy: str) -> tuple[str, ...]:
    """Return the unlabeled frames that failed in a round and therefore have no exported label."""
    if not open_policy(workspace.config, policy).uses_unlabeled:
        return ()
    failed, labels = FAILED_FRAMES.c, WEIGHTED_LABELS.c
    query = select(failed.frame).where(failed.round == round_number, failed.split == "unlabeled")
    with workspace.database.reading() as connection:
        missing = set(connection.execute(query.distinct()).scalars())
        for batch in batched(sorted(missing), _FRAMES_PER_QUERY):
            with_labels = select(labels.frame).where(
                labels.round == round_number, labels.policy == policy, labels.frame.in_(batch)
            )
            missing.difference_update(connection.execute(with_labels).scalars())
    return tuple(sorted(missing))


def guard(workspace: Workspace, context: RoundContext, policy: str) -> None:
    """Check the leakage firewall and the stored weights.

    Raises:
        LeakageError: if ground truth of unlabeled or val frames would be exported.
        DataError: if a weight is not in [0, 1].
    """
    from pipelines.firewall.rules import enforce

    enforce(workspace, context.number, file(workspace, context, policy))
    with workspace.database.reading() as connection:
        check_weights(connection, context.number, policy)


def run(workspace: Workspace, job: RoundJob, _progress: Progress) -> Product:
    """Write the round's file; for the configured policy also copy it to `labels.sqlite`."""
    path = file(workspace, job.context, job.policy)
    current = path.with_name(CURRENT) if job.policy == workspace.config.run.method else None
    if current:
        check_label_file_place(current)
    written = [path, current] if current else [path]
    check_labels(workspace, job.context.number, job.policy, written)
    unlabeled = open_policy(workspace.config, job.policy).uses_unlabeled
    labels = write_label_file(workspace, path, job.context.number, job.policy if unlabeled else "")
    if current:
        partial = path.with_suffix(".partial")
        shutil.copyfile(path, partial)
        partial.replace(current)
    remember_labels(workspace, job.context.number, job.policy, written)

    def write(connection: Connection) -> None:
        for each in written:
            register_label_file(connection, workspace, each, job.context.number, job.policy)

    summary = f"{labels} labels in {workspace.relative(path)}"
    missing = missing_frames(workspace, job.context.number, job.policy)
    return Product(summary, write, missing=missing)


def register_label_file(
    connection: Connection, workspace: Workspace, path: Path, round_number: int, policy: str
) -> None:
    """Store the hash of a label file; it replaces that of an earlier file."""
    table, name = bulk.table("label_file"), workspace.relative(path)
    connection.execute(table.delete().where(table.c.path == name))
    row = {"path": name, "round": round_number, "policy": policy, "sha256": sha256(path)}
    bulk.insert_rows(connection, "label_file", [row])


def write_label_file(workspace: Workspace, path: Path, round_number: int, policy: str) -> int:
    """Write the file that the trainer reads.

    Args:
        workspace: the workspace.
        path: path of the file.
        round_number: number e of the round.
        policy: policy with the weights to export; "" for ground truth alone.

    Returns:
        The number of exported labels.
    """
    return SqliteExporter().write(path, label_set(workspace, round_number, policy))


def export_as(
    workspace: Workspace, exporter: Exporter, round_number: int, policy: str, path: Path
) -> int:
    """Write the labels of a policy in the format of an exporter; return their number.

    Raises:
        WorkspaceError: if the policy has weighted nothing in that round.
        LabelsVanished: if the export would lose all labels of a category.
        LeakageError: if ground truth of unlabeled or val frames would be exported.
    """
    from pipelines.firewall.rules import enforce

    enforce(workspace, round_number)
    labels = label_set(workspace, round_number, policy)
    empty = all(each.split == "labeled" for each in labels.frames)
    if empty and not workspace.allow_empty:
        raise WorkspaceError(
            f"round {round_number} has no labels weighted by {policy}; "
            f"run `curate solve --policy {policy}`"
        )
    check_labels(workspace, round_number, policy, [path])
    count = exporter.write(path, labels)
    remember_labels(workspace, round_number, policy, [path])
    return count


def label_set(workspace: Workspace, round_number: int, policy: str) -> LabelSet:
    """Return X_l with its ground truth, and X_u with the labels weighted by a policy in a round."""
    config = workspace.config
    description = LabelFileDescription(
        dataset=config.dataset.kind,
        root=config.dataset.root,
        categories=config.dataset.categories,
        round=round_number,
        policy=policy,
        code_version=curate.__version__,
        zero_weight=zero_weight_of(config, policy or config.run.method),
    )
    with workspace.database.reading() as connection:
        columns = weighted_label_columns(connection)
        labels = StoredLabels(workspace, round_number, policy, columns)
        frames = _frames(connection, labels.frames(connection))
        truth = _ground_truth(connection)
    frames = _with_further_images(workspace, frames)
    read = partial(workspace.dataset.read, points=False)
    return LabelSet(
        description, frames, truth, labels, read, workspace.dataset.read, labels.columns
    )


@dataclass(frozen=True)
class StoredLabels:
    """The labels of a round and policy, sorted by frame and k, read from the database in blocks.

    Attributes:
        workspace: the workspace.
        round_number: number e of the round.
        policy: policy that weighted the labels.
        columns: columns of `weighted_labels` to read.
    """

    workspace: Workspace
    round_number: int
    policy: str
    columns: tuple[Column, ...]

    def __iter__(self) -> Iterator[LabelRows]:
        """Yield blocks of some thousand labels: millions at once would not fit into memory."""
        names = tuple(each.name for each in self.columns)
        with self.workspace.database.reading() as connection:
            stored = StoredRows(connection, self.round_number, self.policy)
            for rows in stored.blocks(names):
                yield LabelRows(names, rows)

    def frames(self, connection: Connection) -> set[str]:
        """Return the names of the frames with labels."""
        return set(StoredRows(connection, self.round_number, self.policy).frames())


def _frames(connection: Connection, with_labels: set[str]) -> list[FrameFiles]:
    """Return all labeled frames, with or without objects, and the unlabeled frames with labels.

    An unlabeled frame in which the teacher found nothing is left out: objects that the teacher
    missed would be trained as background, and no weight can reduce their effect.
    """
    frame = bulk.table("frame").c
    query = select(
        frame.frame,
        frame.split,
        frame.points_path.label("points"),
        frame.image_path.label("image"),
        frame.calibration_path.label("calibration"),
    ).where(frame.split.not_in(HELD_OUT))
    rows = sorted(bulk.select(connection, query))
    return [FrameFiles(*row) for row in rows if row[1] == "labeled" or row[0] in with_labels]


def _with_further_images(workspace: Workspace, frames: list[FrameFiles]) -> list[FrameFiles]:
    """Return the frames with the images of all cameras, if the data set has several."""
    root, files = workspace.config.dataset.root, workspace.dataset.files
    if not frames or not files(frames[0].frame).further_images:
        return frames

    def relative(paths: Sequence[Path]) -> tuple[str, ...]:
        return tuple(str(path.relative_to(root)) for path in paths)

    return [
        replace(each, further_images=relative(files(each.frame).further_images)) for each in frames
    ]


def _ground_truth(connection: Connection) -> Block:
    truth, frame = bulk.table("ground_truth"), bulk.table("frame")
    columns = [frame.c.frame, *(truth.c[name] for name in GROUND_TRUTH_COLUMNS[1:])]
    query = (
        select(*columns)
        .join(frame, frame.c.id == truth.c.frame_id)
        .where(frame.c.split == "labeled", truth.c.x.is_not(None))
        .order_by(frame.c.frame, truth.c.k)
    )
    rows = connection.execute(query).mappings().all()
    return {name: [row[name] for row in rows] for name in GROUND_TRUTH_COLUMNS}
