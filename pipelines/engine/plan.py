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
from functools import cached_property
from typing import Any

from sqlalchemy import ColumnElement, Connection, Select, and_, false, func, not_, or_, select

from curate.datasets.base import sequences_of
from curate.errors import WorkspaceError
from curate.firewall.sequences import group_by_sequence
from db import bulk
from pipelines.assembly import open_policy
from pipelines.engine.graph import Graph
from pipelines.engine.stage import FirstStage, FramesStage, FrameStage, RoundContext, RoundStage
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
class WaitingFrame:
    """A frame to work on.

    Attributes:
        key: of the frame.
        name: of the frame.
        empty: whether an earlier stage found nothing in it.
    """

    key: int
    name: str
    empty: bool


@dataclass(frozen=True)
class TaskKey:
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
        """Return the task's row in SQL."""
        task = bulk.table("task")
        mine = {"round": self.round, "stage": self.stage, "variant": self.variant}
        return (*(task.c[name] == value for name, value in mine.items()), task.c.frame_id.is_(None))


@dataclass(frozen=True)
class Plan:
    """What is to be done in a round. Fingerprints are computed once per plan.

    Attributes:
        workspace: see `Workspace`.
        context: the round.
        graph: the stages.
    """

    workspace: Workspace
    context: RoundContext
    graph: Graph

    @cached_property
    def _sources(self) -> dict[str, str]:
        """The fingerprints of what no stage of a round writes."""
        return {
            "frame": self.workspace.config.dataset.kind,
            "ground_truth": digest(sorted(self.workspace.frames("labeled"))),
            "teacher": self.context.teacher.sha256,
        }

    @cached_property
    def _of_frames(self) -> dict[str, str]:
        """The fingerprints of the stages of frames."""
        known, prints = dict(self._sources), {}
        for stage in self.graph.frames_stages:
            settings = stage.settings(self.workspace, self.context)
            prints[stage.name] = _fingerprint(stage.name, settings, stage.reads, known)
            if isinstance(stage, FrameStage) and stage.recall:
                settings = stage.recall.settings(self.workspace, self.context)
                measured = _fingerprint(stage.name, settings, stage.recall.reads, known)
                prints[stage.name] = f"{measured}.{prints[stage.name]}"
            known |= dict.fromkeys(stage.writes, prints[stage.name])
        return prints

    @cached_property
    def _by_policy(self) -> dict[str, dict[str, str]]:
        return {}

    def fingerprints(self, policy: str) -> Mapping[str, str]:
        """Return the current fingerprint of every stage of the round.

        A round stage's fingerprint here says what its frames must have gone through;
        `round_fingerprint` adds which frames these were.
        """
        if policy not in self._by_policy:
            known, prints = dict(self._sources), dict(self._of_frames)
            for stage in self.graph.stages:
                if isinstance(stage, FirstStage):
                    continue
                if isinstance(stage, RoundStage):
                    settings = stage.settings(self.workspace, self.context, policy)
                    prints[stage.name] = _fingerprint(stage.name, settings, stage.reads, known)
                known |= dict.fromkeys(stage.writes, prints[stage.name])
            self._by_policy[policy] = prints
        return self._by_policy[policy]

    def fingerprint(self, stage: FramesStage) -> str:
        """Return the current fingerprint of a stage of frames."""
        return self._of_frames[stage.name]

    def waiting_frames(
        self, of: FrameStage, split: str, *, measured: bool
    ) -> Iterator[WaitingFrame]:
        """Yield the frames to work on.

        They are those of the split that all earlier stages have finished and this one has not, or
        not with its current fingerprint. They are read page by page: what becomes of them meanwhile
        changes nothing in those that follow. With `measured` they are those whose stored
        measurements still hold, else the others.
        """
        frame = bulk.table("frame")
        query, holds = self._waiting(of, split)
        query = query.where(holds if measured else not_(holds)).order_by(frame.c.id)
        ends = select(func.min(frame.c.id), func.max(frame.c.id)).where(frame.c.split == split)
        [(lowest, highest)] = self.workspace.database.rows(ends)
        if lowest is None:
            return
        for first in range(lowest, highest + 1, PAGE):
            page = query.where(frame.c.id.between(first, first + PAGE - 1))
            found = self.workspace.database.rows(page)
            for key, name, empty in found:
                yield WaitingFrame(key, name, bool(empty))

    def waiting_sequences(
        self, of: FramesStage, split: str
    ) -> Iterator[tuple[str, list[WaitingFrame]]]:
        """Yield the sequences to work on, each with all its frames in the order of their names.

        They are those with a frame that waits, where no frame still waits for an earlier stage. A
        frame that failed in an earlier stage is left out of its sequence.
        """
        waiting = {frame.name for frame in self._frames(of, split, undone=True)}
        ready = {frame.name: frame for frame in self._frames(of, split, undone=False)}
        failed = self._failed_before(of, split)
        names = self.workspace.frames(split)
        sequences = sequences_of(self.workspace.dataset, names)
        for sequence, members in group_by_sequence(sequences, names).items():
            wanted = sorted(name for name in members if name not in failed)
            if waiting & set(wanted) and all(name in ready for name in wanted):
                yield sequence, [ready[name] for name in wanted]

    def count_waiting(self, of: FramesStage, split: str) -> int:
        """Return how many frames are to be worked on."""
        query, _ = self._waiting(of, split)
        found = self.workspace.database.rows(select(func.count()).select_from(query.subquery()))
        return int(found[0][0])

    def counts(self, of: FramesStage, split: str) -> Counts:
        """Return how far a stage is with a split."""
        frame, own = bulk.table("frame"), bulk.table("task").alias("own")
        mine = and_(self._task_of(own, of), own.c.fingerprint == self.fingerprint(of))
        query = (
            select(own.c.state, func.count())
            .select_from(frame.outerjoin(own, mine))
            .where(frame.c.split == split)
            .group_by(own.c.state)
        )
        found: dict[str | None, int] = dict(self.workspace.database.rows(query))
        done, empty, failed, waiting = (
            found.get(key, 0) for key in ("done", "empty", "failed", None)
        )
        return Counts(done, empty, failed, waiting)

    def complete_frames(self, of: RoundStage, split: str = "unlabeled") -> list[int]:
        """Return the frames that all stages before a round stage have finished, with a label.

        Raises:
            WorkspaceError: if frames wait; failed ones do not wait, they are left out.
        """
        needed = self.graph.before(of)
        frames = self.workspace.frames(split).values()
        with self.workspace.database.reading() as connection:
            states = {other: self._states(connection, other) for other in needed}
        failed = {key for each in states.values() for key, at in each.items() if at == "failed"}
        for other in needed:
            missing = sum(key not in states[other] and key not in failed for key in frames)
            if missing:
                raise WorkspaceError(
                    f"{other.name}: {missing} frames of round {self.context.number} are not done "
                    f"with the current settings; run `curate {other.command}`, or `curate run` for "
                    "all stages"
                )
        return [key for key in frames if all(at.get(key) == "done" for at in states.values())]

    def frames_to_weigh(self, of: RoundStage, policy: str) -> list[int]:
        """Return the complete frames; none while some wait for a policy that uses no label of them.

        Raises:
            WorkspaceError: if frames wait whose labels the policy uses.
        """
        try:
            return self.complete_frames(of)
        except WorkspaceError:
            if open_policy(self.workspace.config, policy).uses_unlabeled:
                raise
            return []

    def round_fingerprint(self, of: RoundStage, policy: str, frames: Sequence[int]) -> str:
        """Return the fingerprint of a round stage together with the frames that it would see."""
        return digest([self.fingerprints(policy)[of.name], list(frames)])

    def round_state(self, of: RoundStage, policy: str) -> str:
        """Return the state of a round stage.

        It is "done", "stale", or "waiting" for its first run or its input.
        """
        what = TaskKey(self.context.number, of.name, policy)
        query = select(bulk.table("task").c.fingerprint).where(*what.conditions())
        stored = self.workspace.database.rows(query)
        if not stored:
            return "waiting"
        try:
            frames = self.frames_to_weigh(of, policy)
        except WorkspaceError:
            return "stale"
        current = self.round_fingerprint(of, policy, frames)
        file = of.file(self.workspace, self.context, policy) if of.file else None
        return "done" if stored == [(current,)] and (file is None or file.exists()) else "stale"

    def require(self, of: RoundStage, policy: str) -> None:
        """Check that the round stages which a stage needs are up to date.

        Raises:
            WorkspaceError: if one is not; the message names the command that runs it.
        """
        for name in of.needs:
            other = self.graph.of_rounds(name)
            if self.round_state(other, policy) != "done":
                number = self.context.number
                chosen = "" if policy == self.workspace.config.run.method else f" --policy {policy}"
                raise WorkspaceError(
                    f"{of.name}: {name} of round {number} for policy {policy} is missing or older "
                    f"than its input; run `curate {other.command} --round {number}{chosen}`"
                )

    def _waiting(self, of: FramesStage, split: str) -> tuple[Select[Any], ColumnElement[bool]]:
        """The query for the frames to work on, and the condition that measurements still hold."""
        query, own = self._ready(of, split)
        current = self.fingerprint(of)
        holds = and_(
            own.c.id.is_not(None),
            func.coalesce(own.c.state, "") == "done",
            func.coalesce(own.c.fingerprint, "").startswith(current.partition(".")[0] + "."),
        )
        undone = or_(own.c.id.is_(None), own.c.fingerprint != current, own.c.state.not_in(FINISHED))
        return query.where(undone), holds

    def _ready(self, of: FramesStage, split: str) -> tuple[Select[Any], Any]:
        """The query for the frames that all earlier stages have finished, and their own tasks."""
        frame = bulk.table("frame")
        own = bulk.table("task").alias("own")
        source = frame.outerjoin(own, self._task_of(own, of))
        empty: list[ColumnElement[bool]] = [false()]
        for other in self.graph.before(of):
            task = bulk.table("task").alias(f"task_{other.name}")
            finished = (task.c.fingerprint == self.fingerprint(other), task.c.state.in_(FINISHED))
            source = source.join(task, and_(self._task_of(task, other), *finished))
            empty.append(task.c.state == "empty")
        query = select(frame.c.id, frame.c.frame, or_(*empty)).select_from(source)
        return query.where(frame.c.split == split), own

    def _frames(self, of: FramesStage, split: str, *, undone: bool) -> list[WaitingFrame]:
        """The frames that all earlier stages have finished; with `undone` those that wait."""
        query = self._waiting(of, split)[0] if undone else self._ready(of, split)[0]
        found = self.workspace.database.rows(query)
        return [WaitingFrame(key, name, bool(empty)) for key, name, empty in found]

    def _failed_before(self, of: FramesStage, split: str) -> set[str]:
        """Return the frames that failed in an earlier stage."""
        with self.workspace.database.reading() as connection:
            states = [self._states(connection, other) for other in self.graph.before(of)]
        failed = {key for each in states for key, state in each.items() if state == "failed"}
        return {name for name, key in self.workspace.frames(split).items() if key in failed}

    def _states(self, connection: Connection, of: FramesStage) -> Mapping[int, str]:
        """Return the state of each frame's task that carries the current fingerprint."""
        task = bulk.table("task")
        query = select(task.c.frame_id, task.c.state).where(
            task.c.round == self.context.number,
            task.c.stage == of.name,
            task.c.fingerprint == self.fingerprint(of),
            task.c.frame_id.is_not(None),
        )
        return dict(bulk.select(connection, query))

    def _task_of(self, task: Any, of: FramesStage) -> ColumnElement[bool]:
        """Return the join of a frame with its task of a stage."""
        return and_(
            task.c.round == self.context.number,
            task.c.stage == of.name,
            task.c.frame_id == bulk.table("frame").c.id,
        )


def is_current(workspace: Workspace, what: TaskKey, fingerprint: str) -> bool:
    """Return whether it has been done with all that it depends on."""
    query = select(bulk.table("task").c.fingerprint).where(*what.conditions())
    return workspace.database.rows(query) == [(fingerprint,)]


def _fingerprint(name: str, settings: Any, reads: Sequence[str], known: Mapping[str, str]) -> str:
    """Return the hash of a stage's settings and of the fingerprints of what it reads."""
    return digest([name, settings, [known[each] for each in reads if each in known]])


def digest(value: Any) -> str:
    """Return a hash of a value made of plain types."""
    text = json.dumps(value, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]
