"""Preview of a run: what it would do, why, and how long it would take. Nothing is written.

A frame would be processed if its task is missing, has failed, or has an outdated fingerprint. A
changed setting changes the fingerprints of all stages that follow, so the tasks are enough to find
these frames. The reason is found by a comparison with the configuration of the round's last run:
either a setting of the stage has changed since, or the stage's input changes.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import median
from typing import Any

from sqlalchemy import func, select

from curate.datasets.base import sequences_of
from curate.errors import CurateError, WorkspaceError
from curate.firewall.sequences import group_by_sequence
from db import bulk
from pipelines.engine.executors.machine import usable_cores
from pipelines.engine.graph import Graph
from pipelines.engine.plan import FINISHED, Plan, TaskKey, digest, is_current
from pipelines.engine.rounds import (
    is_student_trained,
    outside_rounds,
    preview_round,
    recorded_config,
    stored_round,
)
from pipelines.engine.stage import (
    CacheStage,
    FirstStage,
    FramesStage,
    FrameStage,
    RoundContext,
    RoundStage,
    SequenceStage,
    Stage,
)
from pipelines.workspace.config import make_config
from pipelines.workspace.workspace import Workspace

SHOWN_FRAMES = 5
MEASURED_TASKS = 1000
"""Number of a stage's latest tasks from which its speed is estimated."""
NEVER = "never ran"


@dataclass(frozen=True)
class PlannedStage:
    """What a stage would do.

    Attributes:
        round: number e of the round; 0 for a stage before the first round.
        stage: name of the stage.
        frames: number of frames it would process; None for a stage that does not run per frame.
        first_frames: names of the first of them.
        reasons: why it would run; empty if it is up to date.
        seconds: estimated duration, from earlier runs; None if it never ran.
    """

    round: int
    stage: str
    frames: int | None
    first_frames: tuple[str, ...]
    reasons: tuple[str, ...]
    seconds: float | None


@dataclass(frozen=True)
class _Reason:
    """Why a stage would process a frame, and whether its stored measurements are still valid."""

    words: str
    measured: bool = False


def preview_all(workspace: Workspace, graph: Graph, rounds: int | None) -> Iterator[PlannedStage]:
    """Yield, stage by stage, what `run_all` would do with the same arguments."""
    trained = is_student_trained(workspace)
    changing = []
    ahead: dict[str, set[str]] = {}
    for first in graph.first_stages:
        planned = preview_first(workspace, first)
        if planned.reasons:
            changing.append(first.name)
        yield planned
    for number in range(1, ((rounds or workspace.config.run.rounds) if trained else 1) + 1):
        context = None if changing else preview_round(workspace, number, rounds)
        preview = Preview(workspace, graph, number, context, ahead)
        for stage in graph.stages:
            if isinstance(stage, FramesStage):
                yield preview.frames_stage(stage)
            elif isinstance(stage, RoundStage) and (trained or "student" not in stage.writes):
                method = workspace.config.run.method
                if not stage.is_part(workspace, method):
                    continue
                yield from preview.truth(stage, method)
                planned = preview.round_stage(stage, method)
                if planned.reasons and "student" in stage.writes:
                    changing.append(stage.name)
                yield planned


def preview_first(workspace: Workspace, stage: FirstStage) -> PlannedStage:
    """Return what a stage before the first round would do."""
    key, file = TaskKey(0, stage.name, ""), stage.file(workspace)
    reasons: tuple[str, ...] = ()
    if not _has_task(workspace, key):
        reasons = (NEVER,)
    elif not is_current(workspace, key, digest(stage.settings(workspace))):
        reasons = ("its settings or its input changed",)
    elif not file.exists():
        reasons = (f"{workspace.relative(file)} is missing",)
    return PlannedStage(0, stage.name, None, (), reasons, _seconds(workspace, stage, 1, reasons))


