"""Runs stages: plans by SQL, hands frames to an executor, and is the only writer.

Rows and task states go into one transaction per batch, so a kill at any moment leaves every frame
whole or untouched.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, select

from curate.files.batches import batched
from db import bulk
from pipelines import registry
from pipelines.engine.executors.base import (
    Executor,
    FrameJob,
    FrameRows,
    Job,
    JobFunction,
    Outcome,
    SequenceJob,
)
from pipelines.engine.executors.serial import SerialExecutor
from pipelines.engine.plan import Plan, TaskKey, WaitingFrame, digest, is_current
from pipelines.engine.progress import Progress
from pipelines.engine.stage import (
    FirstStage,
    FramesStage,
    Product,
    ReusableMeasurements,
    RoundJob,
    SequenceStage,
)
from pipelines.workspace.workspace import Workspace

READ_AHEAD = 256  # frames whose earlier rows are read at once
FLUSH_FRAMES = 64
FLUSH_S = 1.0


@dataclass(frozen=True)
class Report:
    """What a stage did.

    Attributes:
        stage: its name.
        round: e.
        done, empty, failed: frames that this run brought into these states.
        kept: frames that had been finished before.
        labels: rows written into the stage's main table.
        seconds: wall-clock time.
        summary: what a round stage says of itself; "" for a frame stage.
        errors: (frame, error) of the failed frames.
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


@contextmanager
def open_executor(workspace: Workspace) -> Iterator[Executor]:
    """The configured executor, whose workers serve several stages."""
    section = workspace.config.run
    executor: Executor = registry.EXECUTORS.build(
        section.executor,
        offered={"workers": lambda: section.workers},
        options=section.executor_options.get(section.executor, {}),
    )
    try:
        yield executor
    finally:
        executor.close()


def run_frames(
    plan: Plan, stage: FramesStage, executor: Executor, progress: Progress, split: str = "unlabeled"
) -> Report:
    """Bring a stage up to date for every frame of a split that can be worked on.

    Raises:
        DatabaseError: if another process works on the round; the message says which.
    """
    database, number = plan.workspace.database, plan.context.number
    with database.claiming_round(number, None, stage.name):
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
                for outcome in _outcomes(plan, stage, split, executor, skip):
                    writer.add(outcome)
                    failed = f"{writer.failed} failed" if writer.failed else ""
                    advance(len(outcome.job.frames), failed)
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


def run_round(plan: Plan, name: str, policy: str, progress: Progress) -> Report:
    """Bring the round stage of that name up to date for a policy.

    Raises:
        WorkspaceError: if a stage that it needs is not up to date.
        DatabaseError: if another process works on the round, or on the same policy in it.
        LeakageError: if what guards the stage does not hold.
    """
    workspace, context, stage = plan.workspace, plan.context, plan.graph.of_rounds(name)
    with workspace.database.claiming_round(context.number, policy, stage.name):
        if stage.guard:
            stage.guard(workspace, context, policy)
        plan.require(stage, policy)
        frames = plan.frames_to_weigh(stage, policy)
        return _run_once(
            workspace,
            TaskKey(context.number, stage.name, policy),
            plan.round_fingerprint(stage, policy, frames),
            stage.file(workspace, context, policy) if stage.file else None,
            lambda: stage.run(workspace, RoundJob(context, policy, frames), progress),
        )


