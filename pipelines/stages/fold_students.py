"""The students of a fold: its teachers in the rounds after the first.

They are trained as those of the workspace, on the labels that its rounds exported, but without the
held-out frames of the fold. Each starts from the fold's own teacher of the round before.
"""

import sqlite3
from contextlib import closing
from pathlib import Path

from sqlalchemy import Connection

from curate.errors import WorkspaceError
from curate.files.atomic import replace_file
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import register_checkpoint, stored_round
from pipelines.engine.stage import FirstStage, Product, RoundContext
from pipelines.stages import export, train_round
from pipelines.stages.export import register_label_file
from pipelines.stages.methods import method_of
from pipelines.stages.train_round import train_with_progress, training_settings
from pipelines.workspace.workspace import Workspace, sha256


def student_stage(parent: Workspace, number: int) -> FirstStage:
    """Return the stage that trains the student of a fold in a round.

    Args:
        parent: the workspace of the folds, in which the student of the round is trained.
        number: number e of the round.
    """
    method = parent.config.run.method

    def settings(fold: Workspace) -> object:
        context = _context(fold, number)
        return [
            train_round.settings(fold, context, method),
            sorted(fold.frames("labeled")),
            sha256(_exported(parent, context)),
            context.teacher.sha256,
        ]

    def run(fold: Workspace, progress: Progress) -> Product:
        return _train(parent, fold, _context(fold, number), progress)

    return FirstStage(
        f"train-round {number}",
        command="calibrate",
        reads=("teacher", "labels.sqlite"),
        writes=("student",),
        settings=settings,
        run=run,
        file=lambda fold: train_round.file(fold, _context(fold, number), method),
        check=lambda _: None,
        guard=lambda _: None,  # the labels are checked once they are written
    )


def _train(
    parent: Workspace, fold: Workspace, context: RoundContext, progress: Progress
) -> Product:
    from pipelines.firewall.rules import enforce

    method, section = fold.config.run.method, fold.config.train
    labels, path = (each(fold, context, method) for each in (export.file, train_round.file))
    held_out = sorted(set(parent.frames("labeled")) - set(fold.frames("labeled")))
    _write_without(_exported(parent, context), labels, held_out)
    enforce(fold, file=labels)
    report = train_with_progress(
        fold,
        labels=labels,
        output=path,
        settings=training_settings(
            fold,
            section.round_steps,
            section.round_learning_rate,
            context.number,
            method_of(fold.config, method),
        ),
        start=context.teacher.path if section.start == "teacher" else None,
        frames=section.batch_size + section.unlabeled_batch_size,
        progress=progress,
    )

    def write(connection: Connection) -> None:
        register_checkpoint(connection, fold, context.number, method, path)
        register_label_file(connection, fold, labels, context.number, method)

    return Product(f"{report.steps} steps, {fold.relative(path)}", write)


def _context(fold: Workspace, number: int) -> RoundContext:
    found = stored_round(fold, number)
    if found is None:
        raise WorkspaceError(f"{fold.root}: round {number} has no teacher; run `curate calibrate`")
    return found


def _exported(parent: Workspace, context: RoundContext) -> Path:
    """Return the label file that the student of the workspace was trained on."""
    path = export.file(parent, context, parent.config.run.method)
    if not path.exists():
        raise WorkspaceError(
            f"{path}: the labels of round {context.number} are missing, from which the teachers of "
            f"the folds are trained; run `curate export --round {context.number}`"
        )
    return path


def _write_without(source: Path, target: Path, frames: list[str]) -> None:
    """Copy a label file without some labeled frames."""
    partial = target.with_suffix(".partial")
    replace_file(partial, source.read_bytes())
    with closing(sqlite3.connect(partial)) as connection, connection:
        for table in ("ground_truth", "frame"):
            connection.executemany(
                f"DELETE FROM {table} WHERE frame = ?",  # noqa: S608 - constants
                [(name,) for name in frames],
            )
    partial.replace(target)
