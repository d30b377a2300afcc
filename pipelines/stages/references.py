"""References of the semantic prior: the share S/A of labeled boxes, computed once and stored."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sqlalchemy import select

from curate.priors.semantic import SemanticPrior, ShareReference, learn_references
from db import bulk
from pipelines.assembly import open_segmenter, segmenter_path
from pipelines.engine.plan import digest
from pipelines.stages.predict import settings_of_results
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace, sha256, stat_fingerprint


def share_references(workspace: Workspace) -> dict[str, ShareReference]:
    """Return the reference of each category, from X_l; they are computed once, and stored.

    The maps of the labeled frames are read from the cache, or made.
    """
    if stored := stored_references(workspace):
        return stored
    found, fingerprint = _learn(workspace), digest(_settings(workspace))
    rows = [
        {
            "category": category,
            "boxes": each.boxes,
            "upper_quartile": each.upper_quartile,
            "fingerprint": fingerprint,
        }
        for category, each in found.items()
    ]
    table = bulk.table("semantic_reference")
    with workspace.database.writing() as connection:
        connection.execute(table.delete())
        bulk.insert_rows(connection, table.name, rows)
    return found


def stored_references(workspace: Workspace) -> dict[str, ShareReference]:
    """Return the stored references; nothing if segmenter, labeled frames or categories changed."""
    table = bulk.table("semantic_reference")
    query = select(table.c.category, table.c.boxes, table.c.upper_quartile).where(
        table.c.fingerprint == digest(_settings(workspace))
    )
    return {
        category: ShareReference(boxes, quartile)
        for category, boxes, quartile in workspace.database.rows(query)
    }


def settings_of_segmenter(config: Config) -> Mapping[str, Any]:
    """Return the settings and the model that semantic maps depend on."""
    return {
        "segmenter": settings_of_results(config.segmenter),
        "model": _identity(segmenter_path(config)),
    }


def _identity(path: Path | None) -> str:
    """Return a fingerprint of a model file, or of a folder of saved maps."""
    if path is not None and path.is_dir():
        return stat_fingerprint(path)
    return sha256(path) if path is not None and path.is_file() else str(path)


def _settings(workspace: Workspace) -> Mapping[str, Any]:
    """Return everything that the references depend on."""
    dataset = workspace.config.dataset
    return {
        **settings_of_segmenter(workspace.config),
        "labeled": sorted(workspace.frames("labeled")),
        "categories": dataset.categories,
        "rename": dataset.rename,
        "cameras": dataset.options.get("cameras"),
    }


def _learn(workspace: Workspace) -> dict[str, ShareReference]:
    prior = SemanticPrior(open_segmenter(workspace.config))
    truth = workspace.ground_truth("labeled")
    read = workspace.dataset.read
    return learn_references(
        (
            (read(frame, points=prior.needs_points, image=prior.needs_image), annotations)
            for frame, annotations in truth.items()
        ),
        workspace.config.dataset.categories,
        prior,
    )
