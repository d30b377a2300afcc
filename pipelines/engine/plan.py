"""The plan of a round: which frames of which stages are done, and which are stale.

The fingerprint of a stage is a hash of everything that its rows depend on: its settings, and the
fingerprints of the stages that write the tables it reads. A frame is done if its task has the
current fingerprint. Example: `repredict.minimum_iou` changes, a setting of repredict.

    stage       reads                               fingerprint    its frames
    predict     frame, teacher                      a1 -> a1       done
    repredict   frame, teacher, prediction          b1 -> b2       stale
    points      frame, ground_truth, prediction     c1 -> c1       done
    solve       prediction, consistency,            d1 -> d2       stale, since repredict
                point_prior                                        writes consistency

The waiting frames of repredict, in SQL (state is done, empty or failed):

    SELECT ... FROM frame
    LEFT JOIN task AS own_task ON own_task.stage = 'repredict' AND own_task.frame_id = frame.id
    JOIN task AS task_predict ON task_predict.stage = 'predict' AND task_predict.frame_id = frame.id
        AND task_predict.fingerprint = 'a1' AND task_predict.state IN ('done', 'empty')
    WHERE own_task.id IS NULL                              -- the stage never saw this frame
        OR own_task.fingerprint <> 'b2'                    -- it did, with other settings or input
        OR own_task.state NOT IN ('done', 'empty')         -- it failed, and is tried again

    frame    task of predict    task of repredict    waits?
    000001   a1, done           b1, done             yes, stale
    000002   a1, done           b2, done             no
    000003   a1, failed         none                 no, until predict has finished it

A stage with reusable measurements has a fingerprint of two parts, MEASURED.ALL. If only ALL has
changed, e.g. with `semantic.mean`, then the frame's rows are computed again from its stored
measurements, without running the segmenter.

A cache stage has its tasks in round 0, and no other stage depends on them. In a round, its waiting
frames are those that one of its readers is going to process, so that nothing is made in vain.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    Select,
    and_,
    exists,
    false,
    func,
    not_,
    or_,
    select,
)

from curate.datasets.base import sequences_of
from curate.errors import ConfigError, WorkspaceError
from curate.firewall.sequences import group_by_sequence
from db import bulk
from pipelines.assembly import open_policy
from pipelines.engine.graph import Graph
from pipelines.engine.rounds import stored_round
from pipelines.engine.stage import (
    CacheStage,
    FirstStage,
    FramesStage,
    FrameStage,
    RoundContext,
    RoundJob,
    RoundStage,
    TruthFrames,
    TruthSource,
)
from pipelines.workspace.workspace import Workspace

FINISHED = ("done", "empty")
PAGE = 1024  # frames per query


@dataclass(frozen=True)
class Counts:
    """The number of frames of a stage in each state; `waiting` frames are missing or stale."""

    done: int
    empty: int
    failed: int
    waiting: int


@dataclass(frozen=True)
class WaitingFrame:
    """A frame that a stage has to process.

    Attributes:
        key: key of the frame.
        name: name of the frame.
        empty: whether an earlier stage found no objects in it.
    """

    key: int
    name: str
    empty: bool


@dataclass(frozen=True)
class TaskKey:
    """The key of the task of a stage that runs once per round, not per frame.

    Attributes:
        round: number e of the round; 0 for a stage before the first round.
        stage: name of the stage.
        variant: name of the policy; "" if the stage has none.
    """

    round: int
    stage: str
    variant: str

    def conditions(self) -> tuple[ColumnElement[bool], ...]:
        """Return the SQL conditions that select the task's row."""
        task = bulk.table("task")
        values = {"round": self.round, "stage": self.stage, "variant": self.variant}
        return (
            *(task.c[name] == value for name, value in values.items()),
            task.c.frame_id.is_(None),
        )


