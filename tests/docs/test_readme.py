"""The README's commands, run as printed."""

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

README = (ROOT / "README.md").read_text()


def commands(under: str) -> list[list[str]]:
    """Return the command lines of the shell block under a heading, one list of words each."""
    block = re.search(rf"## {under}\n.*?```sh\n(.*?)```", README, re.DOTALL)
    assert block, f"README.md has no shell block under '{under}'"
    text = block[1].replace("\\\n", " ").replace(" && ", "\n")
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
    lines = commands("On your data")
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
    printed = run_all(commands("With your detector and your segmenter"), tmp_path, replace)
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


def write_results(folder: Path, root: Path, record: Path) -> None:
    """Write the predictions of a detector as KITTI result files."""
    dataset, detector = KittiDataset(root), RecordedDetector(record)
    folder.mkdir()
    for name in dataset.frame_ids():
        frame = dataset.read(name, points=False)
        found = from_detections(detector.predict(frame), frame.calibration, frame.image_size)
        write_objects(folder / f"{name}.txt", found)
