"""Running stages: find the stale frames, process them in an executor, and write the results.

The process that runs a stage is its only writer. Rows and task states of a batch are written in one
transaction, so a frame is stored completely or not at all, even if the process is killed.
"""

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from sqlalchemy import ColumnElement, Connection, Table, exists, select

from curate.detections import Detections
from curate.errors import WorkspaceError
from curate.files.batches import batched
from db import bulk
from db.claims import Resource, round_resources
from pipelines import registry
from pipelines.engine.executors.base import (
    Executor,
    FrameJob,
    FrameRows,
    JobFunction,
    Outcome,
    Part,
    SequenceJob,
)
from pipelines.engine.executors.serial import SerialExecutor
from pipelines.engine.mapping import map_frames
from pipelines.engine.plan import Plan, TaskKey, WaitingFrame, digest, is_current
from pipelines.engine.progress import Progress
from pipelines.engine.stage import (
    CacheStage,
    FirstStage,
    FramesStage,
    FrameStage,
    Product,
    SequenceStage,
    Stage,
    StoredRows,
)
from pipelines.workspace.workspace import Workspace

_log = logging.getLogger(__name__)

READ_AHEAD = 256  # frames per query of predictions and measurements
FLUSH_FRAMES = 64
FLUSH_S = 1.0


@dataclass(frozen=True)
class Report:
    """What a run of a stage did.

    Attributes:
        stage: name of the stage.
        round: number e of the round.
        done, empty, failed: numbers of frames that this run processed, by their state.
        kept: number of frames that were finished before.
        labels: number of rows written into the stage's main table.
        seconds: wall-clock time.
        summary: summary of a round stage's result; "" for a stage of frames.
        errors: (frame name, error) of the failed frames.
        missing: failed frames that are not in an export.
    """

    stage: str
    round: int
    done: int = 0
    empty: int = 0
    failed: int = 0
    kept: int = 0
    labels: int = 0
    seconds: float = 0.0
    summary: str = ""
    errors: tuple[tuple[str, str], ...] = ()
    missing: tuple[str, ...] = ()


@contextmanager
def open_executor(workspace: Workspace) -> Iterator[Executor]:
    """Yield the configured executor, which can run several stages with the same workers."""
    section = workspace.config.run
    executor: Executor = registry.EXECUTORS.build(
        section.executor,
        offered={"workers": lambda: None if section.workers == "auto" else section.workers},
        options=section.executor_options.get(section.executor, {}),
    )
    try:
        yield executor
    finally:
        executor.close()


def check_inputs(plan: Plan, stages: Iterable[Stage], split: str = "unlabeled") -> None:
    """Check the input of stages that have work, before any of them runs.

    Raises:
        CurateError: if it is missing or wrong.
    """
    for stage in stages:
        if isinstance(stage, FramesStage) and stage.ready:
            counts = plan.counts(stage, split)
            if counts.waiting or counts.failed:
                stage.ready(plan.workspace, plan.context, split)


def check_claims(plan: Plan, stages: Iterable[FramesStage]) -> None:
    """Check that no other process works on the round of the stages.

    Raises:
        DatabaseError: if one does; the message says which one.
    """
    for stage in stages:
        with plan.workspace.database.claiming(_resources(plan, stage), stage.name):
            pass


def check_earlier_stages(plan: Plan, stages: Sequence[FramesStage], split: str) -> None:
    """Check that stages that run alone have frames to work on; warn of those that must wait.

    Raises:
        WorkspaceError: if an earlier stage has not processed any of the frames that are left.
    """
    names = {stage.name for stage in stages}
    for stage in stages:
        for other in plan.graph.before(stage):
            waiting = 0 if other.name in names else plan.counts(other, split).waiting
            if not waiting:
                continue
            options = "" if split == "unlabeled" else f" --split {split}"
            message = (
                f"{stage.name}: {other.name} of {waiting} {split} frames in round "
                f"{plan.context.number} is missing or out of date; run `curate {other.command}"
                f"{options}` first, or `curate run` for all stages"
            )
            if not plan.count_waiting(stage, split):
                raise WorkspaceError(message)
            _log.warning("%s", message)