def run_first(workspace: Workspace, stage: FirstStage, progress: Progress) -> Report:
    """Bring a stage that is done once, before the first round, up to date.

    Raises:
        DatabaseError: if another process works on it.
        LeakageError: if what guards the stage does not hold.
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
    what: TaskKey,
    fingerprint: str,
    file: Path | None,
    make: Callable[[], Product],
) -> Report:
    """Does what is done once, unless it has been done with this fingerprint and its file is there.

    Its rows and its task are stored in one transaction.
    """
    start = time.perf_counter()
    if is_current(workspace, what, fingerprint) and (file is None or file.exists()):
        return Report(what.stage, what.round, kept=1, summary="up to date")
    product = make()
    seconds = time.perf_counter() - start
    with workspace.database.writing(keys_known=product.keys_known) as connection:
        product.write(connection)
        connection.execute(bulk.table("task").delete().where(*what.conditions()))
        task = {
            "round": what.round,
            "stage": what.stage,
            "variant": what.variant,
            "fingerprint": fingerprint,
            "state": "done",
            "seconds": seconds,
        }
        bulk.insert_rows(connection, "task", [task])
    return Report(what.stage, what.round, done=1, seconds=seconds, summary=product.summary)


def _outcomes(
    plan: Plan,
    stage: FramesStage,
    split: str,
    executor: Executor,
    skip: Callable[[Sequence[int]], None],
) -> Iterator[Outcome]:
    """Yield the executor works on frames or sequences; frames with valid measurements need none."""
    if isinstance(stage, SequenceStage):
        jobs: Iterator[Job] = _sequence_jobs(plan, plan.waiting_sequences(stage, split))
    else:
        frames = plan.waiting_frames(stage, split, measured=False)
        jobs = _frame_jobs(plan, "prediction" in stage.reads, frames, skip)
    # The models are loaded only where a frame needs them.
    for first in jobs:
        function: JobFunction = stage.function(plan.workspace, plan.context)
        yield from executor.map(function, chain([first], jobs))
    if isinstance(stage, SequenceStage) or not stage.recall:
        return
    frames = plan.waiting_frames(stage, split, measured=True)
    jobs = _frame_jobs(plan, "prediction" in stage.reads, frames, skip, stage.recall)
    for first in jobs:
        rate = stage.recall.function(plan.workspace, plan.context)
        yield from SerialExecutor().map(rate, chain([first], jobs))


def _frame_jobs(
    plan: Plan,
    with_predictions: bool,
    frames: Iterable[WaitingFrame],
    skip: Callable[[Sequence[int]], None],
    recall: ReusableMeasurements | None = None,
) -> Iterator[FrameJob]:
    """Yield the jobs of frames, with their predictions and measurements where they are needed.

    Frames that an earlier stage found empty are not jobs; `skip` records them.
    """
    workspace, context = plan.workspace, plan.context
    for batch in batched(frames, READ_AHEAD):
        if empty := [frame.key for frame in batch if frame.empty]:
            skip(empty)
        keys = [frame.key for frame in batch if not frame.empty]
        found = workspace.predictions(context.number, keys) if with_predictions else {}
        measured = recall.read(workspace, context, keys) if recall else {}
        for frame in batch:
            if not frame.empty:
                key = frame.key
                yield FrameJob(key, frame.name, found.get(key), measured.get(key))


def _sequence_jobs(
    plan: Plan, sequences: Iterable[tuple[str, list[WaitingFrame]]]
) -> Iterator[SequenceJob]:
    """Yield the jobs of sequences, each frame with its predictions, empty ones too."""
    for name, frames in sequences:
        keys = [frame.key for frame in frames]
        found = plan.workspace.predictions(plan.context.number, keys)
        yield SequenceJob(
            name, tuple(FrameJob(frame.key, frame.name, found[frame.key]) for frame in frames)
        )


class _Writer:
    """Collects outcomes and writes them, with their tasks, a batch per transaction."""

    def __init__(self, plan: Plan, stage: FramesStage) -> None:
        self.database = plan.workspace.database
        self.round = plan.context.number
        self.stage = stage
        self.fingerprint = plan.fingerprint(stage)
        self.of_sequences = [
            other.name for other in plan.graph.stages if isinstance(other, SequenceStage)
        ]
        self.done = self.empty = self.failed = self.labels = 0
        self.errors: list[tuple[str, str]] = []
        self._waiting: list[Outcome] = []
        self._flushed = time.monotonic()

    def add(self, outcome: Outcome) -> None:
        """Take an outcome; it is stored with its batch."""
        self._waiting.append(outcome)
        if len(self._waiting) >= FLUSH_FRAMES or time.monotonic() - self._flushed > FLUSH_S:
            self.flush()

    def skip(self, keys: Sequence[int]) -> None:
        """Record frames without predictions as empty."""
        with self.database.writing() as connection:
            self._clear(connection, keys)
            tasks = [self._task(key, "empty", None, 0.0) for key in keys]
            bulk.insert_rows(connection, "task", tasks)
        self.empty += len(keys)

    def flush(self) -> None:
        """Store what has been collected, whole or not at all."""
        outcomes, self._waiting = self._waiting, []
        self._flushed = time.monotonic()
        if not outcomes:
            return
        frames = [pair for outcome in outcomes for pair in _frames_of(outcome)]
        with self.database.writing() as connection:
            self._clear(connection, [job.frame_id for job, _ in frames])
            for table in self.stage.writes:
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
        return "done" if _length(rows.get(self.stage.writes[-1], {})) else "empty"

    def _count(self, outcome: Outcome, job: FrameJob, rows: FrameRows) -> None:
        state = self._state(outcome, rows)
        self.done += state == "done"
        self.empty += state == "empty"
        self.failed += state == "failed"
        self.labels += _length(rows.get(self.stage.writes[-1], {}))
        if outcome.error is not None:
            self.errors.append((job.frame, outcome.error))

    def _clear(self, connection: Connection, keys: Sequence[int]) -> None:
        """Remove what an earlier run stored, and the tasks of all whose rows leave with it.

        All that is known of a frame hangs on its predictions and leaves with them. A task that
        stayed would make the frame count as done once the former settings are back.
        """
        whole = "prediction" in self.stage.writes
        if whole:  # as long as the weights say which policies these are
            self._forget_weights(connection, keys)
        for table in self.stage.writes:
            bulk.delete_frames(connection, table, self.round, keys)
        task = bulk.table("task")
        here = (task.c.round == self.round, task.c.frame_id.in_(keys))
        if not whole:
            connection.execute(task.delete().where(*here, task.c.stage == self.stage.name))
            return
        of_sequences = (task.c.round == self.round, task.c.stage.in_(self.of_sequences))
        touched = select(task.c.variant).where(*of_sequences, task.c.frame_id.in_(keys))
        connection.execute(task.delete().where(*of_sequences, task.c.variant.in_(touched)))
        connection.execute(task.delete().where(*here))

    def _forget_weights(self, connection: Connection, keys: Sequence[int]) -> None:
        """Remove tasks and counts of the policies that have weighed labels of these frames."""
        task, weight, count = map(bulk.table, ("task", "weight", "label_count"))
        weighted = (weight.c.round == self.round, weight.c.frame_id.in_(keys))
        policies = select(weight.c.policy).where(*weighted)
        connection.execute(
            task.delete().where(
                task.c.round == self.round,
                task.c.stage == "solve",
                task.c.variant.in_(policies),
            )
        )
        connection.execute(
            count.delete().where(count.c.round == self.round, count.c.policy.in_(policies))
        )

    def _task(
        self, key: int, state: str, error: str | None, seconds: float, job: Job | None = None
    ) -> dict[str, Any]:
        """Return a row of `task`; its variant is the sequence, for a stage of sequences."""
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
    """Return each frame of an outcome with its rows, which a failed one does not have."""
    rows = outcome.rows or ({},) * len(outcome.job.frames)
    return zip(outcome.job.frames, rows, strict=True)


def _length(columns: Mapping[str, Sequence[Any]]) -> int:
    return len(next(iter(columns.values()), ()))


def _joined(parts: Sequence[tuple[int, Mapping[str, Sequence[Any]]]]) -> dict[str, list[Any]]:
    """Return the columns of several frames below each other, with the key of the frame."""
    joined: dict[str, list[Any]] = {"frame_id": []}
    for key, columns in parts:
        joined["frame_id"] += [key] * _length(columns)
        for name, values in columns.items():
            joined.setdefault(name, []).extend(values)
    return joined
