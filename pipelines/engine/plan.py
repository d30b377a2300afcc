"""What is stale and what is done, asked of the database.

The fingerprint of a stage is a hash of all that its rows depend on: its settings and the
fingerprints of the stages that write what it reads. A frame is done where its task carries the
current fingerprint; a changed setting thus makes stale what follows, and only that.

The fingerprint of a stage that recalls what it has measured has two parts, MEASURED.REST. A frame
whose task carries the current first part needs not be measured again.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Connection, Select, and_, false, func, not_, or_, select

from curate.errors import WorkspaceError
from db import bulk
from pipelines.assembly import open_policy
from pipelines.engine.stage import FrameStage, RoundContext, RoundStage
from pipelines.round import active, frames_before, stage
from pipelines.workspace.workspace import Workspace

FINISHED = ("done", "empty")
PAGE = 1024  # frames that are read at once


@dataclass(frozen=True)
class Counts:
    """How many frames of a stage are in which state; `waiting` is all that is to be done."""

    done: int
    empty: int
    failed: int
    waiting: int


@dataclass(frozen=True)
class Once:
    """The key of the task of a stage that is done once, not per frame.

    Attributes:
        round: e; 0 for what comes before the first.
        stage: its name.
        variant: the policy; "" where there is none.
    """

    round: int
    stage: str
    variant: str

    def conditions(self) -> tuple[ColumnElement[bool], ...]:
        """The task's row in SQL."""
        task = bulk.table("task")
        mine = {"round": self.round, "stage": self.stage, "variant": self.variant}
        return (*(task.c[name] == value for name, value in mine.items()), task.c.frame_id.is_(None))


def fingerprints(workspace: Workspace, context: RoundContext, policy: str) -> dict[str, str]:
    """The current fingerprint of every active stage of a round.

    A round stage's fingerprint here says what its frames must have gone through; `state` adds which
    frames these were.
    """
    known: dict[str, str] = {
        "frame": workspace.config.dataset.kind,
        "ground_truth": digest(sorted(workspace.frames("labeled"))),
        "teacher": context.teacher.sha256,
    }
    prints: dict[str, str] = {}
    for each in active(workspace.config.run.priors):
        settings = (
            each.settings(workspace, context)
            if isinstance(each, FrameStage)
            else each.settings(workspace, context, policy)
        )
        inputs = [known[name] for name in each.reads if name in known]
        prints[each.name] = digest([each.name, settings, inputs])
        if isinstance(each, FrameStage) and each.recall:
            inputs = [known[name] for name in each.recall.reads]
            measured = digest([each.name, each.recall.settings(workspace, context), inputs])
            prints[each.name] = f"{measured}.{prints[each.name]}"
        known |= dict.fromkeys(each.writes, prints[each.name])
    return prints


def waiting_frames(
    workspace: Workspace, context: RoundContext, of: FrameStage, split: str, *, measured: bool
) -> Iterator[tuple[int, str, bool]]:
    """Frames to work on: key, name, and whether an earlier stage found them empty.

    They are those of the split that all earlier stages have finished and this one has not, or not
    with its current fingerprint. They are read page by page: what becomes of them meanwhile changes
    nothing in those that follow. With `measured` they are those whose stored measurements still
    hold, else the others.
    """
    prints = fingerprints(workspace, context, workspace.config.run.method)
    frame = bulk.table("frame")
    query, holds = _waiting(workspace, context, of, split, prints)
    query = query.where(holds if measured else not_(holds)).order_by(frame.c.id)
    ends = select(func.min(frame.c.id), func.max(frame.c.id)).where(frame.c.split == split)
    with workspace.database.reading() as connection:
        [(lowest, highest)] = bulk.select(connection, ends)
    if lowest is None:
        return
    for first in range(lowest, highest + 1, PAGE):
        page = query.where(frame.c.id.between(first, first + PAGE - 1))
        with workspace.database.reading() as connection:
            found = bulk.select(connection, page)
        for key, name, empty in found:
            yield key, name, bool(empty)


def count_waiting(workspace: Workspace, context: RoundContext, of: FrameStage, split: str) -> int:
    """How many frames are to be worked on."""
    prints = fingerprints(workspace, context, workspace.config.run.method)
    query, _ = _waiting(workspace, context, of, split, prints)
    with workspace.database.reading() as connection:
        found = bulk.select(connection, select(func.count()).select_from(query.subquery()))
    return int(found[0][0])


def _waiting(
    workspace: Workspace,
    context: RoundContext,
    of: FrameStage,
    split: str,
    prints: Mapping[str, str],
) -> tuple[Select[Any], ColumnElement[bool]]:
    """The query for the frames to work on, and the condition that their measurements still hold."""
    frame = bulk.table("frame")
    own = bulk.table("task").alias("own")
    source = frame.outerjoin(own, _task_of(own, context, of.name))
    empty: list[ColumnElement[bool]] = [false()]
    for other in frames_before(of, workspace.config.run.priors):
        task = bulk.table("task").alias(f"task_{other.name}")
        finished = (task.c.fingerprint == prints[other.name], task.c.state.in_(FINISHED))
        source = source.join(task, and_(_task_of(task, context, other.name), *finished))
        empty.append(task.c.state == "empty")
    current = prints[of.name]
    holds = and_(
        own.c.id.is_not(None),
        func.coalesce(own.c.state, "") == "done",
        func.coalesce(own.c.fingerprint, "").startswith(current.partition(".")[0] + "."),
    )
    undone = or_(own.c.id.is_(None), own.c.fingerprint != current, own.c.state.not_in(FINISHED))
    query = select(frame.c.id, frame.c.frame, or_(*empty)).select_from(source)
    return query.where(frame.c.split == split, undone), holds


