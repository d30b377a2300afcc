"""Two rounds with a detector and a trainer in an environment of their own, without curate in it.

Once by hand: augment, run the detector on the folders, read its results, train, and the same again.
Once with a command for each, and nobody between the rounds. Both give the same rows.
"""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
import venv
from pathlib import Path

import pytest
from support.external_detector import command_of, write_script
from support.paths import ROOT
from support.pipelines_cli import Curate
from support.toys import write_toy_kitti

TRAINER = """
import sqlite3, sys
labels, output = sys.argv[1:3]
query = "SELECT count(*), sum(weight > 0) FROM weighted_labels"
print(sqlite3.connect(labels).execute(query).fetchone())
open(output, "w").write("student")
"""
TABLES = {
    "prediction": "category, score, x, y, z, length, width, height, yaw",
    "reprediction": "view, category, score, x, y, z, length, width, height, yaw",
    "reprediction_view": "view, flip_y, rotation_rad, scale",
    "consistency": "k, loss, matched_views",
    "weight": "k, v",
}


@pytest.fixture
def python(tmp_path: Path) -> Path:
    """Return the Python of a fresh virtual environment, which has no packages at all."""
    venv.create(tmp_path / "venv", with_pip=False)
    found = tmp_path / "venv" / "bin" / "python"
    code = "import importlib.util as u; print([u.find_spec(x) for x in ('curate', 'numpy')])"
    said = subprocess.run([found, "-I", "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout == "[None, None]\n"
    return found


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Return 20 small frames."""
    write_toy_kitti(tmp_path / "kitti", 20)
    return tmp_path / "kitti"


@pytest.fixture
def trainer(tmp_path: Path) -> Path:
    """Return the script of the trainer."""
    path = tmp_path / "train.py"
    path.write_text(TRAINER)
    return path


def init(curate: Curate, folder: Path, data: Path, *settings: str) -> Path:
    """Create a workspace with sixteen unlabeled frames and the given settings."""
    options = [
        "--root", data, "--labeled", "0.2", "--split-by", "frame",
        "--set", 'run.priors=["points"]', "--set", "detector.camera_view=false",
        "--set", "run.rounds=2",
    ]  # fmt: skip
    code, _, err = curate("init", folder, *options, *settings)
    assert code == 0, err
    return folder


def run(curate: Curate, *arguments: object) -> str:
    """Return what a command printed, which must succeed."""
    code, out, err = curate(*arguments)
    assert code == 0, err
    return out


def rows(curate: Curate, work: Path, table: str) -> list[dict]:
    """Return the rows of both rounds."""
    columns = TABLES[table]
    sql = (
        f"SELECT round, frame, {columns} FROM {table} JOIN frame ON frame.id = frame_id "
        f"ORDER BY round, frame, {columns}"
    )
    return json.loads(run(curate, "query", sql, "--json", "--limit", "9999", "-w", work))


def test_two_rounds_by_hand_and_by_commands_are_the_same(
    curate: Curate, tmp_path: Path, python: Path, data: Path, trainer: Path
) -> None:
    """Labels have weights above 0, and the student of round 1 predicts in round 2."""
    script = write_script(tmp_path)
    hands = by_hand(curate, tmp_path, python, data, script, trainer)
    commands = init(
        curate, tmp_path / "commands", data,
        "--detector", "command",
        "--set", f"detector.options.command={command_of(script, '{teacher}', python=str(python))}",
        "--detector-path", str(initial(tmp_path)),
        "--set", f"train.command={shlex.join([str(python), str(trainer)])} {{labels}} {{output}}",
    )  # fmt: skip
    assert "repredict" in run(curate, "run", "--dry-run", "-w", commands)
    out = run(curate, "run", "-w", commands)
    assert out.count("by your trainer") == 2
    assert list((commands / "batches").iterdir()) == []
    for table in TABLES:
        found = rows(curate, commands, table)
        assert {row["round"] for row in found} == {1, 2}
        assert found == rows(curate, hands, table), table
    predictions = rows(curate, commands, "prediction")
    scores = [[row["score"] for row in predictions if row["round"] == e] for e in (1, 2)]
    assert scores[1] == pytest.approx([0.9 * score for score in scores[0]])
    assert sum(row["v"] > 0 for row in rows(curate, commands, "weight")) > 40
    logs = sorted((commands / "logs").iterdir())
    run(curate, "run", "-w", commands)
    assert sorted((commands / "logs").iterdir()) == logs  # nothing is left to do


def initial(tmp_path: Path) -> Path:
    """Return the first checkpoint."""
    path = tmp_path / "initial.pt"
    path.write_text("initial")
    return path


def by_hand(
    curate: Curate, tmp_path: Path, python: Path, data: Path, script: Path, trainer: Path
) -> Path:
    """Return a workspace after two rounds, in which a person ran the detector every time."""

    def detect(root: Path, teacher: Path, result: Path) -> None:
        clouds = root / "training" / "velodyne"
        command = [python, "-I", "-S", script, clouds, tmp_path, teacher]
        subprocess.run(command, check=True, capture_output=True)
        (tmp_path / "found.csv").rename(result)

    student = tmp_path / "student.pt"
    predictions = tmp_path / "predictions.csv"
    # The result of a training is what the trained detector finds in the frames.
    train = tmp_path / "train.sh"
    infer = [python, "-I", "-S", script, data / "training" / "velodyne", tmp_path, student]
    train.write_text(
        f'"{python}" "{trainer}" "$1" "{student}" && {shlex.join(map(str, infer))} '
        f'&& mv "{tmp_path}/found.csv" "$2"\n'
    )
    detect(data, initial(tmp_path), predictions)
    work = init(
        curate, tmp_path / "hands", data,
        "--detector", "recorded", "--detector-path", str(predictions),
        "--set", "detector.augmented=copies-{round}",
    )  # fmt: skip
    for number, teacher in ((1, initial(tmp_path)), (2, student)):
        copies = work / f"copies-{number}"
        run(curate, "augment", copies, "--round", number, "-w", work)
        detect(copies / "view-1", teacher, copies / "view-1" / "result.csv")
        for command in ("predict", "repredict", "score", "solve", "export"):
            run(curate, command, "-w", work)
        if number == 1:
            run(curate, "train-round", "--command", f"sh {train} {{labels}} {{output}}", "-w", work)
    return work


@pytest.mark.slow
def test_a_killed_run_resumes_and_leaves_nothing(
    curate: Curate, tmp_path: Path, python: Path, data: Path
) -> None:
    """SIGKILL at ten moments; no command survives, and the rows are those of a quiet run."""
    script = write_script(tmp_path)
    command = command_of(script, python=str(python))
    settings = ("--detector", "command", "--set", f"detector.options.command={command}")
    works = [init(curate, tmp_path / name, data, *settings) for name in ("quiet", "killed")]
    for work in works:
        path = work / "curate.toml"
        path.write_text(path.read_text().replace('batch_size = "auto"', "batch_size = 3"))
    run(curate, "run", "-w", works[0])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    for number in range(10):
        process = subprocess.Popen(
            [sys.executable, "-m", "curate", "run", "-w", works[1]],
            env=environment, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        time.sleep(1.5 + 0.35 * number)
        process.send_signal(signal.SIGKILL)
        process.wait()
    run(curate, "run", "-w", works[1])
    for table in TABLES:
        assert rows(curate, works[1], table) == rows(curate, works[0], table)
    assert list((works[1] / "batches").iterdir()) == []
