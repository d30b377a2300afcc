"""The commands of the README and of the quick start, run as they are written there."""

import os
import re
import shlex
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from support.paths import ROOT

from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.labels import from_detections, write_objects
from curate.detectors.recorded import RecordedDetector

README = ROOT / "README.md"
DOCS = ROOT / "docs"
PAGES = sorted([README, *DOCS.rglob("*.md")])


def commands(page: Path, under: str) -> list[list[str]]:
    """Return the command lines of the shell block under a heading, one list of words each."""
    block = re.search(
        rf"^## {under}\n.*?```sh\n(.*?)```", page.read_text(), re.DOTALL | re.MULTILINE
    )
    assert block, f"{page} has no shell block under '{under}'"
    return lines_of(block[1])


def lines_of(block: str) -> list[list[str]]:
    """Return the command lines of a shell block."""
    text = block.replace("\\\n", " ").replace(" && ", "\n")
    lines = [re.sub(r"\s+#.*", "", line).strip() for line in text.splitlines()]
    return [shlex.split(line) for line in lines if line]


def run_all(lines: list[list[str]], folder: Path, replace: dict[str, str], edit=None) -> str:
    """Run command lines one after the other as a shell would; return their output."""
    printed = []
    for line in lines:
        words = [replace.get(word, word) for word in line]
        if words[0] == "source":
            continue
        if words[0] == "cd":
            folder = folder / words[1]
            continue
        assert words[0] == "curate", line
        ended = subprocess.run(
            [sys.executable, "-m", "pipelines", *words[1:]],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert ended.returncode == 0, f"{shlex.join(line)}\n{ended.stderr}"
        printed.append(ended.stdout)
        if words[1] == "init" and edit:
            edit(folder / words[2] / "curate.toml")
    return "\n".join(printed)


def short_training(path: Path) -> None:
    """Limit trainings to a few steps: the commands are tested here, not the detector."""
    text = path.read_text()
    for name in ("pretrain_steps", "round_steps"):
        text, found = re.subn(rf"{name} = \d+", f"{name} = 60", text)
        assert found == 1
    path.write_text(text.replace('executor = "serial"', 'executor = "process"'))


def test_the_commands_on_user_data(tmp_path: Path) -> None:
    """From nothing to the explained weight of one label."""
    lines = commands(DOCS / "quick-start.md", "The steps of the demo, one by one")
    explain = [line for line in lines if line[1] == "explain"]
    printed = run_all(
        [line for line in lines if line not in explain], tmp_path, {"80": "24"}, short_training
    )
    assert "round 2  train-round" in printed
    assert "weight" in printed
    sql = "SELECT frame, k FROM weighted_labels ORDER BY round DESC LIMIT 1"
    work = tmp_path / "work"
    found = run_all([["curate", "query", sql, "--csv"]], work, {}).split()[1].split(",")
    replace = dict(zip(explain[0][2:], found, strict=True))
    assert "recomputed" in run_all(explain, work, replace)


@pytest.mark.kitti
def test_the_commands_with_a_user_detector(tmp_path: Path, kitti_root: Path) -> None:
    """From a real detector's KITTI result files to weights, a plot and a report."""
    frames, results = tmp_path / "few", tmp_path / "results"
    for folder in ("velodyne", "image_2", "calib", "label_2"):
        (frames / folder).mkdir(parents=True)
        for path in sorted((kitti_root / "training" / folder).iterdir())[:4]:
            shutil.copy(path, frames / folder)
    write_results(results, frames, kitti_root / "recorded" / "pointgnn_T0.csv")
    replace = {
        "KITTI/training": str(frames),
        "results": str(results),
        "deeplab.onnx": str(kitti_root / "segmenter" / "deeplabv3_mnv2_pascal_quant.onnx"),
    }
    printed = run_all(commands(README, "Bring your own"), tmp_path, replace)
    assert "labels in exports/round-01-pspsl.sqlite" in printed
    assert "wrong " not in printed
    with closing(sqlite3.connect(tmp_path / "work2" / "exports" / "labels.sqlite")) as file:
        sql = "SELECT frame, weight FROM weighted_labels"
        weights = file.execute(sql).fetchall()
    written = [line for path in results.iterdir() for line in path.read_text().splitlines()]
    labeled = {path.stem for path in results.iterdir()} - {frame for frame, _ in weights}
    assert len(labeled) == 1
    own = (results / f"{labeled.pop()}.txt").read_text().splitlines()
    assert len(weights) == len(written) - len(own)
    assert any(weight > 0 for _, weight in weights)
    image = re.search(r"^picture: (.*)$", printed, re.MULTILINE)
    report = re.search(r"^report: (.*)$", printed, re.MULTILINE)
    assert image is not None
    assert report is not None
    assert Path(image[1]).read_bytes().startswith(b"\x89PNG")
    assert "<svg" in Path(report[1]).read_text()


def test_both_pages_bring_the_same() -> None:
    """The README's commands and those of the page about it do not drift apart."""
    page = commands(DOCS / "bring-your-own.md", "The short version")
    assert [line for line in commands(README, "Bring your own") if line[1] != "query"] == page


def test_the_commands_of_evaluation(tmp_path: Path) -> None:
    """Ground truth against itself has an AP of 100, as the FAQ says."""
    labels, results = tmp_path / "data" / "label_2", tmp_path / "out" / "results"
    labels.mkdir(parents=True)
    results.mkdir(parents=True)
    for k in range(40):
        car = f"Car 0.00 0 -1.58 587.01 156.40 664.28 232.95 1.7 1.87 4 {k % 5}.2 2 {10 + k}.4 0.1"
        (labels / f"{k:06}.txt").write_text(f"{car}\n")
        (results / f"{k:06}.txt").write_text(f"{car} 1.0\n")
    [line] = commands(DOCS / "faq.md", "Evaluation without CUDA")
    printed = run_all([line], tmp_path, {})
    [car] = re.findall(r"Car +3d +([\d.]+)", printed)
    assert car == "100.00"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_options_exist(page: Path) -> None:
    """Every `curate` line of a shell block uses a command and options that there are."""
    import typer

    from pipelines.cli import app

    root = typer.main.get_command(app)
    for block in re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
        for words in lines_of(block):
            if words[0] != "curate":
                continue
            command, arguments = root, words[1:]
            while hasattr(command, "commands") and arguments[:1] != ["--help"]:
                assert arguments[0] in command.commands, words
                command, arguments = command.commands[arguments[0]], arguments[1:]
            known = {name for option in command.params for name in option.opts} | {"--help"}
            used = {word.partition("=")[0] for word in arguments if re.match(r"--?[a-z]", word)}
            assert used <= known, f"{shlex.join(words)}: {used - known}"


def write_results(folder: Path, root: Path, record: Path) -> None:
    """Write the predictions of a detector as KITTI result files."""
    dataset, detector = KittiDataset(root), RecordedDetector(record)
    folder.mkdir()
    for name in dataset.frame_ids():
        frame = dataset.read(name, points=False)
        found = from_detections(detector.predict(frame), frame.calibration, frame.image_size)
        write_objects(folder / f"{name}.txt", found)
