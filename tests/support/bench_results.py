"""Benches with synthetic results, and a stand-in for the processes that run their jobs."""

from collections.abc import Callable
from pathlib import Path

from pipelines.bench.grid import Job
from pipelines.bench.results import JobResult, LabelFigures, write_result
from pipelines.bench.settings import Axes, Bench, BenchSettings, claim

CATEGORIES = ("Car", "Pedestrian", "Cyclist")


def make_bench(
    root: Path,
    data: Path,
    methods: tuple[str, ...] = ("baseline", "pspsl"),
    ratios: tuple[float, ...] = (0.25,),
    seeds: tuple[int, ...] = (0,),
    **settings: object,
) -> Bench:
    """Create a bench over a folder in KITTI's layout."""
    given = {"steps": 4, "rounds": 1} | settings
    bench = Bench(
        root,
        BenchSettings(data=str(data), **given),
        Axes(methods=methods, ratios=ratios, seeds=seeds),
    )
    claim(bench)
    return bench


def synthetic_result(job: Job, car: float, **changes: object) -> JobResult:
    """Return a result with AP `car` for easy cars, 10 and 20 less for harder ones, else 0."""
    levels = {"Car": (car, car - 10, car - 20), "Pedestrian": (0.0,) * 3, "Cyclist": (0.0,) * 3}
    values = {
        "ratio": job.ratio,
        "seed": job.seed,
        "method": job.method,
        "frames": {"labeled": 2, "unlabeled": 6, "val": 4},
        "ap": {name: {"3d": levels, "bev": levels} for name in ("kitti", "loose")},
        "recall": levels,
        "labels": () if job.method is None else (label_figures(),),
        "seconds": 120.0,
        "resumed": False,
        "timings": {"train": (10, 20.0), "evaluate": (4, 2.0)},
        "about": {"curate": "1", "torch": "2", "device": "2 CPU cores"},
    }
    return JobResult.model_validate(values | changes)


def label_figures() -> LabelFigures:
    """Return the labels of one round, without weights."""
    return LabelFigures(round=1, labels=100, trusted=0, precision=None, recall=0.0, auroc=0.5)


class ToyJobs:
    """Run jobs at once, with synthetic results; those listed in `fault` fail.

    Attributes:
        done: jobs in the order in which they were run.
    """

    def __init__(self, root: Path, fault: Callable[[Job], str | None] = lambda job: None) -> None:
        self.root, self.fault = root, fault
        self.done: list[Job] = []

    def __call__(self, job: Job, report: Callable[[str, int], None]) -> str | None:
        """Run a job."""
        self.done.append(job)
        report("train", 2)
        reason = self.fault(job)
        if reason is None:
            write_result(self.root, synthetic_result(job, 50.0))
        return reason

    def end(self) -> None:
        """Do nothing: no process is running."""