@dataclass(frozen=True)
class Plan:
    """The state of a round's stages. Fingerprints are computed once per plan.

    Attributes:
        workspace: the workspace.
        context: the round.
        graph: the stages.
    """

    workspace: Workspace
    context: RoundContext
    graph: Graph

    @cached_property
    def _sources(self) -> dict[str, str]:
        """The fingerprints of the inputs that no stage of the round writes."""
        dataset = self.workspace.config.dataset
        cameras = dataset.options.get("cameras")
        return {
            "frame": dataset.kind if cameras is None else f"{dataset.kind} {cameras}",
            "ground_truth": digest([*sorted(self.workspace.frames("labeled")), *self._renamed]),
            "teacher": self.context.teacher.sha256,
        }

    @property
    def _renamed(self) -> Sequence[Any]:
        """The setting `dataset.rename`, if it has a value."""
        rename = self.workspace.config.dataset.rename
        return [rename] if rename else []

    @cached_property
    def _of_frames(self) -> dict[str, str]:
        """The fingerprints of the stages of frames."""
        inputs, prints = dict(self._sources), {}
        for stage in self.graph.frames_stages:
            settings = stage.settings(self.workspace, self.context)
            prints[stage.name] = _fingerprint(stage.name, settings, stage.reads, inputs)
            if isinstance(stage, FrameStage) and stage.reusable:
                settings = stage.reusable.settings(self.workspace, self.context)
                measured = _fingerprint(stage.name, settings, stage.reusable.reads, inputs)
                prints[stage.name] = f"{measured}.{prints[stage.name]}"
            inputs |= dict.fromkeys(stage.results, prints[stage.name])
        return prints

    @cached_property
    def _by_policy(self) -> dict[str, dict[str, str]]:
        return {}

    def fingerprints(self, policy: str) -> Mapping[str, str]:
        """Return the current fingerprint of every stage of the round.

        That of a round stage does not include the frames it reads; `round_fingerprint` adds them.
        """
        if policy not in self._by_policy:
            inputs, prints = dict(self._sources), dict(self._of_frames)
            for stage in self.graph.stages:
                if isinstance(stage, FirstStage):
                    continue
                if isinstance(stage, RoundStage):
                    if not stage.is_part(self.workspace, policy):
                        continue
                    settings = stage.settings(self.workspace, self.context, policy)
                    prints[stage.name] = _fingerprint(stage.name, settings, stage.reads, inputs)
                inputs |= dict.fromkeys(stage.results, prints[stage.name])
            self._by_policy[policy] = prints
        return self._by_policy[policy]

    def renew(self, policy: str) -> None:
        """Compute the fingerprints of a policy anew, because settings may depend on a new result.

        For example, those of solve contain the fingerprint of the calibration.
        """
        self._by_policy.pop(policy, None)

    def round_of(self, stage: FramesStage) -> int:
        """Return the round of a stage's tasks: 0 for a stage that depends on no round."""
        return 0 if isinstance(stage, CacheStage) else self.context.number

    def fingerprint(self, stage: FramesStage) -> str:
        """Return the current fingerprint of a stage of frames.

        A cache without its folder has none, so that all frames are waiting.
        """
        if isinstance(stage, CacheStage) and not stage.exists(self.workspace):
            return ""
        return self._of_frames[stage.name]

    def waiting_frames(
        self, stage: FrameStage | CacheStage, split: str, *, measured: bool
    ) -> Iterator[WaitingFrame]:
        """Yield the frames that a stage has to process.

        These are the frames that all earlier stages have finished, and that this stage has not
        finished with its current fingerprint. They are read in pages, by ranges of their key, so
        that writing the results of one page does not affect the next.

        Args:
            stage: the stage.
            split: split of the frames.
            measured: True for the frames with stored measurements that are still valid, False for
                all other frames.
        """
        frame = bulk.table("frame")
        query, reusable = self._waiting(stage, split)
        query = query.where(reusable if measured else not_(reusable)).order_by(frame.c.id)
        bounds = select(func.min(frame.c.id), func.max(frame.c.id)).where(frame.c.split == split)
        [(lowest, highest)] = self.workspace.database.rows(bounds)
        if lowest is None:
            return
        for first in range(lowest, highest + 1, PAGE):
            page = query.where(frame.c.id.between(first, first + PAGE - 1))
            found = self.workspace.database.rows(page)
            for key, name, empty in found:
                yield WaitingFrame(key, name, bool(empty))

    def waiting_sequences(
        self, stage: FramesStage, split: str
    ) -> Iterator[tuple[str, list[WaitingFrame]]]:
        """Yield the sequences that a stage has to process, each with all its frames sorted by name.

        A sequence is yielded if one of its frames is waiting, and all of them have been finished by
        the earlier stages. Frames that failed in an earlier stage are left out.
        """
        waiting = {frame.name for frame in self._frames(stage, split, undone=True)}
        ready = {frame.name: frame for frame in self._frames(stage, split, undone=False)}
        failed = self._failed_before(stage, split)
        names = self.workspace.frames(split)
        sequences = sequences_of(self.workspace.dataset, names)
        for sequence, members in group_by_sequence(sequences, names).items():
            usable = sorted(name for name in members if name not in failed)
            if waiting & set(usable) and all(name in ready for name in usable):
                yield sequence, [ready[name] for name in usable]

    def count_waiting(self, stage: FramesStage, split: str) -> int:
        """Return the number of frames that a stage has to process now."""
        query, _ = self._waiting(stage, split)
        found = self.workspace.database.rows(select(func.count()).select_from(query.subquery()))
        return int(found[0][0])

    def counts(self, stage: FramesStage, split: str) -> Counts:
        """Return the number of frames of a split in each state of a stage."""
        frame, own_task = bulk.table("frame"), bulk.table("task").alias("own_task")
        current = own_task.c.fingerprint == self.fingerprint(stage)
        query = (
            select(own_task.c.state, func.count())
            .select_from(frame.outerjoin(own_task, and_(self._task_of(own_task, stage), current)))
            .where(frame.c.split == split)
            .group_by(own_task.c.state)
        )
        found: dict[str | None, int] = dict(self.workspace.database.rows(query))
        done, empty, failed, waiting = (
            found.get(key, 0) for key in ("done", "empty", "failed", None)
        )
        return Counts(done, empty, failed, waiting)

    def complete_frames(self, stage: RoundStage, split: str = "unlabeled") -> list[int]:
        """Return the keys of the frames with labels that all stages before have finished.

        Frames that failed are left out.

        Raises:
            WorkspaceError: if an earlier stage has not processed some frames.
        """
        needed = self.graph.before(stage)
        frames = self.workspace.frames(split).values()
        with self.workspace.database.reading() as connection:
            states = {other: self._states(connection, other) for other in needed}
        failed = {key for each in states.values() for key, at in each.items() if at == "failed"}
        for other in needed:
            missing = sum(key not in states[other] and key not in failed for key in frames)
            if missing:
                raise WorkspaceError(
                    f"{other.name}: {missing} frames of round {self.context.number} are missing "
                    f"or out of date; run `curate {other.command}`, or `curate run` for all stages"
                )
        return [key for key in frames if all(at.get(key) == "done" for at in states.values())]

    def frames_to_weight(self, stage: RoundStage, policy: str) -> list[int]:
        """Return the complete frames, see `complete_frames`.

        For a policy that uses no pseudo-labels the list is empty if some frames are not complete.

        Raises:
            WorkspaceError: if frames are not complete and the policy uses their labels.
        """
        try:
            return self.complete_frames(stage)
        except WorkspaceError:
            if open_policy(self.workspace.config, policy).uses_unlabeled:
                raise
            return []

    def job(self, stage: RoundStage, policy: str) -> RoundJob:
        """Return the input of a round stage.

        Raises:
            WorkspaceError: if an earlier stage has not processed some of its frames.
        """
        if stage.truth is None:
            return RoundJob(self.context, policy, self.frames_to_weight(stage, policy))
        sources = stage.truth(self.workspace, self.context, policy, create=False)
        truth = tuple(self.of_source(source).truth_frames(stage, source) for source in sources)
        return RoundJob(self.context, policy, (), truth)

    def of_source(self, source: TruthSource) -> "Plan":
        """Return the plan of the same round for frames with ground truth.

        Raises:
            WorkspaceError: if their teacher does not exist yet.
        """
        context: RoundContext | None = self.context
        if source.workspace is not self.workspace:
            context = stored_round(source.workspace, self.context.number)
        if context is None:
            raise WorkspaceError(f"{source.workspace.root}: its teacher does not exist yet")
        return Plan(source.workspace, replace(context, split=source.split), self.graph)

    def truth_frames(self, stage: RoundStage, source: TruthSource) -> TruthFrames:
        """Return the complete frames of a source, see `complete_frames`."""
        frames = self.complete_frames(stage, source.split)
        prints = [self.fingerprint(other) for other in self.graph.before(stage)]
        return TruthFrames(source, self.context, frames, prints)

    def round_fingerprint(self, stage: RoundStage, job: RoundJob) -> str:
        """Return the fingerprint of a round stage together with the frames that it reads."""
        truth = [[each.source.title, each.fingerprints, each.frames] for each in job.truth]
        frames = list(job.frames)
        return digest([self.fingerprints(job.policy)[stage.name], frames, *truth])

    def round_state(self, stage: RoundStage, policy: str) -> str:
        """Return the state of a round stage: "done", "stale", or "waiting" if it never ran."""
        key = TaskKey(self.context.number, stage.name, policy)
        query = select(bulk.table("task").c.fingerprint).where(*key.conditions())
        stored = self.workspace.database.rows(query)
        if not stored:
            return "waiting"
        try:
            job = self.job(stage, policy)
        except (ConfigError, WorkspaceError):
            return "stale"
        current = self.round_fingerprint(stage, job)
        file = stage.file(self.workspace, self.context, policy) if stage.file else None
        return "done" if stored == [(current,)] and (file is None or file.exists()) else "stale"

    def require(self, stage: RoundStage, policy: str) -> None:
        """Check that the round stages in `stage.needs` are up to date.

        Raises:
            WorkspaceError: if one is not; the message has the command that runs it.
        """
        for name in stage.needs:
            other = self.graph.round_stage(name)
            if not other.is_part(self.workspace, policy):
                continue
            if self.round_state(other, policy) != "done":
                number = self.context.number
                option = "" if policy == self.workspace.config.run.method else f" --policy {policy}"
                raise WorkspaceError(
                    f"{stage.name}: {name} of round {number} for policy {policy} is missing or "
                    "older than its input; run "
                    f"`curate {other.command} --round {number}{option}`"
                )

    def _waiting(self, stage: FramesStage, split: str) -> tuple[Select[Any], ColumnElement[bool]]:
        """Return the query for waiting frames, and the condition for reusable measurements.

        The condition is never null, so that its negation selects all other frames.
        """
        query, own_task = self._ready(stage, split)
        current = self.fingerprint(stage)
        undone = or_(
            own_task.c.id.is_(None),
            own_task.c.fingerprint != current,
            own_task.c.state.not_in(FINISHED),
        )
        query = query.where(undone)
        if isinstance(stage, CacheStage):
            query = query.where(or_(*map(self._will_read, self.graph.readers(stage))))
        return query, self._is_measured(own_task, stage)

    def _is_measured(self, task: Any, stage: FramesStage) -> ColumnElement[bool]:
        """Return the condition that a task's measurements are still valid; it is never null."""
        measured = self.fingerprint(stage).partition(".")[0]
        return and_(
            task.c.id.is_not(None),
            func.coalesce(task.c.state, "") == "done",
            func.coalesce(task.c.fingerprint, "").startswith(f"{measured}."),
        )

    def _will_read(self, reader: FramesStage) -> ColumnElement[bool]:
        """Return the condition that a stage has yet to read a frame, with what a cache holds."""
        task = bulk.table("task").alias(f"task_{reader.name}")
        finished = and_(task.c.fingerprint == self.fingerprint(reader), task.c.state.in_(FINISHED))
        read = or_(finished, self._is_measured(task, reader))
        return not_(exists().where(self._task_of(task, reader), read))

    def _ready(self, stage: FramesStage, split: str) -> tuple[Select[Any], Any]:
        """Return the query for frames that all earlier stages have finished, and the stage's tasks.

        The tasks are a table in the query, for further conditions.
        """
        frame = bulk.table("frame")
        own_task = bulk.table("task").alias("own_task")
        source = frame.outerjoin(own_task, self._task_of(own_task, stage))
        empty: list[ColumnElement[bool]] = [false()]
        for other in self.graph.before(stage):
            task = bulk.table("task").alias(f"task_{other.name}")
            finished = (task.c.fingerprint == self.fingerprint(other), task.c.state.in_(FINISHED))
            source = source.join(task, and_(self._task_of(task, other), *finished))
            empty.append(task.c.state == "empty")
        query = select(frame.c.id, frame.c.frame, or_(*empty)).select_from(source)
        return query.where(frame.c.split == split), own_task

    def _frames(self, stage: FramesStage, split: str, *, undone: bool) -> list[WaitingFrame]:
        """Return the frames that all earlier stages have finished, or only the waiting ones."""
        query = self._waiting(stage, split)[0] if undone else self._ready(stage, split)[0]
        found = self.workspace.database.rows(query)
        return [WaitingFrame(key, name, bool(empty)) for key, name, empty in found]

    def _failed_before(self, stage: FramesStage, split: str) -> set[str]:
        """Return the names of the frames that failed in an earlier stage."""
        with self.workspace.database.reading() as connection:
            states = [self._states(connection, other) for other in self.graph.before(stage)]
        failed = {key for each in states for key, state in each.items() if state == "failed"}
        return {name for name, key in self.workspace.frames(split).items() if key in failed}

    def _states(self, connection: Connection, stage: FramesStage) -> Mapping[int, str]:
        """Return, by frame key, the states of the tasks with the current fingerprint."""
        task = bulk.table("task")
        query = select(task.c.frame_id, task.c.state).where(
            task.c.round == self.round_of(stage),
            task.c.stage == stage.name,
            task.c.fingerprint == self.fingerprint(stage),
            task.c.frame_id.is_not(None),
        )
        return dict(bulk.select(connection, query))

    def _task_of(self, task: Any, stage: FramesStage) -> ColumnElement[bool]:
        """Return the condition that joins a frame with its task of a stage."""
        return and_(
            task.c.round == self.round_of(stage),
            task.c.stage == stage.name,
            task.c.frame_id == bulk.table("frame").c.id,
        )


def is_current(workspace: Workspace, key: TaskKey, fingerprint: str) -> bool:
    """Return whether the task is stored with this fingerprint."""
    query = select(bulk.table("task").c.fingerprint).where(*key.conditions())
    return workspace.database.rows(query) == [(fingerprint,)]


def _fingerprint(name: str, settings: Any, reads: Sequence[str], inputs: Mapping[str, str]) -> str:
    """Return the hash of a stage's settings and of the fingerprints of its inputs."""
    return digest([name, settings, [inputs[each] for each in reads if each in inputs]])


def digest(value: Any) -> str:
    """Return a hash of a value made of plain types."""
    text = json.dumps(value, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]
