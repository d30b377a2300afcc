"""A toy workspace."""

from pathlib import Path

import pytest
from pipelines_cli import Curate, in_process
from toys import toy_document

from pipelines.config import make_config
from pipelines.setup import initialise
from pipelines.workspace import Workspace


@pytest.fixture
def weights_file(tmp_path: Path) -> Path:
    """What the toy detector takes for its checkpoint."""
    path = tmp_path / "detector.txt"
    path.write_text("")
    return path


@pytest.fixture
def workspace(tmp_path: Path, toy_kitti: Path, weights_file: Path) -> Workspace:
    """Two labeled, six unlabeled and four val frames."""
    config = make_config(toy_document(toy_kitti, weights_file), "test")
    return initialise(tmp_path / "work", config, "0.25", "")


@pytest.fixture
def curate(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> Curate:
    """Runs the command line in this process: exit code, standard output, standard error."""
    return in_process(monkeypatch, capsys)