def run_frames(
    plan: Plan, stage: FramesStage, executor: Executor, progress: Progress, split: str = "unlabeled"
) -> Report:
    """Bring a stage up to date for all frames of a split that the earlier stages have finished.

    Raises:
        DatabaseError: if another process works on the round; the message says which one.
    """
    number = plan.round_of(stage)
    with plan.workspace.database.claiming(_resources(plan, stage), stage.name):
        start = time.perf_counter()
        if stage.prepare:
            stage.prepare(plan.workspace)
        total = plan.count_waiting(stage, split)
        before = plan.counts(stage, split)
        writer = _Writer(plan, stage)
        with progress.track(stage.name, total) as advance:

            def skip(keys: Sequence[int]) -> None:
                writer.skip(keys)
                advance(len(keys), "")

            if total:
                try:
                    for outcome in _outcomes(plan, stage, split, total, executor, skip):
                        writer.add(outcome)
                        failed = f"{writer.failed} failed" if writer.failed else ""
                        advance(len(outcome.job.frames), failed)
                finally:  # also after an error or Ctrl-C: finished frames are kept
                    writer.flush()
        return Report(
            stage=stage.name,
            round=number,
            done=writer.done,
            empty=writer.empty,
            failed=writer.failed,
            kept=before.done + before.empty,
            labels=writer.labels,
            seconds=time.perf_counter() - start,
            errors=tuple(writer.errors),
        )


def _resources(plan: Plan, stage: FramesStage) -> Sequence[Resource]:
    """Return what a stage of frames claims; a cache stage may run beside those of all rounds."""
    number = plan.round_of(stage)
    return [Resource(f"stage {stage.name}")] if number == 0 else round_resources(number)


def run_round(plan: Plan, name: str, policy: str, progress: Progress) -> Report:
    """Bring the round stage with this name up to date for a policy.

    Raises:
        WorkspaceError: if a stage that it needs is not up to date.
        DatabaseError: if another process works on the round, or on the same policy in it.
        LeakageError: if the stage's guard finds data leakage.
    """
    workspace, context, stage = plan.workspace, plan.context, plan.graph.round_stage(name)
    with workspace.database.claiming_round(context.number, policy, stage.name):
        if stage.guard:
            stage.guard(workspace, context, policy)
        plan.require(stage, policy)
        job = plan.job(stage, policy)
        report = _run_once(
            workspace,
            TaskKey(context.number, stage.name, policy),
            plan.round_fingerprint(stage, job),
            stage.file(workspace, context, policy) if stage.file else None,
            lambda: stage.run(workspace, job, progress),
        )
        plan.renew(policy)
        return report


def run_first(workspace: Workspace, stage: FirstStage, progress: Progress) -> Report:
    """Bring a stage that runs once, before the first round, up to date.

    Raises:
        DatabaseError: if another process works on it.
        LeakageError: if the stage's guard finds data leakage.
    """
    settings = stage.settings(workspace)
    with workspace.database.claiming_round(0, None, stage.name):
        stage.guard(workspace)
        return _run_once(
            workspace,
            TaskKey(0, stage.name, ""),
            digest(settings),
            stage.file(workspace),
            lambda: stage.run(workspace, progress),
        )


def _run_once(
    workspace: Workspace,
    key: TaskKey,
    fingerprint: str,
    file: Path | None,
    make: Callable[[], Product],
) -> Report:
    """Run a task that has no frames, unless it is stored with this fingerprint and its file exists.

    Its rows and its task are stored in one transaction.
    """
    start = time.perf_counter()
    if is_current(workspace, key, fingerprint) and (file is None or file.exists()):
        return Report(key.stage, key.round, kept=1, summary="up to date")
    product = make()
    seconds = time.perf_counter() - start
    with workspace.database.writing(keys_known=product.keys_known) as connection:
        product.write(connection)
        connection.execute(bulk.table("task").delete().where(*key.conditions()))
        task = {
            "round": key.round,
            "stage": key.stage,
            "variant": key.variant,
            "fingerprint": fingerprint,
            "state": "done",
            "seconds": seconds,
        }
        bulk.insert_rows(connection, "task", [task])
    return Report(
        key.stage,
        key.round,
        done=1,
        seconds=seconds,
        summary=product.summary,
        missing=product.missing,
    )


def _outcomes(
    plan: Plan,
    stage: FramesStage,
    split: str,
    total: int,
    executor: Executor,
    skip: Callable[[Sequence[int]], None],
) -> Iterator[Outcome]:
    """Yield the outcomes of all waiting frames or sequences.

    Frames with reusable measurements are processed last and in this process, without the executor.
    """
    if isinstance(stage, SequenceStage):
        jobs: Iterator[Part] = _sequence_jobs(plan, stage, plan.waiting_sequences(stage, split))
    else:
        frames = plan.waiting_frames(stage, split, measured=False)
        stored = stage.stored if isinstance(stage, FrameStage) else None
        jobs = _frame_jobs(plan, stage, frames, skip, stored)
        executor = SerialExecutor() if stored else executor
        if isinstance(stage, CacheStage):
            jobs = _until_refused(jobs, stage, plan.workspace)
    # Load the models only if there is a first job.
    for first in jobs:
        function: JobFunction = stage.function(plan.workspace, plan.context)
        yield from map_frames(executor, function, chain([first], jobs), total)
    if not isinstance(stage, FrameStage) or not stage.reusable:
        return
    frames = plan.waiting_frames(stage, split, measured=True)
    jobs = _frame_jobs(plan, stage, frames, skip, stage.reusable.read)
    for first in jobs:
        function = stage.reusable.function(plan.workspace, plan.context)
        yield from SerialExecutor().map(function, chain([first], jobs))


