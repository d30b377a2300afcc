"""A workspace in a folder that the user cannot write."""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from support.paths import ROOT
from support.pipelines_cli import Curate

from pipelines.workspace.workspace import Workspace

SELECT = "SELECT count(*) AS labels FROM weighted_labels"


# Root can write everywhere, unless it gives up the right to ignore permissions.
AS_READER = (
    ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
)
pytestmark = pytest.mark.skipif(
    bool(AS_READER) and shutil.which("setpriv") is None, reason="needs setpriv or another user"
)


def as_a_reader(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run curate as a user who can read the workspace but not write it."""
    return subprocess.run(
        [*AS_READER, sys.executable, "-m", "pipelines", *map(str, arguments)],
        capture_output=True, text=True, check=False, cwd=ROOT,
        env=os.environ | {"PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "tests")))},
    )  # fmt: skip


@pytest.fixture
def read_only(curate: Curate, workspace: Workspace) -> Iterator[Path]:
    """Yield the folder of a workspace with weights that nobody can write."""
    assert curate("run", "-w", workspace.root)[0] == 0
    workspace.database.close()
    for path in (*workspace.root.rglob("*"), workspace.root):
        path.chmod(0o555 if path.is_dir() else 0o444)
    yield workspace.root
    for path in (workspace.root, *workspace.root.rglob("*")):
        path.chmod(0o755)


def test_status_and_query_work(read_only: Path) -> None:
    """And whatever else only reads."""
    found = as_a_reader("status", "-w", read_only, "--json")
    assert found.returncode == 0, found.stderr
    assert {row["state"] for row in json.loads(found.stdout)} == {"done"}
    for command in (
        ("query", SELECT, "--json", "-w", read_only),
        ("query", SELECT, "--json", "--file", read_only / "exports" / "labels.sqlite"),
    ):
        found = as_a_reader(*command)
        assert found.returncode == 0, found.stderr
        assert json.loads(found.stdout)[0]["labels"] >= 18
    for command in (("query", "--schema"), ("query", "--named", "counts"), ("review", "list")):
        found = as_a_reader(*command, "-w", read_only)
        assert found.returncode == 0, found.stderr


def test_a_command_that_writes_says_what_to_do(read_only: Path) -> None:
    """In one line."""
    found = as_a_reader("solve", "--policy", "uniform", "-w", read_only)
    assert found.returncode == 7
    assert "give yourself write permission on the database's folder" in found.stderr
    assert len(found.stderr.splitlines()) == 1


def test_an_older_database_is_not_migrated(read_only: Path) -> None:
    """The line says that it must be copied."""
    read_only.chmod(0o755)
    path = read_only / "curate.db"
    path.chmod(0o644)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("DELETE FROM view_definition")
        connection.commit()
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    path.chmod(0o444)
    read_only.chmod(0o555)
    found = as_a_reader("status", "-w", read_only)
    assert found.returncode == 7
    assert "an older curate wrote it" in found.stderr
    assert "copy the workspace into a folder of your own" in found.stderr
    assert len(found.stderr.splitlines()) == 1