class Preview:
    """Preview of the stages of a round.

    Call the methods in the order of the stages: each call takes the changes of the earlier ones
    into account.

    Args:
        workspace: the workspace.
        graph: the stages.
        number: number e of the round.
        context: the round; None if its teacher is not trained yet.
        ahead: the frames that each cache stage would process before this round; those of this
            round are added.
    """

    def __init__(
        self,
        workspace: Workspace,
        graph: Graph,
        number: int,
        context: RoundContext | None,
        ahead: dict[str, set[str]] | None = None,
    ) -> None:
        self._workspace = workspace
        self._ahead = {} if ahead is None else ahead
        self._graph = graph
        self._number = number
        self._plan = None if context is None else Plan(workspace, context, graph)
        self._changing: list[Stage] = []

    def frames_stage(
        self, stage: FramesStage, split: str = "unlabeled", *, alone: bool = False
    ) -> PlannedStage:
        """Return what a stage would do with the frames of a split.

        Args:
            stage: the stage of frames.
            split: split of the frames.
            alone: whether only this stage would run. Frames that an earlier stage has not finished
                are then left out.
        """
        names = self._workspace.frames(split)
        if isinstance(stage, CacheStage):
            found = self._to_be_made(stage, names)
        elif self._plan is None:
            found = dict.fromkeys(names, _Reason("its teacher is still to be trained"))
        else:
            found = self._stale_frames(self._plan, stage, names)
        if found and isinstance(stage, SequenceStage):
            found = self._whole_sequences(names, found)
        if alone:
            waiting = self._waiting_for_others(stage, names)
            found = {name: why for name, why in found.items() if name not in waiting}
        if found:
            self._changing.append(stage)
        counts = Counter(why.words for why in found.values())
        words = tuple(
            reason if len(counts) == 1 else f"{count} frames: {reason}"
            for reason, count in counts.items()
        )
        costly = sum(not why.measured for why in found.values())
        return PlannedStage(
            0 if isinstance(stage, CacheStage) else self._number,
            stage.name,
            len(found),
            tuple(sorted(found)[:SHOWN_FRAMES]),
            words,
            _seconds(self._workspace, stage, costly, words),
        )

    def truth(self, stage: RoundStage, policy: str) -> Iterator[PlannedStage]:
        """Yield what a round stage would do with frames that have ground truth.

        Of folds that do not exist yet, it is only known that their teachers are to be trained.
        """
        if stage.truth is None or self._plan is None:
            return
        try:
            sources = stage.truth(self._workspace, self._plan.context, policy, create=False)
        except WorkspaceError:
            for first in self._graph.first_stages:
                name = f"{first.name} of each fold"
                yield PlannedStage(0, name, None, (), ("there are no folds yet",), None)
            return
        for source in sources:
            context: RoundContext | None = self._plan.context
            if source.workspace is not self._workspace:
                context = stored_round(source.workspace, self._number)
                for first in self._graph.first_stages:
                    planned = preview_first(source.workspace, first)
                    yield replace(planned, stage=f"{planned.stage} {source.title}")
            preview = Preview(source.workspace, self._graph, self._number, context)
            for each in self._graph.frames_stages:
                planned = preview.frames_stage(each, source.split)
                yield replace(planned, stage=f"{planned.stage} {source.title}")

    def round_stage(self, stage: RoundStage, policy: str) -> PlannedStage:
        """Return what a round stage would do for a policy."""
        inputs = self._changing_inputs(stage)
        reasons: tuple[str, ...] = ()
        if self._plan is None:
            reasons = ("its teacher is still to be trained",)
        elif (state := self._plan.round_state(stage, policy)) == "waiting":
            reasons = (NEVER,)
        elif state == "stale":
            file = stage.file and stage.file(self._workspace, self._plan.context, policy)
            if file is not None and not file.exists():
                reasons = (f"{self._workspace.relative(file)} is missing",)
            else:
                reasons = (self._why(stage, policy),)
        elif inputs:
            reasons = (f"its input changes: {', '.join(inputs)}",)
        if reasons:
            self._changing.append(stage)
        seconds = _seconds(self._workspace, stage, 1, reasons)
        return PlannedStage(self._number, stage.name, None, (), reasons, seconds)

    def _to_be_made(self, stage: CacheStage, names: Mapping[str, int]) -> dict[str, _Reason]:
        """Return the frames that a cache stage would process: a reader would process them too."""
        outside = Plan(self._workspace, outside_rounds(self._workspace), self._graph)
        found = self._stale_frames(outside, stage, names)
        if self._plan:
            readers = self._graph.readers(stage)
            stale = [self._stale_frames(self._plan, reader, names) for reader in readers]
            read = {name for each in stale for name, why in each.items() if not why.measured}
            found = {name: why for name, why in found.items() if name in read}
        before = self._ahead.setdefault(stage.name, set())
        found = {name: why for name, why in found.items() if name not in before}
        before |= set(found)
        return found

    def _stale_frames(
        self, plan: Plan, stage: FramesStage, names: Mapping[str, int]
    ) -> dict[str, _Reason]:
        """Return the frames that a stage would process, with the reasons, by name."""
        current, tasks = plan.fingerprint(stage), self._tasks(stage)
        reusable = isinstance(stage, FrameStage) and stage.reusable is not None
        measured = current.partition(".")[0]
        stale = self._why(stage, "") if any(tasks[key][1] != current for key in tasks) else ""
        found = {}
        for name, key in names.items():
            state, fingerprint = tasks.get(key, (None, ""))
            if state is None:
                found[name] = _Reason(NEVER)
            elif fingerprint != current:
                same = fingerprint.partition(".")[0] == measured
                found[name] = _Reason(stale, measured=reusable and state == "done" and same)
            elif state not in FINISHED:
                found[name] = _Reason("failed before")
        return found

    def _tasks(self, stage: FramesStage) -> Mapping[int, tuple[str, str]]:
        """Return, by frame key, state and fingerprint of the stage's tasks."""
        task = bulk.table("task")
        query = select(task.c.frame_id, task.c.state, task.c.fingerprint).where(
            task.c.round == (0 if isinstance(stage, CacheStage) else self._number),
            task.c.stage == stage.name,
            task.c.frame_id.is_not(None),
        )
        rows = self._workspace.database.rows(query)
        return {key: (state, fingerprint) for key, state, fingerprint in rows}

    def _whole_sequences(
        self, names: Mapping[str, int], found: Mapping[str, _Reason]
    ) -> dict[str, _Reason]:
        """Return all frames of the sequences that contain one of the found frames."""
        sequences = sequences_of(self._workspace.dataset, list(names))
        other = _Reason("another frame of its sequence changes")
        return {
            name: found.get(name, other)
            for members in group_by_sequence(sequences, list(names)).values()
            if any(name in found for name in members)
            for name in members
        }

    def _waiting_for_others(self, stage: FramesStage, names: Mapping[str, int]) -> set[str]:
        """Return the frames that an earlier stage has not finished."""
        waiting: set[str] = set()
        for other in self._graph.before(stage):
            current = self._plan.fingerprint(other) if self._plan else ""
            done = {(state, current) for state in FINISHED}
            finished = {key for key, task in self._tasks(other).items() if task in done}
            waiting |= {name for name, key in names.items() if key not in finished}
        return waiting

    def _changing_inputs(self, stage: Stage) -> list[str]:
        """Return the names of the stages that would change the input of a stage."""
        reads = set(stage.reads)
        return [other.name for other in self._changing if reads & set(other.results)]

    def _why(self, stage: FramesStage | RoundStage, policy: str) -> str:
        """Return why the fingerprint of a stage differs from that of its last run."""
        changed = self._changed_settings(stage, policy)
        if changed:
            return f"changed settings: {', '.join(changed)}"
        if self._plan and "teacher" in stage.reads:
            teacher = self._plan.context.teacher.sha256
            if self._recorded_teacher not in (teacher, None):
                return "its teacher changed"
        if inputs := self._changing_inputs(stage):
            return f"its input changes: {', '.join(inputs)}"
        return "its settings or its input changed"

    def _changed_settings(self, stage: FramesStage | RoundStage, policy: str) -> list[str]:
        """Return the settings of a stage that differ from those of the round's last run.

        A stage may use another dotted name than curate.toml. The name from curate.toml is returned
        if a key with the same last part has changed there.
        """
        if self._recorded is None or self._plan is None:
            return []
        try:
            former = _settings(stage, self._recorded, self._plan.context, policy)
        except CurateError:  # a file or class of the former settings may no longer exist
            return []
        now = _settings(stage, self._workspace, self._plan.context, policy)
        changed = {key.rpartition(".")[2] for key in _changes(former, now)}
        sections = (_flat(each.config.model_dump()) for each in (self._recorded, self._workspace))
        keys = [key for key in _changes(*sections) if key.rpartition(".")[2] in changed]
        return keys or sorted(changed)

    @cached_property
    def _recorded(self) -> Workspace | None:
        """The workspace with the settings of the round's last run; None if it has none."""
        document = recorded_config(self._workspace, self._number)
        try:
            config = make_config(document, "the round's configuration") if document else None
        except CurateError:  # it may be of an older curate with other settings
            return None
        return None if config is None else replace(self._workspace, config=config)

    @cached_property
    def _recorded_teacher(self) -> str | None:
        """The hash of the teacher in the round's last run; None if there was none."""
        table, checkpoint = bulk.table("round"), bulk.table("checkpoint")
        query = (
            select(checkpoint.c.sha256)
            .join(table, table.c.teacher_id == checkpoint.c.id)
            .where(table.c.number == self._number)
        )
        found = self._workspace.database.rows(query)
        return found[0][0] if found else None


