"""Rules about ground truth: none of X_u is stored, and no prediction is a copy of it."""

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
from pipelines.workspace.splits import HELD_OUT, WITH_TRUTH
from pipelines.workspace.workspace import Workspace

# Frames that are compared with label files before a command, besides those with a score of 1.
_SAMPLED_FRAMES = 256
_CERTAIN = 0.9999
_BATCH = 256


def stored_truth(workspace: Workspace) -> Finding:
    """Check that stored ground truth is not of X_u, and that X_u has no label paths."""
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
        with_path = [row[0] for row in bulk.select(connection, paths)]
    leaked = [row for row in rows if row[0] not in WITH_TRUTH or row[0] != row[1]]
    remedy = (
        "the database was changed: restore a backup, or create a new workspace with `curate init`"
    )
    if leaked:
        count, first = sum(row[2] for row in leaked), leaked[0][3]
        message = (
            f"{count} rows of ground_truth are of the wrong split, such as those of frame {first}"
        )
        return Finding(rule, False, message, remedy)
    if with_path:
        return Finding(rule, False, f"label paths are stored for {named(with_path)}", remedy)
    counts = {row[0]: row[2] for row in rows}
    held_out = "".join(
        f"{counts.get(split, 0)} of {split}, "
        for split in HELD_OUT
        if split == "val" or split in counts
    )
    message = f"{counts.get('labeled', 0)} objects of X_l, {held_out}0 of X_u"
    return Finding(rule, True, message)


def copied_truth(
    workspace: Workspace, record: SplitRecord, rounds: Sequence[int], *, thorough: bool
) -> Finding:
    """Check that no prediction of X_u equals a box in a label file; label files are not stored."""
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
        message = f"{compared} predictions compared with label files"
        return Finding(rule, True, message if frames else "X_u has no label files")
    message = f"{sum(copies.values())} predictions equal labels, in frames {named(copies)}"
    remedy = (
        "the detector was trained on ground truth of X_u, or its results contain it: use a "
        "detector that has not seen it, and rerun `curate predict`"
    )
    return Finding(rule, False, message, remedy)


def _suspects(workspace: Workspace, number: int, frames: Mapping[str, int]) -> Mapping[str, int]:
    """Return the frames with a certain prediction, and an even sample of the others."""
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
    except DataError:  # label files of X_u are not used, so they may be invalid
        return np.zeros(len(boxes), dtype=bool)


def predicted_rounds(workspace: Workspace) -> list[int]:
    """Return the rounds that have predictions."""
    with workspace.database.reading() as connection:
        query = select(bulk.table("prediction").c.round).distinct()
        return sorted(row[0] for row in bulk.select(connection, query))
