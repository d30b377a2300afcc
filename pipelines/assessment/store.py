"""Store audits and evaluations in the database."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from sqlalchemy import Connection

from curate.detections import Detections
from curate.evaluation.audit import Comparison, Estimate, Figures
from curate.evaluation.evaluated_labels import WHOLE
from curate.evaluation.kitti_ap import KittiEvaluation
from curate.evaluation.kitti_outcomes import Outcomes, object_outcomes
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.assessment.audit import AuditedRound
from pipelines.assessment.evaluation import ValObjects
from pipelines.workspace.workspace import Workspace

ESTIMATES = (
    "share_right",
    "auroc",
    "average_precision",
    "weighted_precision",
    "weighted_recall",
    "equal_recall_precision",
    "calibration_error",
)
NUMBERS = ("equal_recall_power", "calibration_error_by_chance", "calibration_error_limit")
OVERLAP = "3d"

Row = dict[str, Any]


def store_audit(workspace: Workspace, found: AuditedRound) -> None:
    """Store an audit; it replaces the audit of the same round, frames and overlap."""
    request = found.request
    key = {
        "round": found.context.number,
        "frames": request.frames,
        "overlap": request.overlap,
    }
    names = ("audit", "audit_slice", "audit_bin", "audit_difference")
    rows: dict[str, list[Row]] = {name: [] for name in names}
    reference = {"reference": found.figures.reference}
    for figures in found.figures.figures:
        of = {**key, "policy": figures.policy, "category": figures.category}
        part = figures.slice
        if part == WHOLE:
            rows["audit"].append(of | reference | _figures(figures))
            rows["audit_bin"] += [of | row for row in _bins(figures)]
        else:
            edges = {"kind": part.by, "low": part.low, "high": _finite(part.high)}
            rows["audit_slice"].append(of | edges | reference | _figures(figures))
    for comparison in found.figures.comparisons:
        rows["audit_difference"] += [key | row for row in _differences(comparison)]
    with workspace.database.writing() as connection:
        for name, new in rows.items():
            _replace(connection, name, key, new)


def store_evaluation(
    workspace: Workspace,
    source: str,
    found: Mapping[str, Detections],
    objects: ValObjects,
    figures: KittiEvaluation,
) -> Mapping[str, int]:
    """Store the evaluation of a source, replacing its previous one, and count the outcomes.

    Detections of every score take part: an object is a false negative only if no detection of any
    score matches it.

    Args:
        workspace: see `Workspace`.
        source: name of the evaluated detections, for queries.
        found: detections of the val frames.
        objects: ground truth and the same detections, with the rules of the evaluation.
        figures: the evaluation of the detections.

    Returns:
        The number of ground truth objects by outcome.
    """
    keys = workspace.frames("val")
    of_objects, of_detections = object_outcomes(
        objects.labels,
        objects.results,
        metric=OVERLAP,
        difficulty=objects.difficulty,
        min_overlaps=figures.min_overlaps,
        points=objects.points,
    )
    difficulty, level = objects.difficulty.whole()
    levels = {"overlap": OVERLAP, "difficulty": difficulty.levels[level]}
    truth = [annotations.boxes for annotations in workspace.ground_truth("val").values()]
    predicted = [found[name].boxes for name in keys]
    frame_ids = list(keys.values())
    rows = {
        "evaluation_object": [
            *(row | levels for row in _outcomes("object", of_objects, frame_ids, truth)),
            *(row | levels for row in _outcomes("detection", of_detections, frame_ids, predicted)),
        ],
        "evaluation_ap": list(_averages(figures)),
    }
    with workspace.database.writing() as connection:
        for name, new in rows.items():
            _replace(connection, name, {"source": source}, [{"source": source} | r for r in new])
    names, counts = np.unique(of_objects.outcomes, return_counts=True)
    return dict(zip(names.tolist(), counts.tolist(), strict=True))


def _replace(connection: Connection, name: str, key: Row, rows: Sequence[Row]) -> None:
    """Replace all rows with the same key by new rows."""
    table = bulk.table(name)
    same = (table.c[column] == value for column, value in key.items())
    connection.execute(table.delete().where(*same))
    bulk.insert_rows(connection, name, rows)


def _figures(figures: Figures) -> Row:
    """Return the columns that `audit` and `audit_slice` share."""
    row: Row = {
        "labels": figures.labels,
        "neutral": figures.neutral,
        "right_labels": figures.right,
        "objects": figures.objects,
    }
    row |= {name: _finite(getattr(figures, name)) for name in NUMBERS}
    for name in ESTIMATES:
        estimate: Estimate = getattr(figures, name)
        row[name] = _finite(estimate.value)
        row[f"{name}_low"] = _finite(estimate.low)
        row[f"{name}_high"] = _finite(estimate.high)
    return row


def _differences(comparison: Comparison) -> Iterator[Row]:
    """Yield a row for every figure in which two policies can be compared."""
    for figure, difference in comparison.differences.items():
        if math.isfinite(difference.value):
            yield {
                "policy": comparison.policy,
                "category": comparison.category,
                "other": comparison.other,
                "figure": figure,
                "difference": float(difference.value),
                "low": _finite(difference.low),
                "high": _finite(difference.high),
                "real": int(comparison.is_real(figure)),
            }


def _bins(figures: Figures) -> Iterator[Row]:
    """Yield a row for every bin with labels."""
    bins = figures.bins
    for i in np.flatnonzero(bins.labels).tolist():
        yield {
            "low": float(bins.edges[i]),
            "high": float(bins.edges[i + 1]),
            "labels": int(bins.labels[i]),
            "mean_weight": _finite(bins.mean_weight[i]),
            "precision": _finite(bins.precision[i]),
            "recall": _finite(bins.recall[i]),
        }


def _outcomes(
    side: str, outcomes: Outcomes, frame_ids: Sequence[int], boxes: Sequence[np.ndarray]
) -> Iterator[Row]:
    """Yield the rows of `evaluation_object`; `frame_ids` and `boxes` are by index of the frame."""
    columns = (
        *(outcomes.frames, outcomes.indices, outcomes.categories, outcomes.outcomes),
        *(outcomes.matches, outcomes.overlaps, outcomes.scores),
    )
    for frame, k, category, outcome, match, iou, score in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        row = {
            "frame_id": frame_ids[frame],
            "side": side,
            "k": k,
            "category": category,
            "outcome": outcome,
            "matched_k": None if match < 0 else match,
            "iou": iou,
            "score": None if math.isnan(score) else score,
        }
        yield row | dict(zip(BOX_COLUMNS, boxes[frame][k].tolist(), strict=True))


def _averages(figures: KittiEvaluation) -> Iterator[Row]:
    """Yield the rows of `evaluation_ap`."""
    plain = figures.as_dict()
    for category, by_figure in plain["AP_R40"].items():
        for figure, r40 in by_figure.items():
            r11 = plain["AP_R11"][category][figure]
            for d, difficulty in enumerate(figures.difficulty.levels):
                yield {
                    "category": category,
                    "figure": figure,
                    "difficulty": difficulty,
                    "objects": plain["objects"][category][d],
                    "ap_r40": None if r40 is None else r40[d],
                    "ap_r11": None if r11 is None else r11[d],
                }


def _finite(value: float) -> float | None:
    """Return a Python float, or None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None
