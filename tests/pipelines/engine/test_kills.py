"""SIGKILL in every stage: a killed and resumed run ends like an undisturbed one."""

import os
import shlex
import shutil
import signal
import sqlite3
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from support import older_schema
from support.command_forks import CommandForks
from support.rounds import run_stage, run_workspace
from support.stored_rows import dump
from support.toys import toy_document, write_toy_kitti

from db.views import drop_views
from pipelines.round import graph_of
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

# The commands, and the stage that they start with: all stages before it are up to date.
COMMANDS = {
    "init": None,
    "segment": "segment",
    "segment --workers 2": "segment",
    "predict": "predict",
    "predict --workers 2": "predict",
    "repredict": "repredict",
    "repredict --workers 2": "repredict",
    "score --prior points": "points",
    "score --prior semantic": "semantic",
    "solve": "solve",
    "export": "export",
    "train-round": "train-round",
    "run": "predict",
    "status of an older schema": "export",
    "review import": "export",
}
TRAINER = "import sys, time; time.sleep(0.1); open(sys.argv[1], 'w').write('student')"
DELAY_S = "0.02"
OLDER_SCHEMA = "0003"
LONGEST_S, SHORTEST_S = 4.0, 0.02
KILLS = 100
WRITTEN_BY = {
    "prediction": "predict",
    "reprediction_view": "repredict",
    "point_prior": "points",
    "semantic_prior": "semantic",
}

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="commands are forked")