def _until_refused(
    jobs: Iterable[FrameJob], stage: CacheStage, workspace: Workspace
) -> Iterator[FrameJob]:
    """Yield jobs while the stage can store what it makes; then report why it cannot."""
    refusal = stage.refusal(workspace)
    for job in jobs:
        if reason := refusal():
            _log.warning("%s ends early: %s; nothing is lost", stage.name, reason)
            return
        yield job


def _frame_jobs(
    plan: Plan,
    stage: FramesStage,
    frames: Iterable[WaitingFrame],
    skip: Callable[[Sequence[int]], None],
    stored: StoredRows | None = None,
) -> Iterator[FrameJob]:
    """Yield the jobs of frames, with the boxes and the stored rows that the stage needs.

    Frames that an earlier stage found empty get no job; `skip` records them as empty.
    """
    workspace, context = plan.workspace, plan.context
    for batch in batched(frames, READ_AHEAD):
        if empty := [frame.key for frame in batch if frame.empty]:
            skip(empty)
        keys = [frame.key for frame in batch if not frame.empty]
        found = _boxes(plan, stage, keys)
        measured = stored(workspace, context, keys) if stored else {}
        for frame in batch:
            if not frame.empty:
                key = frame.key
                yield FrameJob(key, frame.name, found.get(key), measured.get(key))


def _boxes(plan: Plan, stage: FramesStage, keys: Sequence[int]) -> Mapping[int, Detections]:
    """Return the boxes that a stage reads, by frame key: of predictions, fused ones, or none."""
    workspace, number = plan.workspace, plan.context.number
    if "fused_box" in stage.reads:
        return workspace.labels(number, keys)
    return workspace.predictions(number, keys) if "prediction" in stage.reads else {}


def _sequence_jobs(
    plan: Plan, stage: SequenceStage, sequences: Iterable[tuple[str, list[WaitingFrame]]]
) -> Iterator[SequenceJob]:
    """Yield the jobs of sequences, with the predictions of each frame; frames may be empty."""
    for name, frames in sequences:
        keys = [frame.key for frame in frames]
        found = _boxes(plan, stage, keys)
        yield SequenceJob(
            name, tuple(FrameJob(frame.key, frame.name, found[frame.key]) for frame in frames)
        )


