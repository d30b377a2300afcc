"""A toy workspace."""

from collections.abc import Callable
from pathlib import Path

import pytest
from support.pipelines_cli import Curate, in_process
from support.toys import toy_document

from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace


@pytest.fixture
def weights_file(tmp_path: Path) -> Path:
    """Return the file that the toy detector takes for its checkpoint."""
    path = tmp_path / "detector.txt"
    path.write_text("")
    return path


@pytest.fixture
def workspace(
    tmp_path: Path, toy_kitti: Path, weights_file: Path, new_url: Callable[[], str | None]
) -> Workspace:
    """Return a workspace of two labeled, six unlabeled and four val frames, with either engine."""
    document = toy_document(toy_kitti, weights_file) | {"run": {"database": new_url()}}
    return initialise(tmp_path / "work", make_config(document, "test"), "0.25", "")


@pytest.fixture
def another(workspace: Workspace, new_url: Callable[[], str | None]) -> Callable[[Path], Workspace]:
    """Return a function that creates a workspace with the same settings and a new database."""

    def make(root: Path) -> Workspace:
        apart = workspace.with_settings("run", database=new_url())
        return initialise(root, apart.config, "0.25", "")

    return make


@pytest.fixture
def curate(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> Curate:
    """Return a function that runs the command line in this process: (exit code, stdout, stderr)."""
    return in_process(monkeypatch, capsys)
