"""Reading what a calibration needs to know of the labels of a round."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from curate.calibration.features import LabelEvidence
from db import bulk
from db.evidence import OWN_TABLES
from db.models import BOX_COLUMNS
from pipelines.labels.evidence import LabelKeys, aligned_query
from pipelines.labels.sources import prepare_table, sources_of
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace

_TABLES: Mapping[str, Mapping[str, str]] = {
    "points": {"points": "point_prior", "rho_diff": "point_prior"},
    "semantic": {"mask_pixels": "semantic_prior", "box_pixels": "semantic_prior"},
}


def further_columns(config: Config) -> tuple[str, ...]:
    """Return the columns of further evidence that a calibration uses.

    These are the quantities that the sources of run.priors declare besides the two of the paper. A
    column without a unit, such as the number of a track, is a name and not a quantity.
    """
    return tuple(
        column.name
        for source in sources_of(config.run.priors)
        if source.declaration.name not in OWN_TABLES
        for column in source.declaration.columns
        if column.kind != "name" and column.unit
    )


def read_label_evidence(
    workspace: Workspace, round_number: int, frames: Sequence[int]
) -> tuple[LabelKeys, LabelEvidence]:
    """Return the keys of all labels of some frames and their evidence, sorted by frame key and k.

    Args:
        workspace: the workspace.
        round_number: number e of the round.
        frames: keys of the frames.
    """
    tables = {"score": "prediction", "loss": "consistency"}
    tables |= dict.fromkeys(BOX_COLUMNS, "prediction")
    for source in sources_of(workspace.config.run.priors):
        prepare_table(workspace, source)
        tables |= _TABLES.get(source.declaration.name, {})
        declared = {column.name for column in source.declaration.columns}
        for name in declared.intersection(further_columns(workspace.config)):
            tables[name] = source.table
    with workspace.database.reading() as connection:
        found = bulk.select_columns(connection, aligned_query(round_number, tables))
    inside = np.isin(found["frame_id"], np.asarray(frames, dtype=np.int64))
    found = {name: column[inside] for name, column in found.items()}
    keys = LabelKeys(found["frame_id"], found["k"], found["category"])
    return keys, as_label_evidence(workspace.config, found, len(keys))


def label_evidence_of(config: Config, label: Mapping[str, Any]) -> LabelEvidence:
    """Return the evidence of one label, from its row of `weighted_labels`."""
    found = {
        name: np.array([value]) if isinstance(value, str) else np.array([value], dtype=np.float64)
        for name, value in label.items()
    }
    return as_label_evidence(config, found, 1)


def as_label_evidence(config: Config, found: Mapping[str, np.ndarray], count: int) -> LabelEvidence:
    """Return columns of labels as evidence; a missing column is NaN.

    Args:
        config: the settings, which say what evidence is used.
        found: (n,) columns by name, as in `weighted_labels`.
        count: number of labels n.
    """
    missing = np.full(count, np.nan)
    box_pixels = found.get("box_pixels", missing)
    seen = np.where(box_pixels > 0, box_pixels, np.nan)
    return LabelEvidence(
        category=found["category"],
        score=found["score"],
        loss=found.get("loss", missing),
        points=found.get("points", missing),
        rho_diff=found.get("rho_diff", missing),
        pixel_share=found.get("mask_pixels", missing) / seen,
        boxes=np.stack([found[name] for name in BOX_COLUMNS], axis=1),
        further={name: found.get(name, missing) for name in further_columns(config)},
    )
