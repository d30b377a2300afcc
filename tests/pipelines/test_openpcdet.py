"""A checkpoint of OpenPCDet in a workspace: predictions, fine-tuning, and what is refused."""

import json
import pickle
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from support.openpcdet_files import document, random_network, write_files
from support.pipelines_cli import Curate

from curate.detectors.openpcdet.checkpoint import save_checkpoint
from curate.errors import ConfigError, FramesFailed, ModelError
from pipelines.assembly import describe_score, score_meaning
from pipelines.workspace.config import make_config

# Points have a height of -1.73 m in the toy frames too, so there is nothing to warn of.
SETTINGS = ("--set", "detector.minimum_score=0.5", "--set", "solve.self_paced=false")


def begin(curate: Curate, work: Path, root: Path, *options: object) -> tuple[int, str, str]:
    """Create a workspace."""
    return curate("init", work, "--root", root, "--labeled", "0.25", *SETTINGS,
                  "--detector", "openpcdet", *options)  # fmt: skip


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Return a checkpoint and its model file, which has another name."""
    path = write_files(tmp_path)
    return path, path.with_suffix(".yaml").rename(tmp_path / "voxel_rcnn.yaml")


def test_two_rounds_with_a_fine_tuned_checkpoint(
    curate: Curate, tmp_path: Path, toy_kitti: Path, files: tuple[Path, Path]
) -> None:
    """The second round's teacher is the first one's student, which has the model file in it."""
    work, (checkpoint, config) = tmp_path / "work", files
    code, _, err = begin(
        curate, work, toy_kitti, "--detector-path", checkpoint, "--detector-config", config,
        "--set", "train.round_steps=2", "--set", "run.rounds=2",
    )  # fmt: skip
    assert code == 0, err
    assert f'config = "{config}"' in (work / "curate.toml").read_text()
    code, _, err = curate("run", "--allow-empty", "-w", work)
    assert code == 0, err
    students = sorted(path.name for path in (work / "checkpoints").iterdir())
    assert students == ["round-01-pspsl.pth", "round-02-pspsl.pth"]
    state = torch.load(work / "checkpoints" / students[1], weights_only=True)
    assert {"model_state", "config"} < state.keys()
    assert json.loads(state["config"])["CLASS_NAMES"] == document()["CLASS_NAMES"]
    rows = json.loads(
        curate("query", "SELECT DISTINCT round FROM prediction", "--json", "-w", work)[1]
    )
    assert [row["round"] for row in rows] == [1, 2]


def test_two_rounds_from_a_preset(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    """Pretrain, predict, repredict, score, solve, export and train; twice, without a checkpoint."""
    work = tmp_path / "work"
    code, _, err = curate(
        "init", work, "--root", toy_kitti, "--labeled", "0.25", "--detector", "voxel-rcnn-small",
        "--set", "detector.minimum_score=0.1", "--set", "solve.self_paced=false",
        "--set", "train.pretrain_steps=2", "--set", "train.round_steps=2", "--set", "run.rounds=2",
    )  # fmt: skip
    assert code == 0, err
    code, _, err = curate("run", "--allow-empty", "-w", work)
    assert code == 0, err
    checkpoints = sorted(path.name for path in (work / "checkpoints").iterdir())
    assert checkpoints == ["round-00.pth", "round-01-pspsl.pth", "round-02-pspsl.pth"]
    state = torch.load(work / "checkpoints" / checkpoints[-1], weights_only=True)
    assert json.loads(state["config"])["MODEL"]["ROI_HEAD"]["SCORE"] == "both"


def test_a_changed_model_file_makes_predictions_outdated(
    curate: Curate, tmp_path: Path, toy_kitti: Path, files: tuple[Path, Path]
) -> None:
    work, (checkpoint, config) = tmp_path / "work", files
    begin(curate, work, toy_kitti, "--detector-path", checkpoint, "--detector-config", config)
    assert "6 frames done" in curate("predict", "-w", work)[1]
    assert "6 already done" in curate("predict", "-w", work)[1]
    config.write_text(config.read_text().replace('"NMS_THRESH": 0.1', '"NMS_THRESH": 0.2'))
    assert "6 frames done" in curate("predict", "-w", work)[1]


def test_the_model_file_beside_the_checkpoint_is_found(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """And written into the settings, so that its content counts."""
    path = write_files(tmp_path)
    code, _, err = begin(curate, tmp_path / "work", toy_kitti, "--detector-path", path)
    assert code == 0, err
    assert str(path.with_suffix(".yaml")) in (tmp_path / "work" / "curate.toml").read_text()
    code, _, err = curate("doctor", "-w", tmp_path / "work")
    assert "openpcdet" not in err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--detector-config", "missing.yaml"), "--detector-config missing.yaml: no such file"),
        (("--set", "train.preset=huge"), "unknown preset 'huge'; choose one of voxel-rcnn-small"),
        (("--set", "detector.options.confg=1"), "has no option 'confg'; did you mean 'config'?"),
    ],
)
def test_wrong_options_are_refused_at_the_start(
    curate: Curate, tmp_path: Path, toy_kitti: Path, options: tuple[str, ...], message: str
) -> None:
    code, _, err = begin(curate, tmp_path / "work", toy_kitti, *options)
    assert code == ConfigError.exit_code
    assert message in err
    assert err.count("\n") == 1
    assert not (tmp_path / "work").exists()


def another_architecture(checkpoint: Path, config: Path) -> None:
    config.write_text(json.dumps(document("SECONDNet")))


def unknown_key(checkpoint: Path, config: Path) -> None:
    config.write_text(config.read_text().replace('"DIR_OFFSET"', '"DIR_OFSET"'))


def fewer_classes(checkpoint: Path, config: Path) -> None:
    config.write_text(json.dumps(document(classes=("Car",))))


def damaged(checkpoint: Path, config: Path) -> None:
    checkpoint.write_bytes(checkpoint.read_bytes()[:5000])


def with_code(checkpoint: Path, config: Path) -> None:
    checkpoint.write_bytes(pickle.dumps({"model_state": Path}))


@pytest.mark.parametrize(
    ("harm", "exit_code", "message"),
    [
        (another_architecture, ModelError.exit_code, "it has also roi_head."),
        (unknown_key, ConfigError.exit_code, "DIR_OFSET; did you mean 'DIR_OFFSET'?"),
        (fewer_classes, ModelError.exit_code, "dense_head follow from CLASS_NAMES"),
        (damaged, ModelError.exit_code, "not a readable checkpoint"),
        (with_code, ModelError.exit_code, "model.pth"),
    ],
)
def test_what_does_not_fit_refuses_the_command_in_one_line(
    curate: Curate, tmp_path: Path, toy_kitti: Path, files, harm, exit_code: int, message: str
) -> None:
    """`predict` says what is wrong before the first frame; none is marked as failed."""
    work, (checkpoint, config) = tmp_path / "work", files
    harm(checkpoint, config)
    begin(curate, work, toy_kitti, "--detector-path", checkpoint, "--detector-config", config)
    code, _, err = curate("predict", "-w", work)
    assert code == exit_code
    assert err.count("\n") == 1
    assert message in err
    rows = json.loads(curate("query", "SELECT count(*) AS n FROM task", "--json", "-w", work)[1])
    assert rows == [{"n": 0}]


def test_a_frame_with_wrong_points_fails_alone(
    curate: Curate, tmp_path: Path, toy_kitti: Path, files: tuple[Path, Path]
) -> None:
    """An empty sweep has no boxes; intensities up to 255 fail their frame."""
    work, (checkpoint, config) = tmp_path / "work", files
    begin(curate, work, toy_kitti, "--detector-path", checkpoint, "--detector-config", config)
    query = "SELECT frame FROM frame WHERE split = 'unlabeled' ORDER BY 1"
    rows = json.loads(curate("query", query, "--json", "-w", work)[1])
    empty, bright = (toy_kitti / f"training/velodyne/{row['frame']}.bin" for row in rows[:2])
    points = np.fromfile(bright, dtype=np.float32).reshape(-1, 4)
    points[:, 3] *= 255
    points.tofile(bright)
    empty.write_bytes(b"")
    code, out, err = curate("predict", "-w", work)
    assert code == FramesFailed.exit_code
    assert "4 frames done" in out or "5 frames done" in out
    failed = curate("status", "-w", work, "--failed")[1]
    assert rows[1]["frame"] in failed
    assert rows[0]["frame"] not in failed
    assert err.count("error:") == 1


@pytest.mark.parametrize(
    ("name", "settings", "meaning"),
    [
        ("pillars", {}, "the probability that an object of the category has its centre there"),
        ("openpcdet", {"preset": "second-small"}, "the probability of the category"),
        ("openpcdet", {"preset": "voxel-rcnn-small"}, "0 up to an IoU of 0.25, 1 from 0.75"),
        ("openpcdet", {"config": "SECONDNet"}, "the probability of the category"),
        ("openpcdet", {"config": "VoxelRCNN"}, "the 3D IoU of the box with the object ("),
        ("openpcdet", {"stored": True}, "the 3D IoU of the box with the object"),
        ("openpcdet", {"path": "gone.pth"}, None),
        ("onnx", {"path": "model.onnx"}, None),
        ("onnx", {"path": "model.onnx", "score_meaning": "a rank"}, "a rank"),
    ],
)
def test_every_detector_says_what_its_score_estimates(
    tmp_path: Path, name: str, settings: dict, meaning: str | None
) -> None:
    """From its preset, model file or checkpoint; unknown where nobody says it."""
    detector = {"name": name, "score_meaning": settings.get("score_meaning")}
    if "path" in settings:
        detector["path"] = tmp_path / settings["path"]
    if "config" in settings:
        detector["path"] = write_files(tmp_path, settings["config"])
        detector["options"] = {"config": str(tmp_path / "model.yaml")}
    if "stored" in settings:
        network, detector["path"] = random_network(), tmp_path / "own.pth"
        save_checkpoint(detector["path"], network, network.state_dict(), "")
    train = {"preset": settings.get("preset", "auto")}
    config = make_config(
        {"dataset": {"root": tmp_path}, "detector": detector, "train": train}, "test"
    )
    found = score_meaning(config)
    assert found == meaning if meaning is None else meaning in str(found)
    assert describe_score(found).startswith("estimates " if meaning else "has no known meaning")


def test_a_model_is_exported_to_onnx(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    """The newest checkpoint by default; the printed line uses it, and others say why not."""
    work = tmp_path / "a work"
    begin(curate, work, toy_kitti, "--detector-path", write_files(tmp_path, "PointPillar"))
    code, out, err = curate("export-model", "-w", work)
    assert code == 0, err
    model = work / "exports" / "model.onnx"
    assert f"{model}, from {tmp_path / 'model.pth'}\n" in out
    flags = shlex.split(re.search(r"in curate: (--detector.*)", out)[1])
    other = tmp_path / "other"
    code, _, err = curate("init", other, "--root", toy_kitti, "--labeled", "0.25", *flags)
    assert code == 0, err
    assert "6 frames done" in curate("predict", "-w", other)[1]
    code, _, err = curate("export-model", "-w", other)
    assert (code, err) == (
        ConfigError.exit_code, "error: detector 'onnx' has no network that curate can export\n"
    )  # fmt: skip
    sparse = write_files(tmp_path, "SECONDNet")
    code, _, err = curate("export-model", "--checkpoint", sparse, "-w", work)
    assert code == ConfigError.exit_code
    assert err.startswith("error: SECONDNet cannot be exported: ONNX has no sparse convolution")
