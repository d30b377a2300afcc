"""Runs stages: plans by SQL, hands frames to an executor, and is the only writer.

Rows and task states go into one transaction per batch, so a kill at any moment leaves every frame
whole or untouched.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from sqlalchemy import Connection, select

from curate.files.batches import batched
from db import bulk
from pipelines import registry
from pipelines.engine import plan
from pipelines.engine.executors.base import Executor, FrameJob, Outcome
from pipelines.engine.executors.serial import SerialExecutor
from pipelines.engine.progress import Progress
from pipelines.engine.stage import FrameStage, Product, Recall, RoundContext, RoundJob, RoundStage
from pipelines.round import unaffected
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
    workspace: Workspace,
    context: RoundContext,
    stage: FrameStage,
    executor: Executor,
    progress: Progress,
    *,
    split: str = "unlabeled",
) -> Report:
    """Brings a stage up to date for every frame of a split that can be worked on.

    Raises:
        DatabaseError: another process works on the round; the message says who.
    """
    with workspace.database.claiming_round(context.number, None, stage.name):
        return _run_frames(workspace, context, stage, executor, progress, split)


def _run_frames(
    workspace: Workspace,
    context: RoundContext,
    stage: FrameStage,
    executor: Executor,
    progress: Progress,
    split: str,
) -> Report:
    start = time.perf_counter()
    total = plan.count_waiting(workspace, context, stage, split)
    before = plan.counts(workspace, context, stage, split)
    writer = _Writer(workspace, context, stage)
    with progress.track(stage.name, total) as advance:

        def skip(keys: Sequence[int]) -> None:
            writer.skip(keys)
            advance(len(keys), "")

        if total:
            for outcome in _outcomes(workspace, context, stage, split, executor, skip):
                writer.add(outcome)
                advance(1, f"{writer.failed} failed" if writer.failed else "")
            writer.flush()
    return Report(
        stage=stage.name,
        round=context.number,
        done=writer.done,
        empty=writer.empty,
        failed=writer.failed,
        kept=before.done + before.empty,
        labels=writer.labels,
        seconds=time.perf_counter() - start,
        errors=tuple(writer.errors),
    )


def run_round(
    workspace: Workspace, context: RoundContext, stage: RoundStage, policy: str, progress: Progress
) -> Report:
    """Brings a round stage up to date for a policy.

    Raises:
        DatabaseError: another process works on the round, or on the same policy in it.
        LeakageError: what guards the stage does not hold.
    """
    with workspace.database.claiming_round(context.number, policy, stage.name):
        if stage.guard:
            stage.guard(workspace, context, policy)
        frames = plan.frames_to_weigh(workspace, context, policy)
        return run_once(
            workspace,
            plan.Once(context.number, stage.name, policy),
            plan.round_fingerprint(workspace, context, stage, policy, frames),
            stage.file(workspace, context, policy) if stage.file else None,
            lambda: stage.run(workspace, RoundJob(context, policy, frames), progress),
        )


def run_once(
    workspace: Workspace,
    what: plan.Once,
    fingerprint: str,
    file: Path | None,
    make: Callable[[], Product],
) -> Report:
    """Does what is done once, unless it has been done with this fingerprint and its file is there.

    Its rows and its task are stored in one transaction.
    """
    start = time.perf_counter()
    if plan.is_current(workspace, what, fingerprint) and (file is None or file.exists()):
        return Report(what.stage, what.round, kept=1, summary="up to date")
    product = make()
    seconds = time.perf_counter() - start
    with workspace.database.writing(keys_known=product.keys_known) as connection:
        product.write(connection)
        connection.execute(bulk.table("task").delete().where(*what.conditions()))
        row = (what.round, what.stage, what.variant, None, fingerprint, "done", None, seconds)
        bulk.insert(connection, "task", [row])
    return Report(what.stage, what.round, done=1, seconds=seconds, summary=product.summary)


def _outcomes(
    workspace: Workspace,
    context: RoundContext,
    stage: FrameStage,
    split: str,
    executor: Executor,
    skip: Callable[[Sequence[int]], None],
) -> Iterator[Outcome]:
    """The executor works on the frames; those whose measurements still hold need none."""
    frames = plan.waiting_frames(workspace, context, stage, split, measured=False)
    jobs = _jobs(workspace, context, stage, frames, skip)
    # The models are loaded only where a frame needs them.
    for first in jobs:
        yield from executor.map(stage.function(workspace, context), chain([first], jobs))
    if stage.recall:
        frames = plan.waiting_frames(workspace, context, stage, split, measured=True)
        jobs = _jobs(workspace, context, stage, frames, skip, stage.recall)
        for first in jobs:
            rate = stage.recall.function(workspace, context)
            yield from SerialExecutor().map(rate, chain([first], jobs))


def _jobs(
    workspace: Workspace,
    context: RoundContext,
    stage: FrameStage,
    frames: Iterable[tuple[int, str, bool]],
    skip: Callable[[Sequence[int]], None],
    recall: Recall | None = None,
) -> Iterator[FrameJob]:
    """The jobs of frames, with their predictions and measurements where they are needed.

    Frames that an earlier stage found empty are no jobs; `skip` is told of them.
    """
    reads = "prediction" in stage.reads
    for batch in batched(frames, READ_AHEAD):
        if empty := [key for key, _, is_empty in batch if is_empty]:
            skip(empty)
        keys = [key for key, _, is_empty in batch if not is_empty]
        found = workspace.predictions(context.number, keys) if reads else {}
        measured = recall.read(workspace, context, keys) if recall else {}
        for key, name, is_empty in batch:
            if not is_empty:
                yield FrameJob(key, name, found.get(key), measured.get(key))


class _Writer:
    """Collects outcomes and writes them, with their tasks, a batch per transaction."""

    def __init__(self, workspace: Workspace, context: RoundContext, stage: FrameStage) -> None:
        self.workspace = workspace
        self.context = context
        self.stage = stage
        prints = plan.fingerprints(workspace, context, workspace.config.run.method)
        self.fingerprint = prints[stage.name]
        self.unaffected = unaffected(stage, workspace.config.run.priors)
        self.done = self.empty = self.failed = self.labels = 0
        self.errors: list[tuple[str, str]] = []
        self._waiting: list[Outcome] = []
        self._flushed = time.monotonic()

    def add(self, outcome: Outcome) -> None:
        """Takes an outcome; it is stored with its batch."""
        self._waiting.append(outcome)
        if len(self._waiting) >= FLUSH_FRAMES or time.monotonic() - self._flushed > FLUSH_S:
            self.flush()

    def skip(self, keys: Sequence[int]) -> None:
        """Records frames without predictions as empty."""
        with self.workspace.database.writing() as connection:
            self._clear(connection, keys)
            bulk.insert(connection, "task", [self._row(key, "empty", None, 0.0) for key in keys])
        self.empty += len(keys)

    def flush(self) -> None:
        """Stores what has been collected, whole or not at all."""
        outcomes, self._waiting = self._waiting, []
        self._flushed = time.monotonic()
        if not outcomes:
            return
        with self.workspace.database.writing() as connection:
            self._clear(connection, [outcome.job.frame_id for outcome in outcomes])
            for table in self.stage.writes:
                rows = [
                    (self.context.number, outcome.job.frame_id, *row)
                    for outcome in outcomes
                    for row in outcome.rows.get(table, ())
                ]
                bulk.insert(connection, table, rows)
            tasks = [
                self._row(o.job.frame_id, self._state(o), o.error, o.seconds) for o in outcomes
            ]
            bulk.insert(connection, "task", tasks)
        for outcome in outcomes:
            self._count(outcome)

    def _state(self, outcome: Outcome) -> str:
        if outcome.error is not None:
            return "failed"
        return "done" if outcome.rows.get(self.stage.writes[-1]) else "empty"

    def _count(self, outcome: Outcome) -> None:
        state = self._state(outcome)
        self.done += state == "done"
        self.empty += state == "empty"
        self.failed += state == "failed"
        self.labels += len(outcome.rows.get(self.stage.writes[-1], ()))
        if outcome.error is not None:
            self.errors.append((outcome.job.frame, outcome.error))

    def _clear(self, connection: Connection, keys: Sequence[int]) -> None:
        """Removes what an earlier run stored, and the tasks of all whose rows leave with it.

        A task that stayed would make the frame count as done once the former settings are back.
        """
        task = bulk.table("task")
        if "prediction" in self.stage.writes:
            self._forget_weights(connection, keys)
        for table in self.stage.writes:
            bulk.delete_frames(connection, table, self.context.number, keys)
        connection.execute(
            task.delete().where(
                task.c.round == self.context.number,
                task.c.frame_id.in_(keys),
                task.c.stage.not_in(self.unaffected),
            )
        )

    def _forget_weights(self, connection: Connection, keys: Sequence[int]) -> None:
        """Removes tasks and counts of the policies that have weighed labels of these frames."""
        task, weight, count = map(bulk.table, ("task", "weight", "label_count"))
        weighted = (weight.c.round == self.context.number, weight.c.frame_id.in_(keys))
        policies = select(weight.c.policy).where(*weighted)
        connection.execute(
            task.delete().where(
                task.c.round == self.context.number,
                task.c.stage == "solve",
                task.c.variant.in_(policies),
            )
        )
        connection.execute(
            count.delete().where(count.c.round == self.context.number, count.c.policy.in_(policies))
        )

    def _row(self, key: int, state: str, error: str | None, seconds: float) -> bulk.Row:
        """A row of `task`."""
        what = (self.context.number, self.stage.name, "", key)
        return (*what, self.fingerprint, state, error, seconds)
