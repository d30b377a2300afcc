"""The contract of every trainable detector: training, resuming, saving, loading, detecting."""

import inspect
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from contracts.samples import assert_one_line, assert_same
from support.killed import Killed, kill_at
from support.paths import ROOT
from support.trainable_toy import GridDetector, GridStudent

from curate.datasets.kitti.dataset import KittiDataset
from curate.detections import CATEGORIES
from curate.errors import ConfigError, ModelError
from curate.training.settings import TrainingReport, TrainingSettings
from curate.training.snapshot import snapshot_path
from curate.training.trainer import train
from pipelines.registry import DETECTORS, trainable, trainable_names

TOY = "support.trainable_toy:GridDetector"


@pytest.fixture(params=[*trainable_names(), TOY])
def detector(request: pytest.FixtureRequest, tiny: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the class of every trainable detector; pillars uses its smallest preset."""
    found = trainable(request.param)
    assert found is not None
    if tiny in found.presets:
        monkeypatch.setattr(found, "presets", (tiny,))
    return found


def trained(detector: Any, labels: Path, output: Path, **more: Any) -> TrainingReport:
    """Train for a few steps."""
    options = {name: more.pop(name) for name in ("start", "progress") if name in more}
    settings = TrainingSettings(**{"steps": 5, "snapshot_seconds": 0.0, "pasted": 1} | more)
    return train(detector, labels, output, settings, **options)


def files(folder: Path) -> dict[str, bytes]:
    """Return the contents of a folder."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_a_training_in_mixed_precision_begins_like_one_in_full(
    detector: Any, make_labels: Callable[..., Path], tmp_path: Path
) -> None:
    """The loss of the first step, from the same weights."""
    labels, output = make_labels(labeled=2), tmp_path / f"a{detector.checkpoint_suffix}"
    options = {"steps": 1, "statistics_steps": 1}
    full, mixed = (
        trained(detector, labels, output, precision=precision, **options).loss
        for precision in ("float32", "bfloat16")
    )
    assert mixed == pytest.approx(full, rel=0.01)


@pytest.mark.parametrize("teacher", ["student", "ema"])
def test_a_resumed_training_ends_with_the_same_files(
    detector: Any, make_labels: Callable[..., Path], tmp_path: Path, teacher: str
) -> None:
    """Also with dropout: random draws depend only on the seed and the step."""
    labels = make_labels(labeled=3, unlabeled=2)
    whole, killed = (tmp_path / name / f"a{detector.checkpoint_suffix}" for name in ("w", "k"))
    report = trained(detector, labels, whole, teacher=teacher, statistics_steps=2)
    with pytest.raises(Killed):
        trained(detector, labels, killed, teacher=teacher, statistics_steps=2, progress=kill_at(3))
    assert snapshot_path(killed).exists()
    before = torch.random.get_rng_state()
    torch.manual_seed(4711)
    resumed = trained(detector, labels, killed, teacher=teacher, statistics_steps=2)
    torch.random.set_rng_state(before)
    assert resumed.resumed_at == 2
    assert files(killed.parent) == files(whole.parent)
    assert resumed.statistics == report.statistics
    assert [each.step for each in report.statistics if each.name == "loss"] == [2, 4, 5]
    assert {"learning_rate", "gradient_norm"} < {each.name for each in report.statistics}


def test_a_checkpoint_loads_detects_and_saves(
    detector: Any, make_labels: Callable[..., Path], toy_kitti: Path, tmp_path: Path
) -> None:
    """The saved bytes and the boxes are the same as before."""
    first, second = (tmp_path / name / f"a{detector.checkpoint_suffix}" for name in ("1", "2"))
    trained(detector, make_labels(labeled=2), first, steps=80, learning_rate=2e-2)
    detector.check_checkpoint(first)
    student = detector.load_student(first)
    assert (student.preset, student.categories) == (next(iter(detector.presets)), CATEGORIES)
    student.save(second, student.network.state_dict())
    assert files(first.parent) == files(second.parent)
    frame = KittiDataset(toy_kitti).read("000000")
    found = detector(first, minimum_score=0.05).predict(frame)
    assert len(found) > 0
    assert_same(found, detector(second, minimum_score=0.05).predict(frame))