def _settings(
    stage: FramesStage | RoundStage, workspace: Workspace, context: RoundContext, policy: str
) -> dict[str, Any]:
    """Return the settings of a stage as text, by dotted name."""
    if isinstance(stage, RoundStage):
        return _flat(stage.settings(workspace, context, policy))
    return _flat(stage.settings(workspace, context))


def _flat(settings: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in settings.items():
        inner = isinstance(value, Mapping) and value
        found |= _flat(value, f"{before}{name}.") if inner else {f"{before}{name}": repr(value)}
    return found


def _changes(former: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    return sorted(key for key in {*now, *former} if now.get(key) != former.get(key))


def _has_task(workspace: Workspace, key: TaskKey) -> bool:
    query = select(func.count()).select_from(bulk.table("task")).where(*key.conditions())
    with workspace.database.reading() as connection:
        return bool(connection.execute(query).scalar_one())


def _seconds(
    workspace: Workspace, stage: Stage, count: int, reasons: tuple[str, ...]
) -> float | None:
    """Return the estimated duration of a stage for `count` frames; None if it never ran."""
    if not reasons:
        return 0.0
    task = bulk.table("task")
    query = (
        select(task.c.variant, task.c.seconds)
        .where(task.c.stage == stage.name, task.c.state.in_(FINISHED), task.c.seconds > 0)
        .order_by(task.c.id.desc())
        .limit(MEASURED_TASKS)
    )
    rows = workspace.database.rows(query)
    if not rows:
        return None
    if isinstance(stage, FirstStage | RoundStage):
        return float(rows[0][1])
    workers = workspace.config.run.workers
    workers = usable_cores() if workers == "auto" else workers
    if isinstance(stage, SequenceStage):  # each frame's task has the seconds of the sequence
        whole: dict[str, float] = dict(rows)
        return count * sum(whole.values()) / len(rows) / workers
    # The median, because the first frame of a run takes longer than the others.
    return count * float(median(seconds for _, seconds in rows)) / workers