class _Writer:
    """Collects outcomes and writes them with their tasks, one transaction per batch."""

    def __init__(self, plan: Plan, stage: FramesStage) -> None:
        self._database = plan.workspace.database
        self.round = plan.round_of(stage)
        self.stage = stage
        self.fingerprint = plan.fingerprint(stage)
        self._sequence_stages = [
            other.name for other in plan.graph.stages if isinstance(other, SequenceStage)
        ]
        self.done = self.empty = self.failed = self.labels = 0
        self.errors: list[tuple[str, str]] = []
        self._pending: list[Outcome] = []
        self._flushed = time.monotonic()

    def add(self, outcome: Outcome) -> None:
        """Add an outcome to the batch, and write the batch if it is due."""
        unstored = outcome.error is None and not any(outcome.rows)
        if isinstance(self.stage, CacheStage) and unstored:
            return  # the frame stays waiting
        self._pending.append(outcome)
        if outcome.ends_job and (
            len(self._pending) >= FLUSH_FRAMES or time.monotonic() - self._flushed > FLUSH_S
        ):
            self.flush()

    def skip(self, keys: Sequence[int]) -> None:
        """Record frames without predictions as empty."""
        with self._database.writing() as connection:
            self._clear(connection, keys)
            tasks = [self._task(key, "empty", None, 0.0) for key in keys]
            bulk.insert_rows(connection, "task", tasks)
        self.empty += len(keys)

    def flush(self) -> None:
        """Write the batch in one transaction."""
        outcomes, self._pending = self._pending, []
        self._flushed = time.monotonic()
        if not outcomes:
            return
        frames = [pair for outcome in outcomes for pair in _frames_of(outcome)]
        with self._database.writing() as connection:
            self._clear(connection, [job.frame_id for job, _ in frames])
            for table in self.stage.results:
                columns = _joined([(job.frame_id, rows.get(table, {})) for job, rows in frames])
                if columns["frame_id"]:
                    bulk.insert(connection, table, {"round": self.round, **columns})
            tasks = [
                self._task(job.frame_id, state, outcome.error, outcome.seconds, outcome.job)
                for outcome in outcomes
                for job, rows in _frames_of(outcome)
                for state in [self._state(outcome, rows)]
            ]
            bulk.insert_rows(connection, "task", tasks)
        for outcome in outcomes:
            for job, rows in _frames_of(outcome):
                self._count(outcome, job, rows)

    def _state(self, outcome: Outcome, rows: FrameRows) -> str:
        if outcome.error is not None:
            return "failed"
        return "done" if self._rows(rows) or not self.stage.results else "empty"

    def _rows(self, rows: FrameRows) -> int:
        """Return the number of rows of a frame in the stage's main table."""
        return sum(_length(rows.get(table, {})) for table in self.stage.results[-1:])

    def _count(self, outcome: Outcome, job: FrameJob, rows: FrameRows) -> None:
        state = self._state(outcome, rows)
        self.done += state == "done"
        self.empty += state == "empty"
        self.failed += state == "failed"
        self.labels += self._rows(rows)
        if outcome.error is not None:
            self.errors.append((job.frame, outcome.error))

    def _clear(self, connection: Connection, keys: Sequence[int]) -> None:
        """Delete the stage's former rows of these frames, and the tasks that lost their rows.

        Deleting predictions deletes all evidence and weights of the frame by foreign keys. If a
        task of such evidence stayed, the frame would count as done after a change back to the
        former settings.
        """
        whole = "prediction" in self.stage.results
        if whole:  # first: the weights, which are deleted below, show which policies are affected
            self._delete_weight_tasks(connection, keys)
            self._delete_calibration_tasks(connection, keys)
        for table in self.stage.results:
            bulk.delete_frames(connection, table, self.round, keys)
        task = bulk.table("task")
        here = (task.c.round == self.round, task.c.frame_id.in_(keys))
        if not whole:
            connection.execute(task.delete().where(*here, task.c.stage == self.stage.name))
            return
        sequence_tasks = (task.c.round == self.round, task.c.stage.in_(self._sequence_stages))
        touched = select(task.c.variant).where(*sequence_tasks, task.c.frame_id.in_(keys))
        connection.execute(task.delete().where(*sequence_tasks, task.c.variant.in_(touched)))
        connection.execute(task.delete().where(*here))

    def _delete_weight_tasks(self, connection: Connection, keys: Sequence[int]) -> None:
        """Delete tasks and counts of the policies that have weighted labels of these frames."""
        task, weight, count = map(bulk.table, ("task", "weight", "label_count"))
        weighted = (weight.c.round == self.round, weight.c.frame_id.in_(keys))
        policies = select(weight.c.policy).where(*weighted)
        connection.execute(
            task.delete().where(
                *self._of_the_round(task, "solve"),
                task.c.variant.in_(policies),
            )
        )
        connection.execute(
            count.delete().where(count.c.round == self.round, count.c.policy.in_(policies))
        )

    def _delete_calibration_tasks(self, connection: Connection, keys: Sequence[int]) -> None:
        """Delete the calibrations with held-out labels of these frames."""
        task, label = map(bulk.table, ("task", "calibration_label"))
        held_out = exists().where(label.c.round == self.round, label.c.frame_id.in_(keys))
        connection.execute(task.delete().where(*self._of_the_round(task, "calibrate"), held_out))

    def _of_the_round(self, task: Table, stage: str) -> tuple[ColumnElement[bool], ...]:
        """Return the conditions for the tasks of a round stage, in the form of their index."""
        return task.c.round == self.round, task.c.stage == stage, task.c.frame_id.is_(None)

    def _task(
        self, key: int, state: str, error: str | None, seconds: float, job: Part | None = None
    ) -> dict[str, Any]:
        """Return a row of `task`; for a stage of sequences its variant is the sequence."""
        return {
            "round": self.round,
            "stage": self.stage.name,
            "variant": job.name if isinstance(job, SequenceJob) else "",
            "frame_id": key,
            "fingerprint": self.fingerprint,
            "state": state,
            "error": error,
            "seconds": seconds,
        }


def _frames_of(outcome: Outcome) -> Iterator[tuple[FrameJob, FrameRows]]:
    """Return each frame of an outcome with its rows; a failed one has no rows."""
    rows = outcome.rows or ({},) * len(outcome.job.frames)
    return zip(outcome.job.frames, rows, strict=True)


def _length(columns: Mapping[str, Sequence[Any]]) -> int:
    return len(next(iter(columns.values()), ()))


def _joined(parts: Sequence[tuple[int, Mapping[str, Sequence[Any]]]]) -> dict[str, list[Any]]:
    """Return the concatenated columns of several frames, with the frame's key in each row."""
    joined: dict[str, list[Any]] = {"frame_id": []}
    for key, columns in parts:
        joined["frame_id"] += [key] * _length(columns)
        for name, values in columns.items():
            joined.setdefault(name, []).extend(values)
    return joined