def test_the_weight_of_an_object_scales_its_loss(
    detector: Any, make_labels: Callable[..., Path], tmp_path: Path
) -> None:
    """Weight 0 is an ignore region: labels of weight 0 and 1 give different losses."""
    losses = []
    for weight in (0.0, 0.5, 1.0):
        labels = make_labels(labeled=1, unlabeled=2, weight=weight, name=f"{weight}.sqlite")
        output = tmp_path / f"{weight}{detector.checkpoint_suffix}"
        losses.append(trained(detector, labels, output, steps=1, pasted=0).loss)
    assert len(set(losses)) == 3


def test_an_invalid_start_checkpoint_is_rejected(
    detector: Any, make_labels: Callable[..., Path], tmp_path: Path
) -> None:
    """A checkpoint of another detector, a random file and a missing one give one line each."""
    labels, wrong = make_labels(labeled=2), tmp_path / "wrong.bin"
    others = [trainable(name) for name in (*trainable_names(), TOY)]
    contents = [b"rubbish", None]
    for other in others:
        if other is not None and other is not detector:
            path = tmp_path / f"other{other.checkpoint_suffix}"
            trained(other, labels, path, steps=1)
            contents.append(path.read_bytes())
    assert len(contents) > 2
    for content in contents:
        wrong.unlink(missing_ok=True)
        if content is not None:
            wrong.write_bytes(content)
        for use in (
            lambda: detector.check_checkpoint(wrong),
            lambda: trained(detector, labels, tmp_path / "out", start=wrong),
        ):
            with pytest.raises(ModelError, match=r"wrong\.bin") as caught:
                use()
            assert_one_line(caught.value)


def test_presets_suffix_and_version_follow_the_protocol(detector: Any) -> None:
    """There is at least one preset, the suffix begins with a dot, and there is a version."""
    assert list(detector.presets)
    assert detector.checkpoint_suffix.startswith(".")
    assert detector.checkpoint_version
    assert "preset" not in inspect.signature(detector).parameters


