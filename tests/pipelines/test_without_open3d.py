"""Without open3d, everything but simulation works."""

import sys
from pathlib import Path

import pytest
from support.pipelines_cli import Curate

from pipelines.workspace.workspace import Workspace


@pytest.fixture(autouse=True)
def _without_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every import of open3d fail."""
    monkeypatch.setitem(sys.modules, "open3d", None)


def test_user_data_can_be_curated(curate: Curate, workspace: Workspace) -> None:
    """A round, its labels, and the commands that show them."""
    for arguments in (
        ("run", "--rounds", 1),
        ("status",),
        ("query", "SELECT count(*) FROM weighted_labels"),
        ("view", "--all", "--limit", 1),
        ("report",),
        ("doctor",),
        ("check",),
    ):
        code, _, error = curate(*arguments, "-w", workspace.root)
        assert code == 0, f"{arguments}: {error}"
    assert (workspace.root / "exports" / "labels.sqlite").exists()


@pytest.mark.parametrize("command", ["simulate", "demo"])
def test_simulation_reports_the_missing_package(
    curate: Curate, tmp_path: Path, command: str
) -> None:
    """In one line, with the exit code of a wrong configuration."""
    arguments = ("--frames", 8, "--val", 4, "--workers", 1)
    code, _, error = curate(command, tmp_path / "made", *arguments)
    assert code == 2
    assert error.splitlines()[-1].startswith("error: simulation needs open3d, which cannot be")
    assert "pip install open3d-cpu" in error
    assert "Traceback" not in error
