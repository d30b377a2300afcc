"""Rules about ground truth: none of X_u is stored, and none passes for a prediction."""

from collections.abc import Mapping, Sequence

import numpy as np
from sqlalchemy import func, select

from curate.errors import DataError
from curate.exporters.base import named
from curate.files.batches import batched
from curate.firewall.copied_truth import copied_boxes
from db import bulk
from pipelines.firewall.finding import Finding
from pipelines.workspace.split_record import SplitRecord
from pipelines.workspace.workspace import Workspace

# Before a command, so many frames are compared with label files besides those with a score of 1.
_SAMPLED_FRAMES = 256
_CERTAIN = 0.9999
_BATCH = 256


def stored_truth(workspace: Workspace) -> Finding:
    """Rows of ground truth belong to X_l and val, and X_u names no label file."""
    rule = "no ground truth of X_u is stored"
    truth, frame = bulk.table("ground_truth"), bulk.table("frame")
    rows_of = (
        select(frame.c.split, truth.c.split, func.count(), func.min(frame.c.frame))
        .join(frame, frame.c.id == truth.c.frame_id, isouter=True)
        .group_by(frame.c.split, truth.c.split)
    )
    paths = select(frame.c.frame).where(
        frame.c.split == "unlabeled", frame.c.label_path.is_not(None)
    )
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, rows_of)
        pointed = [row[0] for row in bulk.select(connection, paths)]
    leaked = [row for row in rows if row[0] not in ("labeled", "val") or row[0] != row[1]]
    remedy = (
        "the database was changed: restore a backup, or make a new workspace with `curate init`"
    )
    if leaked:
        count, first = sum(row[2] for row in leaked), leaked[0][3]
        return Finding(rule, False, f"{count} rows of ground_truth, such as {first}", remedy)
    if pointed:
        return Finding(rule, False, f"label paths of {named(pointed)}", remedy)
    held = {row[0]: row[2] for row in rows}
    told = f"{held.get('labeled', 0)} objects of X_l, {held.get('val', 0)} of val, 0 of X_u"
    return Finding(rule, True, told)


def copied_truth(
    workspace: Workspace, record: SplitRecord, rounds: Sequence[int], *, thorough: bool
) -> Finding:
    """Predictions of X_u are compared with label files of X_u, of which nothing is kept."""
    rule = "no prediction repeats a label of X_u"
    files = workspace.dataset.files
    frames = {name: key for name, key in record.splits["unlabeled"].items() if files(name).label}
    compared = 0
    copies: dict[str, int] = {}
    for number in rounds:
        chosen = frames if thorough else _suspects(workspace, number, frames)
        for names in batched(chosen, _BATCH):
            batch = {chosen[name]: name for name in names}
            for key, found in workspace.predictions(number, list(batch)).items():
                compared += len(found)
                copied = int(_repeated(workspace, batch[key], found.boxes).sum())
                if copied:
                    copies[batch[key]] = copies.get(batch[key], 0) + copied
    if not copies:
        told = f"{compared} predictions compared with label files"
        return Finding(rule, True, told if frames else "X_u has no label files")
    told = f"{sum(copies.values())} predictions are equal to label files, in frames {named(copies)}"
    remedy = (
        "the detector or its record has seen ground truth of X_u: bring one that has not, and run "
        "`curate predict` again"
    )
    return Finding(rule, False, told, remedy)


def _suspects(workspace: Workspace, number: int, frames: Mapping[str, int]) -> Mapping[str, int]:
    """Return the frames with a prediction that is certain, and others spread over the rest."""
    table = bulk.table("prediction")
    query = select(table.c.frame_id).distinct()
    query = query.where(table.c.round == number, table.c.score >= _CERTAIN)
    certain = {row[0] for row in workspace.database.rows(query)}
    step = max(1, len(frames) // _SAMPLED_FRAMES)
    return {
        name: key for i, (name, key) in enumerate(frames.items()) if key in certain or i % step == 0
    }


def _repeated(workspace: Workspace, frame: str, boxes: np.ndarray) -> np.ndarray:
    try:
        return copied_boxes(boxes, workspace.dataset.annotations(frame))
    except DataError:  # a label file that nobody reads may be of any form
        return np.zeros(len(boxes), dtype=bool)


def predicted_rounds(workspace: Workspace) -> list[int]:
    """Return the rounds that have predictions."""
    with workspace.database.reading() as connection:
        query = select(bulk.table("prediction").c.round).distinct()
        return sorted(row[0] for row in bulk.select(connection, query))
