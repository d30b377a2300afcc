"""The stored calibration of a round, and the evidence of labels for it."""

from collections.abc import Sequence

import numpy as np
from sqlalchemy import select

from curate.calibration.conformal import HeldOut, Unit
from curate.calibration.features import LabelEvidence
from curate.calibration.model import Calibration, TooFewLabels
from curate.datasets.base import sequences_of
from curate.errors import WorkspaceError
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.labels.evidence import LabelKeys, aligned
from pipelines.labels.sources import prepare_table, sources_of
from pipelines.workspace.workspace import Workspace

_PRIORS = {
    "points": "point_prior",
    "rho_diff": "point_prior",
    "mask_pixels": "semantic_prior",
    "box_pixels": "semantic_prior",
}


def read_label_evidence(
    workspace: Workspace, round_number: int, frames: Sequence[int]
) -> tuple[LabelKeys, LabelEvidence]:
    """Return the keys of all labels of some frames, and their evidence for a calibration.

    Further evidence is that of the sources of sequences in run.priors, such as tracks.

    Args:
        workspace: the workspace.
        round_number: number e of the round.
        frames: keys of the frames.
    """
    sources = sources_of(workspace.config.run.priors)
    for source in sources:
        prepare_table(workspace, source)
    further = {
        column.name: source.table
        for source in sources
        if source.of_sequences
        for column in source.declaration.columns
        if column.kind != "name"
    }
    used = {source.table for source in sources}  # others may hold outdated evidence
    priors = {name: table for name, table in _PRIORS.items() if table in used}
    tables = dict.fromkeys(("score", *BOX_COLUMNS), "prediction") | {"loss": "consistency"}
    with workspace.database.reading() as connection:
        query = aligned(round_number, tables | priors | further)
        found = bulk.select_columns(connection, query)
    inside = np.isin(found["frame_id"], np.asarray(frames, dtype=np.int64))
    found = {name: column[inside] for name, column in found.items()}
    missing = np.full(int(inside.sum()), np.nan)
    found |= {name: missing for name in _PRIORS if name not in priors}
    pixels = np.where(found["box_pixels"] > 0, found["box_pixels"], np.nan)
    return LabelKeys(found["frame_id"], found["k"], found["category"]), LabelEvidence(
        category=found["category"],
        score=found["score"],
        loss=found["loss"],
        points=found["points"],
        rho_diff=found["rho_diff"],
        pixel_share=found["mask_pixels"] / pixels,
        boxes=np.stack([found[name] for name in BOX_COLUMNS], axis=1),
        further={name: found[name] for name in further},
    )


def read_calibration(workspace: Workspace, round_number: int) -> Calibration:
    """Return the calibration of a round.

    Raises:
        TooFewLabels: if there were too few labels to fit one; the message says how many.
        WorkspaceError: if the round was not calibrated.
        DataError: if the stored calibration is damaged.
    """
    table = bulk.table("calibration")
    query = select(table.c.fit, table.c.fallback).where(table.c.round == round_number)
    found = workspace.database.rows(query)
    if not found:
        raise WorkspaceError(
            f"round {round_number} has no calibration; run `curate calibrate --round "
            f"{round_number}`"
        )
    fit, fallback = found[0]
    if fit is None:
        raise TooFewLabels(fallback)
    return Calibration.from_json(fit)


def read_held_out(workspace: Workspace, round_number: int) -> HeldOut | None:
    """Return the labels that neither the teacher nor the fit of a round has used; None for none."""
    calibration, label = bulk.table("calibration"), bulk.table("calibration_label")
    query = select(calibration.c.unit).where(
        calibration.c.round == round_number, calibration.c.held_out_frames > 0
    )
    found: list[tuple[Unit]] = list(workspace.database.rows(query))
    if not found:
        return None
    columns = (label.c.unit, label.c.probability, label.c.correct)
    rows = workspace.database.rows(select(*columns).where(label.c.round == round_number))
    units = np.unique([unit for unit, _, _ in rows], return_inverse=True)[1]
    return HeldOut.of_labels(
        found[0][0],
        units,
        np.array([p for _, p, _ in rows], dtype=np.float64),
        np.array([correct == 0 for _, _, correct in rows], dtype=bool),
    )


def exchangeable_units(workspace: Workspace, frames: Sequence[str]) -> tuple[Unit, list[str]]:
    """Return what is exchangeable, frames or whole sequences, and the unit of each frame.

    It is the sequence if the data set has sequences and the splits keep them together.
    """
    section = workspace.config.dataset
    sequences = sequences_of(workspace.dataset, frames) if section.split_by == "sequence" else {}
    return ("sequence" if sequences else "frame"), [sequences.get(each, each) for each in frames]


def calibration_fingerprint(workspace: Workspace, round_number: int) -> list[object]:
    """Return what weights depend on besides the evidence: the fit, and the held-out labels."""
    table = bulk.table("calibration")
    query = select(table.c.fit, table.c.fallback).where(table.c.round == round_number)
    held_out = read_held_out(workspace, round_number)
    labels = held_out and [held_out.unit, held_out.units, held_out.wrong.tolist()]
    return [*map(list, workspace.database.rows(query)), labels]