@pytest.fixture(scope="module")
def forks() -> Iterator[CommandForks]:
    """Return what starts the commands."""
    made = CommandForks()
    yield made
    made.close()


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the toy dataset and its detector."""
    home = tmp_path_factory.mktemp("kills")
    write_toy_kitti(home / "kitti", frames=12, val=4)
    (home / "detector.txt").write_text("")
    return home


class Case:
    """A command, a workspace in which it has work to do, and the expected final contents.

    Args:
        home: dataset and detector.
        folder: for its workspaces.
        name: one of `COMMANDS`.
        forks: starts commands.
        generator: draws the times of the kills.
    """

    def __init__(
        self,
        home: Path,
        folder: Path,
        name: str,
        forks: CommandForks,
        generator: np.random.Generator,
    ) -> None:
        self.home, self.folder, self.forks, self.generator = home, folder, forks, generator
        self.met, self.span_s = 0, 1.0
        self.arguments = self._prepared(name)
        self.workspace = self._fresh("whole")
        self._end_of(self._start())
        self.expected = self._results()

    def kill_and_resume(self, kills: int) -> list[tuple]:
        """Kill the command a few times, let it finish, and return what is stored then."""
        self.workspace = self._fresh("killed")
        for _ in range(kills):
            pid = self._start()
            time.sleep(self.generator.uniform(0, self.span_s))
            os.kill(pid, signal.SIGKILL)  # the process keeps its key until it is waited for
            met = self.forks.end(pid) == -signal.SIGKILL
            self.met += met
            self.span_s = min(max(self.span_s * (1.2 if met else 0.5), SHORTEST_S), LONGEST_S)
            require_whole_frames(self.workspace / "curate.db")
        self._end_of(self._start())
        return self._results()

    def _prepared(self, name: str) -> list[object]:
        """Create a workspace in which all stages before the command are up to date.

        Return its arguments.
        """
        place, until = self.folder / "prepared", COMMANDS[name]
        if until is None:
            place.mkdir(parents=True)
            return ["init", *init_options(self.home)]
        workspace = made(self.home, place)
        run_stages_before(workspace, until)
        if name.startswith("status"):
            downgrade(workspace)
        workspace.database.close()
        if name.startswith("status"):
            return ["status", "-w"]
        if name == "review import":
            self._end_of(
                self.forks.start(["review", "export", self.folder / "review", "-w", place], {})
            )
            return ["review", "import", self.folder / "review", "--accept", "all", "-w"]
        return [*name.split(), "-w"]

    def _fresh(self, name: str) -> Path:
        """Copy the prepared workspace."""
        place = self.folder / name
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(self.folder / "prepared", place)
        return place

    def _start(self) -> int:
        return self.forks.start([*self.arguments, self.workspace], {"TOY_DELAY_S": DELAY_S})

    def _end_of(self, pid: int) -> None:
        assert self.forks.end(pid) == 0, self.arguments

    def _results(self) -> list[tuple]:
        """Return all that a finished run stores: rows, exported file, students, maps, backups."""
        workspace = Workspace.open(self.workspace)
        run_workspace(workspace)
        rows = dump(workspace)
        workspace.database.close()
        with closing(sqlite3.connect(self.workspace / "exports" / "labels.sqlite")) as labels:
            rows += [("exported", line) for line in labels.iterdump()]
        files = [
            *(self.workspace / "checkpoints").glob("*.*"),
            *self.workspace.glob("maps/*/*/*.gz"),
        ]
        rows += [(path.name, path.read_bytes()) for path in sorted(files)]
        return rows + [(path.name,) for path in self.workspace.glob("*.backup")]


def settings(home: Path) -> dict:
    """Return the settings of a workspace with one round that ends with a student."""
    (home / "trainer.py").write_text(TRAINER)
    command = f"{shlex.join([sys.executable, str(home / 'trainer.py')])} {{output}}"
    document = toy_document(home / "kitti", home / "detector.txt")
    document["segmenter"]["name"] = "support.toys:ToyImageSegmenter"
    return document | {"run": {"rounds": 1}, "train": {"command": command}}


def made(home: Path, folder: Path) -> Workspace:
    """Create a workspace."""
    return initialise(folder, make_config(settings(home), "test"), "0.25", "")


def init_options(home: Path) -> list[object]:
    """Return the same settings as command-line options."""
    document = settings(home)
    options: list[object] = ["--root", home / "kitti", "--labeled", "0.25"]
    for section in ("detector", "segmenter"):
        options += [f"--{section}", document[section]["name"]]
        options += [f"--{section}-path", document[section]["path"]]
    command = document["train"]["command"]
    return [*options, "--set", "run.rounds=1", "--set", f"train.command={command}"]


def run_stages_before(workspace: Workspace, until: str) -> None:
    """Run every stage before one."""
    for stage in graph_of(workspace).stages:
        if stage.name == until:
            break
        run_stage(workspace, stage.name)


def downgrade(workspace: Workspace) -> None:
    """Downgrade the database to the schema of an older curate."""
    with workspace.database.writing(keys_known=True) as connection:
        drop_views(connection)
        older_schema.downgrade(connection, OLDER_SCHEMA)


def require_whole_frames(path: Path) -> None:
    """Check that the file is intact, and that no frame has rows without their task."""
    if not path.exists():
        return
    with closing(sqlite3.connect(path)) as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        query = "SELECT name FROM sqlite_master WHERE type = 'table'"
        tables = {name for (name,) in database.execute(query)}
        for table, stage in WRITTEN_BY.items():
            if table in tables:
                query = (
                    f"SELECT count(*) FROM {table} AS r WHERE NOT EXISTS (SELECT 1 FROM task AS t "
                    f"WHERE t.stage = '{stage}' AND t.frame_id = r.frame_id)"
                )
                assert database.execute(query).fetchone() == (0,), table


@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_loses_and_doubles_nothing(
    home: Path, tmp_path: Path, forks: CommandForks, name: str
) -> None:
    """One kill at a random time, then everything to its end."""
    generator = np.random.default_rng(abs(hash(str(tmp_path))))
    case = Case(home, tmp_path / "case", name, forks, generator)
    assert case.kill_and_resume(kills=1) == case.expected


@pytest.mark.slow
def test_a_hundred_kills_lose_and_double_nothing(
    home: Path, tmp_path: Path, forks: CommandForks
) -> None:
    """At random times of every command, several times before it may finish."""
    generator = np.random.default_rng(0)
    cases: dict[str, Case] = {}
    for name in cycle(COMMANDS):
        if name not in cases:
            cases[name] = Case(home, tmp_path / name, name, forks, generator)
        found = cases[name].kill_and_resume(kills=int(generator.integers(6, 12)))
        assert found == cases[name].expected, name
        total = {name: case.met for name, case in cases.items()}
        print(sum(total.values()), total, flush=True)  # noqa: T201
        if sum(total.values()) >= KILLS and len(cases) == len(COMMANDS):
            break
