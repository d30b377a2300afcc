"""Run the grid: several jobs at once, shared jobs first; a failed job does not stop the others."""

import fcntl
import math
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from curate.errors import CellsFailed, WorkspaceError
from pipelines.bench import grid
from pipelines.bench.costs import FIRST_GUESS, Costs
from pipelines.bench.grid import Job, Sizes
from pipelines.bench.processes import ProgressCallback
from pipelines.bench.results import read_result, read_results
from pipelines.bench.settings import Bench
from pipelines.engine.progress import Advance, Progress
from pipelines.workspace.workspace import open_dataset

Say = Callable[[str], None]

_BAR_STEPS = 1000


class RunJob(Protocol):
    """Runs jobs, for example in processes."""

    def __call__(self, job: Job, on_progress: ProgressCallback) -> str | None:
        """Run a job and return None, or the reason of its failure in one line."""
        ...

    def end(self) -> None:
        """Stop the running jobs, because the grid was interrupted."""
        ...


def run_grid(bench: Bench, run_job: RunJob, workers: int, say: Say, progress: Progress) -> None:
    """Run every unfinished job.

    Raises:
        CellsFailed: if some cells failed; the others are finished.
    """
    waiting = grid.waiting(bench.axes, bench.root)
    cells = [job for job in grid.jobs(bench.axes) if job.method is not None]
    done = sum(job.is_done(bench.root) for job in cells)
    summary = f"{len(cells)} cells" + (f", {done} of them already finished" if done else "")
    if not waiting:
        say(summary)
        return
    with progress.track("grid", _BAR_STEPS) as advance:
        run = _GridRun(bench, waiting, say, advance)
        say(f"{summary}: about {_minutes(run.total / workers)} with {workers} at once")
        failed = run.go(run_job, workers)
    if failed:
        raise CellsFailed(
            f"{failed} of {len(cells)} cells failed. Fix the cause and rerun the command; finished "
            "cells are kept"
        )


@contextmanager
def alone(root: Path) -> Iterator[None]:
    """Lock the bench's folder; the operating system releases the lock when the process ends.

    Raises:
        WorkspaceError: if another process holds the lock.
    """
    root.mkdir(parents=True, exist_ok=True)
    with (root / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise WorkspaceError(
                f"{root}: another `curate bench` is running in this folder; wait for it or stop it"
            ) from error
        yield


class _GridRun:
    """One run of the unfinished jobs."""

    def __init__(self, bench: Bench, waiting: list[Job], say: Say, advance: Advance) -> None:
        self.bench, self.say = bench, say
        self.waiting = waiting
        self.failed: dict[Job, str] = {}
        self.costs = Costs(read_results(bench.root))
        lists = open_dataset(bench.config(0)).splits()
        self.sizes = Sizes(len(lists["train"]), len(lists["val"]))
        seconds = {job: self.costs.seconds(self.work(job)) for job in waiting}
        rates = {kind: self.costs.rate(kind) for kind in FIRST_GUESS}
        self.total = sum(seconds.values())
        self._bar = _GridBar(seconds, rates, advance)

    def work(self, job: Job) -> Mapping[str, int]:
        """Return the units of work of a job."""
        return grid.work(job, self.bench.config(job.seed, job.method), self.sizes)

    def go(self, run_job: RunJob, workers: int) -> int:
        """Run all jobs and return the number of failed cells."""
        running: dict[Future[str | None], Job] = {}
        with ThreadPoolExecutor(workers) as pool:
            try:
                while self.waiting or running:
                    for job in self._ready()[: workers - len(running)]:
                        self.waiting.remove(job)
                        self._announce(job)
                        running[pool.submit(run_job, job, self._bar.progress_of(job))] = job
                    ended, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in ended:
                        self._end(running.pop(future), future.result())
            finally:
                if running:
                    run_job.end()
        return sum(job.method is not None for job in self.failed)

    def _ready(self) -> list[Job]:
        """Return the waiting jobs that can start: their shared job is finished."""
        root = self.bench.root
        return [job for job in self.waiting if job.method is None or job.shared.is_done(root)]

    def _announce(self, job: Job) -> None:
        work = self.work(job)
        frames = sum(units for kind, units in work.items() if kind != grid.TRAIN)
        guess = "" if self.costs.measured else ", a rough estimate"
        self.say(
            f"{job}: about {_minutes(self.costs.seconds(work))} ({work[grid.TRAIN]} steps, "
            f"{frames} frame passes{guess})"
        )

    def _end(self, job: Job, error: str | None) -> None:
        """Record the end of a job and print its result; a failed job fails its dependent jobs."""
        self._bar.finish(job)
        if error is None:
            result = read_result(self.bench.root, job)
            self.costs.learn(result)
            kitti, relaxed = (_points(result.mean(name, "3d")) for name in ("kitti", "loose"))
            notes = f", {result.failed_frames} frame results failed" if result.failed_frames else ""
            self.say(
                f"{job}: mean 3D AP {kitti}, at relaxed IoU thresholds {relaxed}, in "
                f"{_minutes(result.seconds)}{notes}"
            )
            return
        self.failed[job] = error
        dependent = [other for other in self.waiting if other.shared == job]
        for other in dependent:
            self.waiting.remove(other)
            self.failed[other] = error
            self._bar.finish(other)
        without = f" (so {len(dependent)} cells cannot run)" if dependent else ""
        self.say(f"{job}: failed{without}: {error}")


def _points(percent: float) -> str:
    return "-" if math.isnan(percent) else f"{percent:.1f}"


class _GridBar:
    """One progress bar for the work of many jobs, weighted by its expected time."""

    def __init__(
        self, seconds: Mapping[Job, float], rates: Mapping[str, float], advance: Advance
    ) -> None:
        self._seconds, self._rates = seconds, rates
        self._total = sum(seconds.values())
        self._done = dict.fromkeys(seconds, 0.0)
        self._finished = self._shown = 0
        self._advance = advance
        self._lock = threading.Lock()

    def progress_of(self, job: Job) -> ProgressCallback:
        """Return the function that counts the finished units of a job."""

        def on_progress(kind: str, units: int) -> None:
            with self._lock:
                now = self._done[job] + units * self._rates.get(kind, 0.0)
                self._done[job] = min(now, self._seconds[job])
                self._show()

        return on_progress

    def finish(self, job: Job) -> None:
        """Count a job as finished, also if it failed."""
        with self._lock:
            self._done[job] = self._seconds[job]
            self._finished += 1
            self._show()

    def _show(self) -> None:
        now = int(_BAR_STEPS * sum(self._done.values()) / self._total + 1e-6)
        self._advance(now - self._shown, f"{self._finished} of {len(self._done)} jobs")
        self._shown = now


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.1f} min"
