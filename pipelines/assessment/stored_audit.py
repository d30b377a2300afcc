"""Audits in the database."""

import math
from collections.abc import Iterator

from curate.evaluation.audit import Estimate, Figures
from curate.evaluation.judged_labels import WHOLE
from db import bulk
from pipelines.assessment.audit import AuditedRound
from pipelines.workspace.workspace import Workspace

ESTIMATES = (
    "share_right",
    "auroc",
    "average_precision",
    "weighted_precision",
    "weighted_recall",
    "calibration_error",
)


def store_audit(workspace: Workspace, found: AuditedRound) -> None:
    """Replaces what is stored of the same round, frames and overlap."""
    request = found.request
    key = (found.context.number, request.frames, request.overlap)
    rows: dict[str, list[bulk.Row]] = {"audit": [], "audit_slice": [], "audit_bin": []}
    for figures in found.figures.figures:
        of = (*key, figures.policy, figures.category)
        part = figures.slice
        if part == WHOLE:
            rows["audit"].append((*of, *_judgement(figures)))
            rows["audit_bin"] += _bin_rows(of, figures)
        else:
            edges = (part.by, part.low, _finite(part.high))
            rows["audit_slice"].append((*of, *edges, *_judgement(figures)))
    with workspace.database.writing() as connection:
        for name, new in rows.items():
            table = bulk.table(name)
            same = zip((table.c.round, table.c.frames, table.c.overlap), key, strict=True)
            connection.execute(table.delete().where(*(column == value for column, value in same)))
            bulk.insert(connection, name, new)


def _judgement(figures: Figures) -> bulk.Row:
    """The columns that `audit` and `audit_slice` have in common."""
    estimates: list[Estimate] = [getattr(figures, name) for name in ESTIMATES]
    return (
        *(figures.labels, figures.neutral, figures.right, figures.objects),
        *(_finite(value) for each in estimates for value in (each.value, each.low, each.high)),
    )


def _bin_rows(of: bulk.Row, figures: Figures) -> Iterator[bulk.Row]:
    """The bins that hold a label."""
    bins = figures.bins
    columns = (
        *(bins.edges[:-1], bins.edges[1:], bins.labels),
        *(bins.mean_weight, bins.precision, bins.recall),
    )
    for low, high, labels, *values in zip(*(column.tolist() for column in columns), strict=True):
        if labels:
            yield (*of, low, high, labels, *map(_finite, values))


def _finite(value: float) -> float | None:
    """A number of Python; None where it is undefined or infinite."""
    return float(value) if math.isfinite(value) else None
