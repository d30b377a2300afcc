"""Two `curate` processes on one database, with either engine."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from support.paths import TESTS
from support.pipelines_cli import Curate
from support.toys import arrival

from curate.errors import DatabaseError
from db import bulk
from pipelines.engine.rounds import open_round
from pipelines.workspace.workspace import Workspace

ENGINES = ("sqlite", "postgresql")
LONGEST_WAIT_S = 120


@pytest.fixture
def gate(tmp_path: Path) -> Path:
    """Return a file; while it exists, detectors wait."""
    path = tmp_path / "gate"
    path.touch()
    return path


def started(workspace: Workspace, gate: Path, *command: str) -> subprocess.Popen:
    """Start a process with a detector that waits at the gate."""
    path = f"{TESTS}:{TESTS.parent}"
    return subprocess.Popen(
        [sys.executable, "-m", "pipelines", *command, "-w", str(workspace.root)],
        env=os.environ | {"PYTHONPATH": path, "TOY_GATE": str(gate)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def owner(workspace: Workspace, number: int) -> str | None:
    """Return the message for a second process that wants to work on a round; None if it is free."""
    try:
        with workspace.database.claiming_round(number, None, "a question"):
            return None
    except DatabaseError as error:
        return str(error)


def wait_until(condition: Callable[[], bool], process: subprocess.Popen | None = None) -> None:
    """Return once a condition holds; fail if the process ends before."""
    end = time.monotonic() + LONGEST_WAIT_S
    while not condition():
        assert process is None or process.poll() is None, process.communicate()[1]
        assert time.monotonic() < end
        time.sleep(0.1)  # the check itself holds the claim for a moment


def labels(workspace: Workspace, number: int) -> list[tuple]:
    """Return the predictions of a round, without its number."""
    table = bulk.table("prediction")
    with workspace.database.reading() as connection:
        return sorted(
            row[1:] for row in bulk.select(connection, table.select()) if row[0] == number
        )


def test_two_processes_cannot_work_on_one_round(
    workspace: Workspace, curate: Curate, gate: Path
) -> None:
    """The second gets a one-line error with the first; a killed owner does not block."""
    first = started(workspace, gate, "predict")
    wait_until(arrival(gate, first.pid).exists, first)
    assert f"process {first.pid} " in (owner(workspace, 1) or "")
    for command in (["predict"], ["repredict"], ["solve"]):
        code, _, err = curate(*command, "-w", workspace.root)
        assert code == DatabaseError.exit_code
        assert err.startswith("error: round 1 is being worked on by predict, process")
        assert err.count("\n") == 1
    first.kill()
    first.communicate()
    # A server notices the end of a killed client only a little later.
    wait_until(lambda: owner(workspace, 1) is None)
    assert curate("predict", "-w", workspace.root)[0] == 0
    assert len(labels(workspace, 1)) == 18


def test_different_rounds_run_in_parallel(workspace: Workspace, gate: Path) -> None:
    """Both work at the same moment, and both have the rows of a single run."""
    both = {
        number: started(workspace, gate, "predict", "--round", str(number)) for number in (1, 2)
    }
    for number, process in both.items():
        wait_until(arrival(gate, process.pid).exists, process)
        assert owner(workspace, number) is not None
    assert [process.poll() for process in both.values()] == [None, None]
    gate.unlink()
    messages = [process.communicate()[1] for process in both.values()]
    assert [process.returncode for process in both.values()] == [0, 0], messages
    assert len(labels(workspace, 1)) == 18
    assert labels(workspace, 1) == labels(workspace, 2)


def test_settings_of_a_round_in_progress_do_not_change(workspace: Workspace) -> None:
    """The recorded settings are those that its owner works with."""
    open_round(workspace, 1)
    changed = workspace.with_settings("detector", minimum_score=0.5)
    with workspace.database.claiming_round(1, None, "predict"):
        open_round(workspace, 1)
        with pytest.raises(DatabaseError, match="round 1 is being worked on by predict"):
            open_round(changed, 1)
    open_round(changed, 1)