def counts(workspace: Workspace, context: RoundContext, of: FrameStage, split: str) -> Counts:
    """How far a stage is with a split."""
    prints = fingerprints(workspace, context, workspace.config.run.method)
    frame, own = bulk.table("frame"), bulk.table("task").alias("own")
    mine = and_(_task_of(own, context, of.name), own.c.fingerprint == prints[of.name])
    query = (
        select(own.c.state, func.count())
        .select_from(frame.outerjoin(own, mine))
        .where(frame.c.split == split)
        .group_by(own.c.state)
    )
    with workspace.database.reading() as connection:
        found: dict[str | None, int] = dict(bulk.select(connection, query))
    done, empty, failed, waiting = (found.get(key, 0) for key in ("done", "empty", "failed", None))
    return Counts(done, empty, failed, waiting)


def _task_of(task: Any, context: RoundContext, stage_name: str) -> ColumnElement[bool]:
    """The join of a frame with its task of a stage."""
    return and_(
        task.c.round == context.number,
        task.c.stage == stage_name,
        task.c.frame_id == bulk.table("frame").c.id,
    )


def complete_frames(
    workspace: Workspace, context: RoundContext, split: str = "unlabeled"
) -> list[int]:
    """The frames of a split that every stage before solve has finished, with at least one label.

    Raises:
        WorkspaceError: some frames wait; failed ones do not count as waiting, they are left out.
    """
    prints = fingerprints(workspace, context, workspace.config.run.method)
    needed = frames_before(stage("solve"), workspace.config.run.priors)
    frames = workspace.frames(split).values()
    with workspace.database.reading() as connection:
        states = {
            other.name: _states(connection, context.number, other.name, prints[other.name])
            for other in needed
        }
    failed = {key for of in states.values() for key, state in of.items() if state == "failed"}
    for other in needed:
        missing = sum(key not in states[other.name] and key not in failed for key in frames)
        if missing:
            raise WorkspaceError(
                f"{other.name}: {missing} frames of round {context.number} are not done with the "
                f"current settings; run `curate {other.command}`, or `curate run` for all stages"
            )
    return [key for key in frames if all(of.get(key) == "done" for of in states.values())]


def frames_to_weigh(workspace: Workspace, context: RoundContext, policy: str) -> list[int]:
    """The complete frames; none while some wait for a policy that uses no label of theirs.

    Raises:
        WorkspaceError: frames wait whose labels the policy uses.
    """
    try:
        return complete_frames(workspace, context)
    except WorkspaceError:
        if open_policy(workspace.config, policy).uses_unlabeled:
            raise
        return []


def round_fingerprint(
    workspace: Workspace, context: RoundContext, of: RoundStage, policy: str, frames: Sequence[int]
) -> str:
    """The fingerprint of a round stage together with the frames that it would see."""
    return digest([fingerprints(workspace, context, policy)[of.name], list(frames)])


def round_state(workspace: Workspace, context: RoundContext, of: RoundStage, policy: str) -> str:
    """The state of a round stage: "done", "stale", or "waiting" for its first run or its input."""
    what = Once(context.number, of.name, policy)
    query = select(bulk.table("task").c.fingerprint).where(*what.conditions())
    with workspace.database.reading() as connection:
        stored = bulk.select(connection, query)
    if not stored:
        return "waiting"
    try:
        frames = frames_to_weigh(workspace, context, policy)
    except WorkspaceError:
        return "stale"
    current = round_fingerprint(workspace, context, of, policy, frames)
    file = of.file(workspace, context, policy) if of.file else None
    return "done" if stored == [(current,)] and (file is None or file.exists()) else "stale"


def is_current(workspace: Workspace, what: Once, fingerprint: str) -> bool:
    """Whether it has been done with all that it depends on."""
    query = select(bulk.table("task").c.fingerprint).where(*what.conditions())
    with workspace.database.reading() as connection:
        return bulk.select(connection, query) == [(fingerprint,)]


def _states(
    connection: Connection, round_number: int, stage: str, fingerprint: str
) -> Mapping[int, str]:
    """The state of each frame's task that carries the fingerprint."""
    task = bulk.table("task")
    query = select(task.c.frame_id, task.c.state).where(
        task.c.round == round_number,
        task.c.stage == stage,
        task.c.fingerprint == fingerprint,
        task.c.frame_id.is_not(None),
    )
    return dict(bulk.select(connection, query))


def digest(value: Any) -> str:
    """A hash of a value made of plain types."""
    text = json.dumps(value, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]
