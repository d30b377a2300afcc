"""The tables of the commands in pseudo-terminals of 60, 80 and 120 columns."""

import os
import re
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from support.pipelines_cli import in_process
from support.rounds import run_stage
from support.terminals import TALL, Terminal, open_terminal, terminal
from support.toys import toy_document, write_toy_kitti

from pipelines.cli import main
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise

WIDE = 2000
COMMANDS = (
    ("audit", "--replicates", "20", "--round", "1"),
    ("query", "SELECT * FROM weighted_labels WHERE round = 1"),
    ("query", "SELECT frame, k, score, weight, points_threshold FROM weighted_labels"),
    ("query", "--named", "reliability"),
    ("query", "--list"),
    ("query", "--schema"),
    ("status",),
    ("diff", "1", "2"),
    ("evaluate", "--round", "1"),
    ("explain", "000003", "0"),
    ("doctor",),
    ("check",),
    ("graph",),
    ("review", "list"),
)
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.])")
_SECONDS = re.compile(r"\(\d+\.\d s\)")
# A path that is longer than a line has to break, anywhere; how long it is depends on the machine.
_PICTURE = re.compile(r"^picture:.*\Z", re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a workspace with two weighted rounds, predicted val frames, an audit and a review."""
    root = tmp_path_factory.mktemp("tables")
    write_toy_kitti(root / "kitti", frames=12, val=4)
    weights = root / "detector.txt"
    weights.write_text("")
    config = make_config(toy_document(root / "kitti", weights), "test")
    opened = initialise(root / "work", config, "0.25", "")
    for number in (1, 2):
        for stage in ("predict", "repredict", "points", "semantic", "solve"):
            run_stage(opened, stage, number)
    with closing(sqlite3.connect(opened.root / "curate.db")) as connection:
        connection.execute("UPDATE weight SET v = v / 3 WHERE round = 2")
        connection.commit()
    with pytest.MonkeyPatch.context() as monkeypatch:
        run(monkeypatch, WIDE, ("audit", "--replicates", "20", "--round", "1"), opened.root)
        given = ("review", "export", str(root / "review"), "--count", "3", "--round", "1")
        run(monkeypatch, WIDE, given, opened.root)
    return opened.root


def run(
    monkeypatch: pytest.MonkeyPatch, width: int, arguments: tuple[str, ...], root: Path
) -> Terminal:
    """Return what a command prints in a terminal of this width."""
    given = ["curate", *arguments] + ([] if arguments == ("graph",) else ["-w", str(root)])
    with terminal(monkeypatch, width) as screen:
        monkeypatch.setattr(sys, "argv", given)
        try:
            main()
        except SystemExit as end:
            assert end.code in (0, None), arguments  # noqa: PT017
    return screen


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_nothing_is_truncated(
    monkeypatch: pytest.MonkeyPatch, workspace: Path, arguments: tuple[str, ...], width: int
) -> None:
    """Every number and frame id of the widest terminal is complete in a narrow one."""
    whole = _PICTURE.sub("", _SECONDS.sub("", run(monkeypatch, WIDE, arguments, workspace).text))
    screen = run(monkeypatch, width, arguments, workspace)
    assert [line for line in screen.lines if len(line) > width] == []
    assert "…" not in screen.text
    assert "..." not in screen.text.replace("x2, ...)", "")
    shown = _PICTURE.sub("", _SECONDS.sub("", re.sub(r"(?m)^row \d+ ─.*$", "", screen.text)))
    assert whole.strip()
    assert sorted(_NUMBER.findall(shown)) == sorted(_NUMBER.findall(whole))


@pytest.mark.parametrize("width", [60, 80])
def test_a_dry_run_wraps_at_spaces(
    monkeypatch: pytest.MonkeyPatch, workspace: Path, width: int
) -> None:
    """The reasons of a stage continue on an indented line."""
    arguments = ("predict", "--round", "3", "--dry-run")
    wide = run(monkeypatch, WIDE, arguments, workspace)
    narrow = run(monkeypatch, width, arguments, workspace)
    assert "frames (" in wide.text
    assert max(map(len, narrow.lines)) <= width < max(map(len, wide.lines))
    assert narrow.text.split() == wide.text.split()
    assert any(line.startswith("    ") for line in narrow.lines)


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_process_in_a_terminal(workspace: Path, width: int) -> None:
    """With NO_COLOR and a terminal that reports its size, not COLUMNS."""
    sql = "SELECT * FROM weighted_labels WHERE frame = '000003' AND round = 1"
    environment = {
        name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")
    }
    command = [sys.executable, "-m", "curate_command", "query", sql, "-w", str(workspace)]
    with open_terminal(width, TALL) as (screen, slave):
        subprocess.run(
            command, stdin=slave, stdout=slave, env={**environment, "NO_COLOR": "1"}, check=True
        )
    assert max(map(len, screen.lines)) <= width
    assert screen.text.count("000003") == 3
    assert "\x1b" not in screen.text


def test_a_warning_stands_in_its_own_line_above_the_progress_bar() -> None:
    """It does not follow a bar on the same line, where it is easily missed."""
    script = (
        "import logging; from pipelines.cli import log_warnings\n"
        "from pipelines.engine.progress import Bar\n"
        "log_warnings()\n"
        "with Bar().track('predict', 2) as advance:\n"
        "    logging.getLogger('x').warning('no Van')\n"
        "    advance(1, '')\n"
    )
    with open_terminal(80, TALL) as (screen, slave):
        subprocess.run(
            [sys.executable, "-c", script], stdin=slave, stdout=slave, stderr=slave,
            env={**os.environ, "TERM": "xterm"}, check=True,
        )  # fmt: skip
    line = next(line for line in screen.lines if "WARNING: no Van" in line)
    assert line.split("\x1b[2K")[-1].strip() == "WARNING: no Van"


def test_a_pipe_gets_the_same_text_at_any_width(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, workspace: Path
) -> None:
    """Each row is one line there."""
    curate = in_process(monkeypatch, capsys)
    texts = set()
    for columns in ("40", "80", "300"):
        monkeypatch.setenv("COLUMNS", columns)
        texts.add(curate("query", "SELECT * FROM weighted_labels", "-w", workspace)[1])
    [text] = texts
    rows = [line for line in text.splitlines() if re.search(r"\b00000\d\b", line)]
    assert len(rows) == 36
    assert all(len(line) > 200 for line in rows)
