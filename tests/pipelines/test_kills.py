"""SIGKILL in every stage: what was killed and runs again ends like what was never killed."""

import shlex
import signal
import sqlite3
import sys
import time
from contextlib import closing
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from process_tree import start
from stored_rows import dump
from toys import toy_document, write_toy_kitti

from pipelines.config import make_config
from pipelines.executors.serial import SerialExecutor
from pipelines.progress import Silent
from pipelines.round import active
from pipelines.rounds import open_round
from pipelines.runner import run_frames, run_round
from pipelines.schedule import run_all
from pipelines.setup import initialise
from pipelines.stage import FrameStage
from pipelines.workspace import Workspace

# The commands, and what is up to date when they begin.
COMMANDS = {
    ("predict",): "predict",
    ("predict", "--workers", "2"): "predict",
    ("repredict",): "repredict",
    ("score",): "points",
    ("solve",): "solve",
    ("export",): "export",
    ("train-round",): "train-round",
    ("run",): "predict",
}
TRAINER = "import sys, time; time.sleep(0.2); open(sys.argv[1], 'w').write('student')"
DELAY_S = "0.05"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy data set and its detector."""
    home = tmp_path_factory.mktemp("kills")
    write_toy_kitti(home / "kitti", frames=12, val=4)
    (home / "detector.txt").write_text("")
    return home


@pytest.fixture(scope="module")
def whole(home: Path) -> list[tuple]:
    """What an uninterrupted run stores and exports."""
    workspace = made(home, home / "whole")
    list(run_all(workspace, None, Silent()))
    return results(workspace)


def made(home: Path, folder: Path) -> Workspace:
    """A workspace of one round that ends with a student."""
    document = toy_document(home / "kitti", home / "detector.txt")
    command = f"{shlex.join([sys.executable, '-c', TRAINER])} {{output}}"
    document |= {"run": {"rounds": 1}, "train": {"command": command}}
    return initialise(folder, make_config(document, "test"), "0.25", "")


def prepared(home: Path, folder: Path, until: str) -> Workspace:
    """A workspace in which every stage before one is up to date."""
    workspace = made(home, folder)
    context = open_round(workspace, 1)
    for stage in active(workspace.config.run.priors):
        if stage.name == until:
            break
        if isinstance(stage, FrameStage):
            run_frames(workspace, context, stage, SerialExecutor(), Silent())
        else:
            run_round(workspace, context, stage, "pspsl", Silent())
    return workspace


def results(workspace: Workspace) -> list[tuple]:
    """All rows of the database and of the exported file, and the student."""
    with closing(sqlite3.connect(workspace.root / "exports" / "labels.sqlite")) as labels:
        exported = [("exported", line) for line in labels.iterdump()]
    students = sorted((workspace.root / "checkpoints").glob("*.*"))
    return [*dump(workspace), *exported, *((path.name, path.read_bytes()) for path in students)]


def was_killed(workspace: Workspace, command: tuple[str, ...], moment_s: float) -> bool:
    """Whether SIGKILL met the command so long after it has opened the database."""
    running = start(*command, "-w", workspace.root, TOY_DELAY_S=DELAY_S)
    while running.poll() is None and not _has_open(running.pid, workspace.root / "curate.db"):
        time.sleep(0.002)
    time.sleep(moment_s)
    running.kill()
    running.communicate()
    return running.returncode == -signal.SIGKILL


def _has_open(pid: int, path: Path) -> bool:
    try:
        return any(link.resolve() == path for link in Path(f"/proc/{pid}/fd").iterdir())
    except OSError:
        return False


def refuse_half_frames(workspace: Workspace) -> None:
    """The file is sound, and no frame has rows without the task that they were stored with."""
    with closing(sqlite3.connect(workspace.root / "curate.db")) as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        for table, stage in (
            ("prediction", "predict"),
            ("reprediction_view", "repredict"),
            ("point_prior", "points"),
            ("semantic_prior", "semantic"),
        ):
            query = (
                f"SELECT count(*) FROM {table} AS r WHERE NOT EXISTS (SELECT 1 FROM task AS t "
                f"WHERE t.stage = '{stage}' AND t.frame_id = r.frame_id)"
            )
            assert database.execute(query).fetchone() == (0,), table


def kill_and_resume(
    home: Path, folder: Path, command: tuple[str, ...], generator: np.random.Generator, kills: int
) -> tuple[int, list[tuple]]:
    """Kills a command some times, lets it end; how often it was met, and the results."""
    workspace = prepared(home, folder, COMMANDS[command])
    met, span_s = 0, 1.0
    for _ in range(kills):
        if was_killed(workspace, command, generator.uniform(0, span_s)):
            met += 1
        else:
            span_s /= 2
        refuse_half_frames(workspace)
    list(run_all(workspace, None, Silent()))
    return met, results(workspace)


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="moments are read from /proc")
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_killed_command_loses_and_doubles_nothing(
    home: Path, whole: list[tuple], tmp_path: Path, command: tuple[str, ...]
) -> None:
    """One kill at some moment, then everything to its end."""
    generator = np.random.default_rng(abs(hash(tmp_path.name)) % 2**32)
    _, found = kill_and_resume(home, tmp_path / "work", command, generator, kills=1)
    assert found == whole


@pytest.mark.slow
def test_a_hundred_kills_lose_and_double_nothing(
    home: Path, whole: list[tuple], tmp_path: Path
) -> None:
    """At random moments of every stage, up to three times in a row."""
    generator = np.random.default_rng(0)
    total = dict.fromkeys(COMMANDS, 0)
    for number, command in enumerate(cycle(COMMANDS)):
        kills = int(generator.integers(1, 4))
        folder = tmp_path / f"work-{number}"
        met, found = kill_and_resume(home, folder, command, generator, kills)
        assert found == whole, (number, command)
        total[command] += met
        if sum(total.values()) >= 100:
            break
    print({" ".join(command): met for command, met in total.items()})  # noqa: T201
