"""The grid: which jobs it has, where they live, what each needs and how much work it is."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from pipelines.bench.settings import Axes
from pipelines.registry import POLICIES
from pipelines.round import round_graph
from pipelines.stages.methods import METHODS
from pipelines.workspace.config import Config

RESULT_FILE = "result.json"
TRAIN, EVALUATE = "train", "evaluate"


@dataclass(frozen=True)
class Job:
    """A cell of the grid, or what the cells of one draw of labeled frames share.

    Attributes:
        ratio: share of the training frames that is labeled.
        seed: of the draw.
        method: None for what is shared: the teacher, and what round 1 asks of it.
    """

    ratio: float
    seed: int
    method: str | None = None

    @property
    def name(self) -> str:
        """A name for a folder."""
        return "-".join(
            [f"ratio-{self.ratio:g}", f"seed-{self.seed}", *filter(None, [self.method])]
        )

    def __str__(self) -> str:
        """As a person reads it."""
        return f"ratio {self.ratio:g}, seed {self.seed}, {self.method or 'teacher'}"

    @property
    def shared(self) -> "Job":
        """The job whose workspace this one starts from."""
        return Job(self.ratio, self.seed)

    def folder(self, root: Path) -> Path:
        """Its workspace."""
        return root / ("shared" if self.method is None else "cells") / self.name

    def result(self, root: Path) -> Path:
        """Return the file that is there once the job is done."""
        return self.folder(root) / RESULT_FILE

    def is_done(self, root: Path) -> bool:
        """Return whether it is finished; it is never done again."""
        return self.result(root).is_file()


@dataclass(frozen=True)
class Sizes:
    """Frames of the data set's training and validation lists."""

    train: int
    val: int

    def labeled(self, ratio: float) -> int:
        """Labeled frames at a ratio, as `curate init` counts them."""
        return max(1, round(ratio * self.train))


def jobs(axes: Axes) -> list[Job]:
    """All jobs; a seed is finished before the next begins, and what is shared comes first."""
    return [
        Job(ratio, seed, method)
        for seed in axes.seeds
        for ratio in axes.ratios
        for method in (None, *axes.methods)
    ]


def waiting(axes: Axes, root: Path) -> list[Job]:
    """Return the jobs that are not done, without preparations that nobody needs any more."""
    unfinished = [job for job in jobs(axes) if not job.is_done(root)]
    needed = {job.shared for job in unfinished if job.method is not None}
    return [job for job in unfinished if job.method is not None or job in needed]


def looks_at_unlabeled(job: Job) -> bool:
    """Whether it predicts and scores frames of X_u; later rounds of the baseline need not."""
    return job.method is None or bool(POLICIES.load(METHODS[job.method].policy).uses_unlabeled)


def work(job: Job, config: Config, sizes: Sizes) -> Mapping[str, int]:
    """Optimiser steps, and frames by stage."""
    section = config.train
    first = job.method is None
    steps = section.pretrain_steps if first else section.round_steps * config.run.rounds
    passes = 1 if first else (config.run.rounds - 1) * looks_at_unlabeled(job)
    frames = passes * (sizes.train - sizes.labeled(job.ratio))
    return {TRAIN: steps, **dict.fromkeys(frame_stages(config), frames), EVALUATE: sizes.val}


def frame_stages(config: Config) -> Iterator[str]:
    """Return the stages that go through the frames of X_u."""
    return (stage.name for stage in round_graph(config.run.priors).frames_stages)
