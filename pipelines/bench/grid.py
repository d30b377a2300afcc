"""The grid: its jobs, their folders, their dependencies and their amounts of work."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipelines.assembly import stores_maps
from pipelines.bench.settings import Axes
from pipelines.bench.truth import BENCH_METHODS
from pipelines.engine.stage import CacheStage
from pipelines.registry import POLICIES
from pipelines.round import round_graph
from pipelines.workspace.config import Config

RESULT_FILE = "result.json"
TRAIN, EVALUATE = "train", "evaluate"


@dataclass(frozen=True)
class Job:
    """A cell of the grid, or the work that all cells of one draw of labeled frames share.

    Attributes:
        ratio: share of the training frames that is labeled.
        seed: seed of the draw.
        method: the method of the cell; None for the shared work: training the teacher, and its
            stages in round 1.
    """

    ratio: float
    seed: int
    method: str | None = None

    @property
    def name(self) -> str:
        """The name of the job's folder."""
        return "-".join(
            [f"ratio-{self.ratio:g}", f"seed-{self.seed}", *filter(None, [self.method])]
        )

    def __str__(self) -> str:
        """Return a readable name."""
        return f"ratio {self.ratio:g}, seed {self.seed}, {self.method or 'teacher'}"

    @property
    def shared(self) -> "Job":
        """The job with the shared work that this job starts from."""
        return Job(self.ratio, self.seed)

    def folder(self, root: Path) -> Path:
        """Return the folder of the job's workspace."""
        return root / ("shared" if self.method is None else "cells") / self.name

    def result(self, root: Path) -> Path:
        """Return the path of the result file, which exists only if the job is finished."""
        return self.folder(root) / RESULT_FILE

    def is_done(self, root: Path) -> bool:
        """Return whether the job is finished; finished jobs are never rerun."""
        return self.result(root).is_file()


@dataclass(frozen=True)
class Sizes:
    """The numbers of training and validation frames."""

    train: int
    val: int

    def labeled(self, ratio: float) -> int:
        """Return the number of labeled frames at a ratio, as `curate init` computes it."""
        return max(1, round(ratio * self.train))


def jobs(axes: Axes) -> list[Job]:
    """Return all jobs, sorted by seed; the shared job of each draw is before its cells."""
    return [
        Job(ratio, seed, method)
        for seed in axes.seeds
        for ratio in axes.ratios
        for method in (None, *axes.methods)
    ]


def waiting(axes: Axes, root: Path) -> list[Job]:
    """Return the unfinished jobs, without shared jobs that no unfinished cell needs."""
    unfinished = [job for job in jobs(axes) if not job.is_done(root)]
    needed = {job.shared for job in unfinished if job.method is not None}
    return [job for job in unfinished if job.method is not None or job in needed]


def looks_at_unlabeled(job: Job) -> bool:
    """Return whether the job runs the detector on X_u; later rounds of the baseline do not."""
    return job.method is None or bool(
        POLICIES.load(BENCH_METHODS[job.method].policy).uses_unlabeled
    )


def work(job: Job, config: Config, sizes: Sizes) -> Mapping[str, int]:
    """Return the work of a job: the number of optimiser steps, and of frames per stage."""
    section = config.train
    first = job.method is None
    steps = section.pretrain_steps if first else section.round_steps * config.run.rounds
    passes = 1 if first else (config.run.rounds - 1) * looks_at_unlabeled(job)
    unlabeled = sizes.train - sizes.labeled(job.ratio)
    graph = round_graph(config.run.priors, maps=stores_maps(config), fused=config.repredict.fuse)
    frames = {
        stage.name: unlabeled * (first if isinstance(stage, CacheStage) else passes)
        for stage in graph.frames_stages
    }
    return {TRAIN: steps, **frames, EVALUATE: sizes.val}
