"""How far a workspace is: a row per round and stage."""

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import select, text

from curate.errors import WorkspaceError
from db import bulk
from pipelines.engine import plan
from pipelines.engine.rounds import find_teacher, is_student_trained, is_trainable, peek_round
from pipelines.engine.stage import FrameStage, RoundContext, RoundStage
from pipelines.round import active
from pipelines.workspace.workspace import Workspace

COLUMNS = ("round", "stage", "split", "policy", "state", "done", "empty", "failed", "waiting")


def overview(workspace: Workspace) -> tuple[Sequence[str], list[tuple[Any, ...]]]:
    """Column names, and a row per round and stage; nothing is written."""
    table = bulk.table("round")
    with workspace.database.reading() as connection:
        numbers = [
            row[0]
            for row in bulk.select(connection, select(table.c.number).order_by(table.c.number))
        ]
    # A detector that the user brings needs no pretraining, and has students only by a command:
    # nothing would ever come of these rows.
    trained = is_student_trained(workspace)
    rows: list[tuple[Any, ...]] = [_pretrain_row(workspace)] if is_trainable(workspace) else []
    for number in numbers:
        context = peek_round(workspace, number)
        if context is None:
            rows.append((number, "predict", "unlabeled", "", "no teacher", 0, 0, 0, 0))
            continue
        for stage in active(workspace.config.run.priors):
            if isinstance(stage, FrameStage):
                rows += _frame_rows(workspace, context, stage)
            elif trained or stage.name != "train-round":
                rows += _round_rows(workspace, context, stage)
    return COLUMNS, rows


def failed_frames(workspace: Workspace) -> tuple[Sequence[str], list[tuple[Any, ...]]]:
    """Column names, and every failed frame with its error."""
    columns = ("round", "stage", "frame", "split", "error")
    query = text(f"SELECT {', '.join(columns)} FROM failed_frames ORDER BY 1, 2, 3")  # noqa: S608
    with workspace.database.reading() as connection:
        return columns, [tuple(row) for row in connection.execute(query)]


def _pretrain_row(workspace: Workspace) -> tuple[Any, ...]:
    try:
        find_teacher(workspace, 1)
    except WorkspaceError:
        return (0, "pretrain", "labeled", "", "waiting", 0, 0, 0, 1)
    return (0, "pretrain", "labeled", "", "done", 1, 0, 0, 0)


def _frame_rows(
    workspace: Workspace, context: RoundContext, stage: FrameStage
) -> Iterator[tuple[Any, ...]]:
    for split in ("unlabeled", "val", "labeled"):
        found = plan.counts(workspace, context, stage, split)
        touched = found.done + found.empty + found.failed
        if split != "unlabeled" and not touched:
            continue
        state = "done" if not found.waiting else ("waiting" if not touched else "partly")
        yield (
            context.number, stage.name, split, "", state,
            found.done, found.empty, found.failed, found.waiting,
        )  # fmt: skip


def _round_rows(
    workspace: Workspace, context: RoundContext, stage: RoundStage
) -> Iterator[tuple[Any, ...]]:
    task = bulk.table("task")
    query = select(task.c.variant).where(
        task.c.round == context.number, task.c.stage == stage.name, task.c.frame_id.is_(None)
    )
    with workspace.database.reading() as connection:
        policies = {row[0] for row in bulk.select(connection, query)}
    for policy in sorted(policies | {workspace.config.run.method}):
        state = plan.round_state(workspace, context, stage, policy)
        done = int(state == "done")
        yield (context.number, stage.name, "", policy, state, done, 0, 0, 1 - done)
