"""The stored result of a finished job: figures of its detector and labels, and its times."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError

from curate.errors import DataError
from curate.evaluation.comparison import known_mean
from curate.evaluation.kitti_rules import DIFFICULTIES, MIN_OVERLAPS, RELAXED_OVERLAPS
from curate.files.atomic import replace_file
from pipelines.bench.grid import RESULT_FILE, Job
from pipelines.workspace.config import Section

Levels = tuple[float | None, ...]
"""A figure by level of difficulty; None where it cannot be computed."""
OVERLAPS = ("kitti", "loose")


class LabelFigures(Section):
    """The quality of the labels of a round; known for simulated frames only.

    Attributes:
        round: e.
        labels: number of pseudo-labels.
        trusted: number of pseudo-labels with a weight above 0.
        precision: share of the weight that is on correct labels, percent; None without weight.
        recall: weight on correct labels per object, percent; None without objects.
        auroc: probability that a correct label weighs more than a wrong one; None without both.
    """

    round: int
    labels: int
    trusted: int
    precision: float | None
    recall: float | None
    auroc: float | None


class JobResult(Section):
    """The result of a finished job.

    Attributes:
        ratio, seed, method: see `Job`.
        frames: number of frames by split: labeled, unlabeled, val.
        ap: AP R40 in percent by IoU thresholds ("kitti" for the configured ones, KITTI's by
            default, or "loose" for the relaxed ones), figure ("3d", "bev"), category and level.
        recall: recall in percent by category, at the 3D IoU thresholds "kitti", and level.
        thresholds: IoU thresholds by name and category.
        difficulties: names of the levels of difficulty.
        labels: quality of the labels by round.
        failed_frames: number of results of frames that failed and are not included.
        seconds: duration of the run that finished the job.
        resumed: whether an earlier run had started the job.
        timings: units of work and their seconds, by kind.
        about: versions and device.
    """

    ratio: float
    seed: int
    method: str | None
    frames: dict[str, int]
    ap: dict[str, dict[str, dict[str, Levels]]]
    recall: dict[str, Levels]
    thresholds: dict[str, dict[str, float]] = Field(
        default={"kitti": dict(MIN_OVERLAPS), "loose": dict(RELAXED_OVERLAPS)}
    )
    difficulties: tuple[str, ...] = DIFFICULTIES
    labels: tuple[LabelFigures, ...] = ()
    failed_frames: int = 0
    seconds: float
    resumed: bool
    timings: dict[str, tuple[int, float]]
    about: dict[str, str]

    @property
    def job(self) -> Job:
        """The job with this result."""
        return Job(self.ratio, self.seed, self.method)

    def table(self, overlaps: str, figure: str) -> Mapping[str, Levels]:
        """Return AP by category, or the recall for the figure "recall"."""
        return self.recall if figure == "recall" else self.ap[overlaps][figure]

    def mean(self, overlaps: str, figure: str) -> float:
        """Return the mean over the categories and levels with a figure; NaN without any."""
        values = np.array(list(self.table(overlaps, figure).values()), dtype=np.float64)
        return float(known_mean(values, 2))


def write_result(root: Path, result: JobResult) -> None:
    """Write the result file atomically, which marks the job as finished."""
    content = result.model_dump_json(indent=1) + "\n"
    replace_file(result.job.result(root), content.encode())


def read_result(root: Path, job: Job) -> JobResult:
    """Return the result of a finished job."""
    return _read(job.result(root))


def read_results(root: Path) -> list[JobResult]:
    """Return the results of all finished jobs of a bench, including shared jobs."""
    paths = [path for kind in ("shared", "cells") for path in root.glob(f"{kind}/*/{RESULT_FILE}")]
    found = [_read(path) for path in paths]
    return sorted(found, key=lambda result: (result.ratio, result.seed, result.method or ""))


def _read(path: Path) -> JobResult:
    try:
        return JobResult.model_validate_json(path.read_bytes())
    except (ValidationError, OSError) as error:
        raise DataError(f"{path}: is damaged; delete it and rerun the bench") from error