@pytest.mark.parametrize(
    "member", ["presets", "checkpoint_suffix", "checkpoint_version", "check_checkpoint",
               "new_student", "load_student"],
)  # fmt: skip
def test_an_incomplete_trainable_class_is_rejected(
    member: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error contains the missing member. A class with none of them is a plain detector."""
    monkeypatch.delattr(GridDetector, member)
    with pytest.raises(ConfigError, match=f"^detector '{TOY}' .* has no {member}; see") as caught:
        trainable(TOY)
    assert_one_line(caught.value)
    assert trainable("support.toys:ToyDetector") is None


@pytest.mark.parametrize("member", ["encode", "loss", "save"])
def test_an_incomplete_student_is_rejected(
    member: str,
    make_labels: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before the first step."""
    monkeypatch.delattr(GridStudent, member)
    with pytest.raises(ConfigError, match=f"GridStudent has no {member}; see") as caught:
        trained(GridDetector, make_labels(labeled=2), tmp_path / "out.npz")
    assert_one_line(caught.value)


def curate(*arguments: object, **environment: str) -> subprocess.CompletedProcess:
    """Return a function that runs a command in a new process, which can import the toy."""
    return subprocess.run(
        _line(*arguments), capture_output=True, text=True, check=False, env=_env(environment)
    )


def _line(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "pipelines", *map(str, arguments)]


def _env(more: dict[str, str]) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": f"{ROOT / 'tests'}{os.pathsep}{ROOT}"} | more


def init(root: Path, folder: Path, *more: object) -> subprocess.CompletedProcess:
    """Create a workspace with the toy as its detector."""
    settings = (
        "train.pretrain_steps=30", "train.round_steps=30", "train.options={snapshot_seconds=0.0}",
        "train.statistics_steps=10", "train.learning_rate=0.05", "solve.self_paced=false",
        "run.rounds=2",
    )  # fmt: skip
    flags = [part for setting in settings for part in ("--set", setting)]
    return curate(
        "init", folder, "--root", root, "--labeled", "0.25", "--detector", TOY, *flags, *more
    )


def rows(folder: Path, query: str) -> list[tuple]:
    """Return the rows of a query in the working database."""
    with closing(sqlite3.connect(folder / "curate.db")) as connection:
        return connection.execute(query).fetchall()


def kill_in_training(folder: Path, output: str, *command: object) -> None:
    """Kill a command with SIGKILL as soon as its training has written a snapshot."""
    snapshot = snapshot_path(folder / "checkpoints" / output)
    started = subprocess.Popen(_line(*command, "-w", folder), env=_env({"TOY_DELAY_S": "0.05"}))
    end = time.monotonic() + 60
    while not snapshot.exists() and started.poll() is None and time.monotonic() < end:
        time.sleep(0.01)
    started.send_signal(signal.SIGKILL)
    assert started.wait() == -signal.SIGKILL
    assert snapshot.exists()


STATISTICS = "SELECT * FROM training_statistics ORDER BY 1, 2, 3, 4"


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL here")
def test_an_external_detector_works_with_the_whole_command_line(
    toy_kitti: Path, tmp_path: Path
) -> None:
    """Killed in pretrain and in a round, the run ends like an undisturbed one.

    Then its checkpoint is used in another workspace, and one of another detector is rejected.
    """
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        made = init(toy_kitti, folder)
        assert made.returncode == 0, made.stderr
    ran = curate("run", "-w", whole)
    assert ran.returncode == 0, ran.stderr
    kill_in_training(killed, "round-00.npz", "pretrain")
    assert curate("pretrain", "-w", killed).returncode == 0
    kill_in_training(killed, "round-01-pspsl.npz", "run")
    ran = curate("run", "-w", killed)
    assert ran.returncode == 0, ran.stderr
    names = ["round-00.npz", "round-01-pspsl.npz", "round-02-pspsl.npz"]
    assert list(files(whole / "checkpoints")) == names
    assert files(killed / "checkpoints") == files(whole / "checkpoints")
    curves = rows(whole, STATISTICS)
    assert rows(killed, STATISTICS) == curves
    assert {row[:3] for row in curves} == {
        (number, policy, step)
        for number, policy in ((0, ""), (1, "pspsl"), (2, "pspsl"))
        for step in (10, 20, 30)
    }
    assert {row[3] for row in curves} == {
        "loss", "objects", "background", "learning_rate", "gradient_norm",
    }  # fmt: skip
    shown = curate("query", "--named", "training", "-w", whole)
    assert shown.returncode == 0
    assert "gradient_norm" in shown.stdout
    external = tmp_path / "brought"
    made = init(toy_kitti, external, "--detector-path", whole / "checkpoints" / names[0])
    assert made.returncode == 0, made.stderr
    assert curate("pretrain", "-w", external).returncode == ConfigError.exit_code
    ran = curate("run", "--rounds", "1", "-w", external)
    assert ran.returncode == 0, ran.stderr
    foreign = whole / "curate.toml"
    foreign.write_text(foreign.read_text().replace(TOY, "pillars"))
    ran = curate("predict", "-w", whole)
    assert ran.returncode != 0
    assert ran.stderr.count("\n") == 1
    assert f"detector '{TOY}'" in ran.stderr
    assert "'pillars'" in ran.stderr
    assert names[1] in ran.stderr
    wrong = tmp_path / "wrong"
    made = curate("init", wrong, "--root", toy_kitti, "--detector-path", external / "curate.toml")
    assert made.returncode == 0, made.stderr
    ran = curate("predict", "-w", wrong)
    assert ran.returncode == ModelError.exit_code
    assert ran.stderr.count("\n") == 1
    assert "curate.toml: not a readable safetensors file" in ran.stderr


def test_an_unknown_preset_is_rejected_before_any_work(toy_kitti: Path, tmp_path: Path) -> None:
    """The one-line error lists the presets of the configured detector."""
    made = init(toy_kitti, tmp_path / "work", "--set", "train.preset=huge")
    assert made.returncode == ConfigError.exit_code
    assert made.stderr.count("\n") == 1
    assert "'huge'; choose one of coarse, coarser" in made.stderr
    assert not (tmp_path / "work" / "curate.toml").exists()
    ran = init(toy_kitti, tmp_path / "work")
    assert ran.returncode == 0, ran.stderr
    path = tmp_path / "work" / "curate.toml"
    path.write_text(path.read_text().replace('preset = "auto"', 'preset = "huge"'))
    for command in ("pretrain", "run", "predict", "status"):
        ran = curate(command, "-w", tmp_path / "work")
        assert ran.returncode == ConfigError.exit_code, command
        assert "'huge'; choose one of coarse, coarser" in ran.stderr
    assert rows(tmp_path / "work", "SELECT count(*) FROM task") == [(0,)]


def test_a_registered_detector_without_training_is_not_trained() -> None:
    assert trainable_names() == ["pillars", "openpcdet"]
    assert set(trainable_names()) < set(DETECTORS.classes)
    assert np.all([trainable(name) is None for name in ("onnx", "recorded")])
