"""What is kept of a finished job: figures of its detector, of its labels, and its times."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from curate.errors import DataError
from curate.files.atomic import replace_file
from pipelines.bench.grid import RESULT_FILE, Job
from pipelines.workspace.config import Section

Levels = tuple[float, float, float]
OVERLAPS = ("kitti", "loose")


class LabelFigures(Section):
    """How good the labels of a round were; only simulated frames know.

    Attributes:
        round: e.
        labels: pseudo-labels of the round.
        trusted: those with a weight above 0.
        precision: share of the weight that lies on right labels, percent; None without weight.
        recall: weight on right labels per object, percent.
        auroc: chance that a right label weighs more than a wrong one.
    """

    round: int
    labels: int
    trusted: int
    precision: float | None
    recall: float | None
    auroc: float | None


class JobResult(Section):
    """A finished job.

    Attributes:
        ratio, seed, method: see `Job`.
        frames: how many are labeled, unlabeled, val.
        ap: R40 in percent by overlaps ("kitti" or "loose"), figure ("3d", "bev") and category;
            easy, moderate, hard.
        recall: percent by category at KITTI's 3D overlaps; easy, moderate, hard.
        labels: by round.
        failed_frames: results of frames that failed and were left out.
        seconds: of the run that finished the job.
        resumed: whether an earlier run had begun it.
        timings: units of work and the seconds they took, by kind.
        about: versions and device.
    """

    ratio: float
    seed: int
    method: str | None
    frames: dict[str, int]
    ap: dict[str, dict[str, dict[str, Levels]]]
    recall: dict[str, Levels]
    labels: tuple[LabelFigures, ...] = ()
    failed_frames: int = 0
    seconds: float
    resumed: bool
    timings: dict[str, tuple[int, float]]
    about: dict[str, str]

    @property
    def job(self) -> Job:
        """Which job it was."""
        return Job(self.ratio, self.seed, self.method)

    def table(self, overlaps: str, figure: str) -> Mapping[str, Levels]:
        """AP, or "recall", by category."""
        return self.recall if figure == "recall" else self.ap[overlaps][figure]

    def mean(self, overlaps: str, figure: str) -> float:
        """Return the mean over categories and difficulties."""
        return float(np.mean(list(self.table(overlaps, figure).values())))


def write_result(root: Path, result: JobResult) -> None:
    """Mark the job as done, by writing its file whole."""
    content = result.model_dump_json(indent=1) + "\n"
    replace_file(result.job.result(root), content.encode())


def read_result(root: Path, job: Job) -> JobResult:
    """Return the result of a finished job."""
    return _read(job.result(root))


def read_results(root: Path) -> list[JobResult]:
    """Return the results of all finished jobs of a bench, those of shared work included."""
    paths = [path for kind in ("shared", "cells") for path in root.glob(f"{kind}/*/{RESULT_FILE}")]
    found = [_read(path) for path in paths]
    return sorted(found, key=lambda result: (result.ratio, result.seed, result.method or ""))


def _read(path: Path) -> JobResult:
    try:
        return JobResult.model_validate_json(path.read_bytes())
    except (ValidationError, OSError) as error:
        raise DataError(f"{path}: is damaged; delete it and run the bench again") from error
