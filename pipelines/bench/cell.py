"""Run one job of the grid in its own process: bring its workspace up to date and evaluate it."""

import math
import os
import shutil
import sqlite3
import time
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import curate
from curate.detectors.devices import choose_device
from curate.evaluation.kitti_ap import KittiEvaluation
from curate.evaluation.kitti_rules import relaxed
from pipelines.assessment.evaluation import detect_val, val_objects
from pipelines.assessment.label_quality import label_quality
from pipelines.bench.grid import Job, looks_at_unlabeled
from pipelines.bench.metered import Metered
from pipelines.bench.results import JobResult, LabelFigures, Levels, write_result
from pipelines.bench.settings import Bench
from pipelines.engine.rounds import newest_checkpoint
from pipelines.engine.runner import Report, open_executor, run_first, run_frames
from pipelines.engine.schedule import run_all
from pipelines.round import graph_of, open_plan
from pipelines.stages.methods import METHODS
from pipelines.workspace.config_file import write_config
from pipelines.workspace.location import CONFIG_NAME
from pipelines.workspace.setup import initialise
from pipelines.workspace.splits import SPLITS, count_frames
from pipelines.workspace.workspace import Workspace

DATABASE = "curate.db"


@dataclass(frozen=True)
class Evaluated:
    """The figures of a detector, in the form of `JobResult`."""

    ap: dict[str, dict[str, dict[str, Levels]]]
    recall: dict[str, Levels]
    thresholds: dict[str, dict[str, float]]
    difficulties: tuple[str, ...]


def run_job(bench: Bench, job: Job, progress: Metered) -> JobResult:
    """Run a job, or resume an interrupted one, and write its result."""
    start = time.monotonic()
    resumed = job.folder(bench.root).exists()
    workspace = _open_shared(bench, job) if job.method is None else _open_cell(bench, job)
    if job.method is None:
        reports = _run_shared(workspace, progress)
    else:
        graph, evidence = graph_of(workspace), looks_at_unlabeled(job)
        reports = list(run_all(workspace, graph, None, progress, evidence=evidence))
    found = _evaluate(workspace, newest_checkpoint(workspace), progress)
    result = JobResult(
        ratio=job.ratio,
        seed=job.seed,
        method=job.method,
        frames=count_frames({split: workspace.frames(split) for split in SPLITS}),
        ap=found.ap,
        recall=found.recall,
        thresholds=found.thresholds,
        difficulties=found.difficulties,
        labels=_labels(workspace, METHODS[job.method].policy)
        if job.method is not None and bench.simulated
        else (),
        failed_frames=sum(report.failed for report in reports),
        seconds=time.monotonic() - start,
        resumed=resumed,
        timings=dict(progress.timings),
        about=_about(workspace),
    )
    workspace.database.close()
    write_result(bench.root, result)
    return result


def _open_shared(bench: Bench, job: Job) -> Workspace:
    """Open or create the shared workspace of a draw of labeled frames."""
    config = bench.config(job.seed)
    root = job.folder(bench.root)
    if (root / CONFIG_NAME).exists():
        write_config(root / CONFIG_NAME, config)  # the folder may have been moved
    return initialise(root, config, str(job.ratio), "")


def _run_shared(workspace: Workspace, progress: Metered) -> list[Report]:
    """Train the teacher and run the stages of round 1 that do not depend on the method."""
    firsts = graph_of(workspace).first_stages
    reports = [run_first(workspace, first, progress) for first in firsts]
    plan = open_plan(workspace, 1)
    with open_executor(workspace) as executor:
        stages = plan.graph.frames_stages
        return [*reports, *(run_frames(plan, stage, executor, progress) for stage in stages)]


def _open_cell(bench: Bench, job: Job) -> Workspace:
    """Open or create the workspace of a method, which starts as a copy of the shared one.

    A method under which all labels of a category vanish is a result of the grid, not an error.
    Results in the copy that do not match the method's settings are stale and are computed again.
    """
    root = job.folder(bench.root)
    if not root.exists():
        source = job.shared.folder(bench.root)
        partial = root.with_name(f".{root.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(source / "checkpoints", partial / "checkpoints")
        _copy_database(source / DATABASE, partial / DATABASE)
        partial.rename(root)
    config = bench.config(job.seed, job.method)
    for folder in ("exports", "pictures", "reports"):
        (root / folder).mkdir(exist_ok=True)
    write_config(root / CONFIG_NAME, config)
    return replace(Workspace.open(root), allow_empty=True)


def _copy_database(source: Path, target: Path) -> None:
    """Copy a database with SQLite's backup, which includes the write-ahead log."""
    with closing(sqlite3.connect(source)) as old, closing(sqlite3.connect(target)) as new:
        old.backup(new)


def _evaluate(workspace: Workspace, checkpoint: Path | None, progress: Metered) -> Evaluated:
    """Evaluate a detector on val, at the configured and at the relaxed IoU thresholds."""
    objects = val_objects(workspace, detect_val(workspace, checkpoint, progress))
    thresholds = {"kitti": dict(objects.overlaps), "loose": relaxed(objects.overlaps)}
    figures = {
        name: objects.evaluate(overlaps, recall_overlaps=sorted(set(overlaps.values())))
        for name, overlaps in thresholds.items()
    }
    return Evaluated(
        {name: _averages(evaluation) for name, evaluation in figures.items()},
        _recalls(figures["kitti"]),
        thresholds,
        objects.difficulty.levels,
    )


def _averages(evaluation: KittiEvaluation) -> dict[str, dict[str, Levels]]:
    """Return AP R40 by figure and category."""
    plain = evaluation.as_dict()["AP_R40"]
    return {
        figure: {category: tuple(by_figure[figure]) for category, by_figure in plain.items()}
        for figure in ("3d", "bev")
    }


def _recalls(evaluation: KittiEvaluation) -> dict[str, Levels]:
    """Return the recall by category, at the IoU threshold of its AP."""
    plain = evaluation.as_dict()["recall_3d"]
    return {
        category: tuple(plain[category][f"{overlap:g}"])
        for category, overlap in evaluation.min_overlaps.items()
    }


def _labels(workspace: Workspace, policy: str) -> tuple[LabelFigures, ...]:
    """Return the quality of a policy's labels in every round, by the simulated ground truth."""
    rows = []
    for number in range(1, workspace.config.run.rounds + 1):
        [found] = label_quality(workspace, number, (policy,))
        _, labels, trusted, *figures = found
        precision, recall, auroc = (None if math.isnan(value) else value for value in figures)
        rows.append(
            LabelFigures(
                round=number,
                labels=labels,
                trusted=trusted,
                precision=precision,
                recall=recall,
                auroc=auroc,
            )
        )
    return tuple(rows)


def _about(workspace: Workspace) -> dict[str, str]:
    """Return versions and device, on which the figures may depend."""
    import torch

    on = choose_device(workspace.config.detector.device)
    name = torch.cuda.get_device_name() if on == "cuda" else f"{os.cpu_count()} CPU cores"
    return {"curate": curate.__version__, "torch": torch.__version__, "device": name}
