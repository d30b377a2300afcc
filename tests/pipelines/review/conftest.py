"""A workspace with weights, and one with a review imported."""

from pathlib import Path

import pytest
from support.pipelines_cli import Curate
from support.reviewed import advance, corrected, export_review, import_review, only_first

from pipelines.workspace.workspace import Workspace


@pytest.fixture
def weighted(curate: Curate, workspace: Workspace) -> Workspace:
    """Create weights for X_u in round 1."""
    advance(curate, workspace, 1)
    return workspace


@pytest.fixture
def reviewed(curate: Curate, weighted: Workspace, tmp_path: Path) -> tuple[Workspace, Path, str]:
    """Return workspace, folder and frame of a review with one frame corrected and imported."""
    folder = tmp_path / "review"
    frame = export_review(curate, weighted, folder, *only_first(weighted))
    corrected(folder, frame)
    import_review(curate, weighted, folder)
    return weighted, folder, frame
