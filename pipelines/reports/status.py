"""The progress of a workspace: a row per round and stage."""

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import select, text

from curate.errors import WorkspaceError
from db import bulk
from pipelines.engine.plan import Plan
from pipelines.engine.rounds import (
    find_teacher,
    is_student_trained,
    outside_rounds,
    stored_round,
)
from pipelines.engine.stage import CacheStage, FirstStage, FramesStage, RoundStage
from pipelines.labels.human_labels import counts, decided_frames
from pipelines.round import graph_of
from pipelines.workspace.splits import WITH_TRUTH
from pipelines.workspace.workspace import Workspace

COLUMNS = ("round", "stage", "split", "policy", "state", "done", "empty", "failed", "waiting")


def overview(workspace: Workspace) -> tuple[Sequence[str], list[tuple[Any, ...]]]:
    """Return the column names, and a row per round and stage; nothing is written."""
    table = bulk.table("round")
    numbers = [
        row[0] for row in workspace.database.rows(select(table.c.number).order_by(table.c.number))
    ]
    # An external detector is not pretrained and has students only by an explicit command: these
    # rows would wait forever.
    trained = is_student_trained(workspace)
    graph = graph_of(workspace)
    rows = [_first_row(workspace, first) for first in graph.first_stages]
    outside = Plan(workspace, outside_rounds(workspace), graph)
    rows += [row for stage in graph.cache_stages for row in _frame_rows(outside, stage)]
    for number in numbers:
        context = stored_round(workspace, number)
        if context is None:
            rows.append((number, "predict", "unlabeled", "", "no teacher", 0, 0, 0, 0))
            continue
        plan = Plan(workspace, context, graph)
        for stage in graph.stages:
            if isinstance(stage, CacheStage):
                continue
            if isinstance(stage, FramesStage):
                rows += _frame_rows(plan, stage)
            elif isinstance(stage, RoundStage) and (trained or "student" not in stage.writes):
                rows += _round_rows(plan, stage)
        decided = decided_frames(workspace, number)
        if decided:
            rows.append((number, "review", "unlabeled", "", "done", decided, 0, 0, 0))
    return COLUMNS, rows


def decisions(workspace: Workspace) -> list[str]:
    """Return a line per round with the decisions of people that are valid in it."""
    table = bulk.table("round").c.number
    numbers = [row[0] for row in workspace.database.rows(select(table).order_by(table))]
    found = {number: counts(workspace, number) for number in numbers}
    return [
        f"round {number}: decisions of people: "
        + ", ".join(f"{count:,} {name}" for name, count in decided.items())
        for number, decided in found.items()
        if decided
    ]


def failed_frames(workspace: Workspace) -> tuple[Sequence[str], list[tuple[Any, ...]]]:
    """Return the column names, and a row for every failed frame with its error."""
    columns = ("round", "stage", "frame", "split", "error")
    query = text(f"SELECT {', '.join(columns)} FROM failed_frames ORDER BY 1, 2, 3")  # noqa: S608
    with workspace.database.reading() as connection:
        return columns, [tuple(row) for row in connection.execute(query)]


def _first_row(workspace: Workspace, stage: FirstStage) -> tuple[Any, ...]:
    try:
        find_teacher(workspace, 1)
    except WorkspaceError:
        return (0, stage.name, "labeled", "", "waiting", 0, 0, 0, 1)
    return (0, stage.name, "labeled", "", "done", 1, 0, 0, 0)


def _frame_rows(plan: Plan, stage: FramesStage) -> Iterator[tuple[Any, ...]]:
    for split in ("unlabeled", *WITH_TRUTH[::-1]):
        found = plan.counts(stage, split)
        touched = found.done + found.empty + found.failed
        if split != "unlabeled" and not touched:
            continue
        state = "done" if not found.waiting else ("waiting" if not touched else "partly")
        yield (
            plan.round_of(stage), stage.name, split, "", state,
            found.done, found.empty, found.failed, found.waiting,
        )  # fmt: skip


def _round_rows(plan: Plan, stage: RoundStage) -> Iterator[tuple[Any, ...]]:
    workspace, context, task = plan.workspace, plan.context, bulk.table("task")
    query = select(task.c.variant).where(
        task.c.round == context.number, task.c.stage == stage.name, task.c.frame_id.is_(None)
    )
    policies = {row[0] for row in workspace.database.rows(query)}
    for policy in sorted(policies | {workspace.config.run.method}):
        if not stage.is_part(workspace, policy):
            continue
        state = plan.round_state(stage, policy)
        done = int(state == "done")
        yield (context.number, stage.name, "", policy, state, done, 0, 0, 1 - done)
