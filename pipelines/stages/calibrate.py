"""calibrate: learn the probability that a label is correct from frames with ground truth.

`pipelines.stages.calibration_frames` describes the frames. Their labels and evidence are made by
the same stages as those of unlabeled frames, and compared with the ground truth. The regression is
that of `curate.calibration`.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from sqlalchemy import Connection

from curate.calibration.features import mean_log_sizes
from curate.calibration.model import Calibration, TooFewLabels, fit_calibration
from curate.errors import ConfigError
from curate.evaluation.kitti_rules import relaxed
from curate.evaluation.reliability import auroc, expected_calibration_error
from db import bulk
from pipelines.assembly import check_policy, open_policy
from pipelines.engine.progress import Progress
from pipelines.engine.stage import Product, RoundContext, RoundJob, Settings
from pipelines.labels.calibration import needs_calibration
from pipelines.labels.compared import ComparedLabels, compare_labels
from pipelines.labels.matching import configured_overlaps
from pipelines.stages.calibration_frames import (
    SET_ASIDE,
    SourceName,
    choose_source,
    reads_held_out,
    units_of,
    unseen_frames,
)
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace

_PARTS = (5, 20)  # of the frames, each left out once for the figures; more if labels are few

Row = dict[str, Any]


def applies(workspace: Workspace, policy: str) -> bool:
    """Return whether a policy reads probabilities.

    Raises:
        ConfigError: if the policy cannot be created with its settings.
    """
    check_policy(workspace.config, policy)
    return needs_calibration(open_policy(workspace.config, policy))


def settings(workspace: Workspace, context: RoundContext, policy: str) -> Settings:
    """Return what the calibration depends on besides the labels and their evidence."""
    section, source = workspace.config.calibrate, ""
    unseen: frozenset[str] | None = None
    try:
        source = choose_source(workspace, context.number)
        unseen = unseen_frames(workspace)
    except ConfigError:  # reported when the stage runs
        pass
    return {
        "source": source,
        "folds": section.folds if source == "folds" else 0,
        "overlap": section.overlap,
        # The names of settings in curate.toml: --dry-run reports those that changed.
        "thresholds": section.thresholds,
        "overlaps": configured_overlaps(workspace.config),
        "categories": workspace.config.dataset.categories,
        "max_wrong": reads_held_out(workspace, policy),
        "split_by": workspace.config.dataset.split_by,
        "seed": context.seed,
        **({} if unseen is None else {"unseen": sorted(unseen)}),
    }


def run(workspace: Workspace, job: RoundJob, _progress: Progress) -> Product:
    """Fit the calibration of the round, and keep labels for max_wrong that it has not used."""
    config, source = workspace.config, choose_source(workspace, job.context.number)
    fitted, held_out = _labels(workspace, job, source)
    row: Row = {
        "round": job.context.number,
        "source": source,
        "folds": config.calibrate.folds if source == "folds" else 0,
        "overlap": config.calibrate.overlap,
        "thresholds": config.calibrate.thresholds,
        "teacher": job.context.teacher.sha256,
        "frames": len(fitted.frames),
        "labels": int(fitted.counted.sum()),
        "neutral": int((~fitted.counted).sum()),
        "right_labels": int(fitted.correct.sum()),
        "unit": units_of(workspace, fitted.frames)[0],
        **dict.fromkeys(("auroc", "calibration_error", "fit", "fallback")),
        "held_out_frames": 0,
    }
    counts = "{labels} labels of {frames} frames, {right_labels} correct".format(**row)
    try:
        calibration = _fit(workspace, fitted)
    except TooFewLabels as error:
        row["fallback"] = str(error)
        return Product(f"{counts}: no fit, because there are only {error}", _writer(job, row, []))
    row |= _out_of_sample(workspace, fitted)
    row |= {"fit": calibration.as_json(), "held_out_frames": len(held_out.frames)}
    summary = counts
    if row["auroc"] is not None:
        summary += (
            f"; in frames left out, AUROC {row['auroc']:.3f} and calibration error "
            f"{row['calibration_error']:.3f}"
        )
    if held_out.frames:
        summary += f"; {len(held_out.frames)} further frames for max_wrong"
    rows = list(_held_out_rows(workspace, calibration, held_out))
    return Product(summary, _writer(job, row, rows))


def _labels(
    workspace: Workspace, job: RoundJob, source: SourceName
) -> tuple[ComparedLabels, ComparedLabels]:
    """Return the labels for the fit, and those for max_wrong."""
    overlaps = _overlaps(workspace.config)
    parts: dict[bool, list[ComparedLabels]] = {True: [], False: []}
    for each in job.truth:
        for_fit = source == SET_ASIDE or each.source.title != SET_ASIDE
        parts[for_fit].append(compare_labels(each, workspace.config, overlaps))
    fitted, held_out = ComparedLabels.joined(parts[True]), ComparedLabels.joined(parts[False])
    if (unseen := unseen_frames(workspace)) is not None:
        fitted = fitted.of_frames(unseen)
    if source == SET_ASIDE and reads_held_out(workspace, job.policy):
        one, other = _halves(workspace, fitted.frames, np.random.default_rng(job.context.seed))
        return fitted.of_frames(one), fitted.of_frames(other)
    return fitted, held_out


def _halves(
    workspace: Workspace, frames: Sequence[str], generator: np.random.Generator
) -> tuple[list[str], list[str]]:
    """Split frames into two halves by whole sequences, at random."""
    members: dict[str, list[str]] = {}
    for frame, unit in zip(frames, units_of(workspace, frames)[1], strict=True):
        members.setdefault(unit, []).append(frame)
    halves: tuple[list[str], list[str]] = ([], [])
    for unit in generator.permutation(sorted(members)).tolist():
        min(halves, key=len).extend(members[unit])
    return halves


def _fit(workspace: Workspace, labels: ComparedLabels) -> Calibration:
    categories = workspace.config.dataset.categories
    objects = workspace.ground_truth("labeled").values()
    names = np.concatenate([np.zeros(0, dtype=np.str_), *(each.categories for each in objects)])
    boxes = np.concatenate([np.zeros((0, 7)), *(each.boxes for each in objects)])
    known = np.isin(names, categories)
    return fit_calibration(
        labels.evidence.select(labels.counted),
        labels.correct[labels.counted],
        labels.frame[labels.counted],
        categories=categories,
        sizes=mean_log_sizes(names[known], boxes[known]),
    )


def _out_of_sample(workspace: Workspace, labels: ComparedLabels) -> Row:
    """Return the figures of probabilities in frames that the fit has not used.

    There are no figures if too few labels are left then.
    """
    for parts in _PARTS:
        try:
            p = _left_out(workspace, labels, parts)[labels.counted]
        except TooFewLabels:
            continue
        correct = labels.correct[labels.counted]
        error = expected_calibration_error(p, correct)
        return {"auroc": auroc(p, correct), "calibration_error": error}
    return {}


def _left_out(workspace: Workspace, labels: ComparedLabels, parts: int) -> np.ndarray:
    """Return (n,) the probabilities of labels by the fit to the other parts of the frames.

    Raises:
        TooFewLabels: if a fit has too few labels.
    """
    units = units_of(workspace, labels.frames)[1]
    part_of = {unit: i % parts for i, unit in enumerate(sorted(set(units)))}
    part = np.array([part_of[unit] for unit in units])
    probability = np.full(len(labels.frame), np.nan)
    for each in sorted(set(part_of.values())):
        others = [name for name, i in zip(labels.frames, part, strict=True) if i != each]
        inside = part[labels.frame] == each
        if inside.any():
            fit = _fit(workspace, labels.of_frames(others))
            probability[inside] = fit.probability(labels.evidence.select(inside))
    return probability


def _held_out_rows(
    workspace: Workspace, calibration: Calibration, labels: ComparedLabels
) -> Iterator[Row]:
    """Yield the rows of `calibration_label`, without the round."""
    if not labels.frames:
        return
    probability = calibration.probability(labels.evidence)
    units = units_of(workspace, labels.frames)[1]
    for i, frame in enumerate(labels.frame.tolist()):
        yield {
            "frame_id": int(labels.frame_id[i]),
            "k": int(labels.k[i]),
            "probability": float(probability[i]),
            "correct": int(labels.correct[i]) if labels.counted[i] else None,
            "unit": units[frame],
        }


def _writer(job: RoundJob, row: Row, held_out: Sequence[Row]) -> Callable[[Connection], None]:
    """Return a function that replaces the calibration of the round."""
    number = job.context.number

    def write(connection: Connection) -> None:
        for name in ("calibration_label", "calibration"):
            table = bulk.table(name)
            connection.execute(table.delete().where(table.c.round == number))
        bulk.insert_rows(connection, "calibration", [row])
        bulk.insert_rows(
            connection, "calibration_label", [{"round": number, **each} for each in held_out]
        )
        # A round has one calibration: it replaces that of another policy.
        task = bulk.table("task")
        others = (task.c.stage == "calibrate", task.c.variant != job.policy)
        connection.execute(task.delete().where(task.c.round == number, *others))

    return write


def _overlaps(config: Config) -> dict[str, float]:
    """Return the IoU threshold of each category by `calibrate.thresholds`."""
    overlaps = configured_overlaps(config)
    return overlaps if config.calibrate.thresholds == "kitti" else relaxed(overlaps)
