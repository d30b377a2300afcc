"""Rounds with a detector that runs elsewhere: equal rows, failures, checks before the first row."""

import json
import os
import shlex
import sys
from pathlib import Path

import pytest
from contracts.samples import assert_one_line
from support.external_detector import command_of, write_script
from support.pipelines_cli import Curate
from support.rounds import run_stage, run_workspace
from support.stored_rows import dump, rows
from support.toys import toy_document, write_toy_kitti

from curate.errors import ConfigError, FramesFailed, ModelError, WorkspaceError
from pipelines.round import open_plan
from pipelines.stages import predict, repredict
from pipelines.stages.predict import TRIAL_FRAMES
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a toy data set and the script of the detector."""
    home = tmp_path_factory.mktemp("command")
    write_toy_kitti(home / "kitti", frames=26, val=2)
    write_script(home)
    (home / "segmenter.txt").touch()
    return home


def make(root: Path, home: Path, command: str | None = None, **settings) -> Workspace:
    """Return a workspace with 23 unlabeled frames and a detector that runs elsewhere."""
    document = toy_document(home / "kitti", home / "segmenter.txt")
    command = command or command_of(home / "my detector" / "infer.py")
    document["detector"] = {"name": "command", "options": {"command": command}}
    for name, section in settings.items():
        document[name] = document.get(name, {}) | section
    return initialise(root, make_config(document, "test"), "0.04", "")


KITTI_RESULTS = """
import sys
from pathlib import Path
import numpy as np
from oracles.openpcdet_kitti import Calibration, write_results
from support.toys import INTENSITIES, SIZES
from curate.datasets.kitti.dataset import KittiDataset
from curate.geometry.mounting import rotations_y_of_yaws

data, results, meaning = sys.argv[1:]
dataset = KittiDataset(Path(data))
for name in dataset.frame_ids():
    frame, boxes = dataset.read(name), []
    for category, intensity in INTENSITIES.items():
        seen = frame.points[np.abs(frame.points[:, 3] - intensity) < 0.01, :3]
        x, y = np.linalg.svd(seen[:, :2] - seen[:, :2].mean(axis=0))[2][0]
        boxes.append([*seen.mean(axis=0), *SIZES[category], np.arctan2(y, x)])
    boxes = np.array(boxes)
    boxes[:, 6] = -np.pi / 2 - rotations_y_of_yaws(boxes[:, 6], frame.calibration, meaning)
    calibration = Calibration(dataset.files(name).calibration)
    scores = np.full(len(boxes), 0.9)
    write_results(Path(results) / f"{name}.txt", boxes, scores, list(SIZES), calibration)
"""


def writing_rotation_y(home: Path, meaning: str) -> str:
    """Return the command that writes KITTI result files with rotation_y of a meaning."""
    (home / "kitti_results.py").write_text(KITTI_RESULTS)
    program = shlex.join([sys.executable, str(home / "kitti_results.py")])
    return f"{program} {{data}} {{results}} {meaning}"


def with_modes(home: Path, modes: Path, *lines: str) -> str:
    """Return the command whose calls behave as in the lines, then normally."""
    modes.write_text("\n".join(lines))
    return command_of(home / "my detector" / "infer.py", "''", str(modes))


def states(workspace: Workspace, stage: str) -> dict[str, int]:
    """Return the number of frames by state."""
    query = f"SELECT state, count(*) FROM task WHERE stage = '{stage}' GROUP BY state"
    return dict(rows(workspace, query))


def test_rows_do_not_depend_on_workers_and_batches(home: Path, tmp_path: Path) -> None:
    """Labels have weights, because the command has seen the augmented copies."""
    expected = make(tmp_path / "one", home, run={"executor": "serial", "workers": 1})
    run_workspace(expected)
    assert rows(expected, "SELECT count(*) > 20 FROM weighted_labels WHERE weight > 0") == [(1,)]
    two = {"batch_size": 5, "workers": 2, "timeout_s": 600.0}
    for name, detector, run in (
        ("two", two, {"executor": "process", "workers": 2}),
        ("auto", {"batch_size": 7}, {"workers": "auto"}),
    ):
        other = make(tmp_path / name, home, run=run)
        other = other.with_settings("detector", **detector)
        run_workspace(other)
        assert dump(other) == dump(expected)


def test_every_view_is_a_run_of_its_own(home: Path, tmp_path: Path) -> None:
    """All frames of a batch share it, and a copy is as drawn for the detectors of this process."""
    workspace = make(tmp_path / "work", home, repredict={"views": 2})
    run_stage(workspace, "predict")
    run_stage(workspace, "repredict")
    logs = sorted(path.name for path in (workspace.root / "logs").iterdir())
    assert len([name for name in logs if "view-1" in name]) == 2  # the trial, and all others
    assert len([name for name in logs if "view-2" in name]) == 2
    drawn = repredict.augmented_views(workspace.config, 0, 1)
    stored = rows(
        workspace,
        "SELECT frame, view, flip_y, rotation_rad, scale FROM reprediction_view "
        "JOIN frame ON frame.id = frame_id ORDER BY frame, view",
    )
    assert stored == [
        (frame, view, int(a.flip_y), a.rotation_rad, a.scale)
        for frame in workspace.frames("unlabeled")
        for view, a in enumerate(drawn.draw(frame))
    ]
    assert rows(workspace, "SELECT min(matched_views) FROM consistency") == [(2,)]


@pytest.mark.parametrize("mode", ["exit", "names", "half", "others"])
def test_a_wrong_command_ends_the_run_with_its_first_frames(
    home: Path, tmp_path: Path, mode: str
) -> None:
    """Nothing is stored, so a rerun with a better command starts anew."""
    script = home / "my detector" / "infer.py"
    workspace = make(tmp_path / "work", home, command_of(script, "''", mode))
    with pytest.raises(ModelError) as caught:
        run_stage(workspace, "predict")
    expected = {"names": "detector.rename", "half": "wrote no result", "others": "not requested"}
    assert expected.get(mode, "ended with exit code 3") in str(caught.value)
    assert states(workspace, "predict") == {}
    assert rows(workspace, "SELECT count(*) FROM prediction") == [(0,)]
    logs = list((workspace.root / "logs").iterdir())
    assert len(logs) == 1


def test_later_failures_fail_their_frames_and_are_tried_again(home: Path, tmp_path: Path) -> None:
    """Finished batches are kept, and the next run has only the failed frames."""
    modes = tmp_path / "modes"
    command = with_modes(home, modes, "", "exit", "")
    workspace = make(tmp_path / "work", home, command, detector={})
    workspace = workspace.with_settings("detector", batch_size=5)
    report = run_stage(workspace, "predict")
    assert (report.done, report.failed) == (18, 5)
    assert "exit code 3" in report.errors[0][1]
    report = run_stage(workspace, "predict")
    assert (report.done, report.failed, report.kept) == (5, 0, 18)


def test_failures_in_a_row_end_the_run(home: Path, tmp_path: Path) -> None:
    """A GPU that is gone does not cost a run for every batch."""
    command = with_modes(home, tmp_path / "modes", "", *["exit"] * 9)
    workspace = make(tmp_path / "work", home, command).with_settings("detector", batch_size=2)
    with pytest.raises(ModelError, match="6 frames in a row failed, so the rest is left out"):
        run_stage(workspace, "predict")
    assert states(workspace, "predict") == {"done": TRIAL_FRAMES, "failed": 6}


@pytest.mark.parametrize("modes", [["", "", "exit", "exit", "exit"], ["", "", "", "exit", "exit"]])
def test_failures_at_the_end_of_a_run_count_as_those_before(
    home: Path, tmp_path: Path, modes: list[str]
) -> None:
    """Fifteen frames after the trial in batches of 4, 4, 4 and 3: the last batch is small."""
    command = with_modes(home, tmp_path / "modes", *modes)
    workspace = make(tmp_path / "work", home, command).with_settings("detector", batch_size=4)
    if modes.count("exit") < 3:
        assert run_stage(workspace, "predict").failed == 7
        return
    with pytest.raises(ModelError, match="11 frames in a row failed"):
        run_stage(workspace, "predict")
    assert states(workspace, "predict") == {"done": TRIAL_FRAMES + 4, "failed": 11}


def test_results_of_the_original_frames_are_rejected(home: Path, tmp_path: Path) -> None:
    """A command that reads the data set, not the copies, would show perfect consistency."""
    script = home / "my detector" / "infer.py"
    wrapper = tmp_path / "originals.sh"
    wrapper.write_text(
        f'mkdir "$2/../seen"; for each in "$1"/*; do '
        f'ln -s "{home}/kitti/training/velodyne/$(basename $each)" "$2/../seen"; done\n'
        + command_of(script).replace("{clouds}", '"$2/../seen"').replace("{results}", '"$2"')
    )
    workspace = make(tmp_path / "work", home, f"sh {wrapper} {{clouds}} {{results}}")
    run_stage(workspace, "predict")
    with pytest.raises(ModelError, match="these are results of the original frames"):
        run_stage(workspace, "repredict")


def test_headings_are_compared_with_labels_before_anything_is_stored(
    curate: Curate,
    home: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The camera looks along x, so the frames themselves do not show the meaning of rotation_y."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    document = toy_document(home / "kitti", home / "segmenter.txt")

    options = {"command": writing_rotation_y(home, "calibration")}
    document["detector"] = {"name": "command", "options": options}
    wrong = initialise(tmp_path / "work", make_config(document, "test"), "0.5", "")
    setting = 'set detector.options.results.rotation_y = "calibration"'
    with pytest.raises(ModelError, match=setting) as caught:
        run_stage(wrong, "predict")
    assert_one_line(caught.value)
    assert states(wrong, "predict") == {}
    assert len(list((wrong.root / "logs").iterdir())) == 1
    code, out, _ = curate("doctor", "-w", wrong.root)
    assert (code, setting in out) == (1, True)
    options |= {"results": {"rotation_y": "calibration"}}
    assert run_stage(wrong.with_settings("detector", options=options), "predict").failed == 0
    assert "turned copies of labeled frames" not in caplog.text


def test_predictions_depend_on_command_files_and_teacher_but_not_on_time_limits(
    home: Path, tmp_path: Path
) -> None:
    workspace = make(tmp_path / "work", home)
    options = workspace.config.detector.options
    (workspace.root / "model.yaml").write_text("a")

    def fingerprint(**changes: object) -> str:
        changed = workspace.with_settings("detector", **changes)
        plan = open_plan(changed, 1)
        return plan.fingerprint(plan.graph.frames_stage("predict"))

    first = fingerprint()
    assert fingerprint(timeout_s=5.0, batch_size=3, workers=4) == first
    with_file = fingerprint(options={**options, "files": ["model.yaml"]})
    (workspace.root / "model.yaml").write_text("b")
    checkpoint = tmp_path / "weights.pt"
    checkpoint.write_text("weights")
    others = [
        with_file,
        fingerprint(options={**options, "files": ["model.yaml"]}),
        fingerprint(options={**options, "command": options["command"] + " --fast"}),
        fingerprint(options={**options, "results": {"sigmoid": True}}),
        fingerprint(path=checkpoint),
    ]
    assert len({first, *others}) == 6
    missing = workspace.with_settings("detector", options={**options, "files": ["none.yaml"]})
    with pytest.raises(ConfigError, match=r"detector\.options\.files: .*none\.yaml: no such file"):
        predict.check(missing)


def test_a_stage_without_its_input_names_the_command_that_makes_it(
    curate: Curate, home: Path, tmp_path: Path
) -> None:
    """Also after a change of the detector's options, which makes its predictions outdated."""
    workspace = make(tmp_path / "work", home)
    root = workspace.root
    hint = "run `curate predict --split labeled` first, or `curate run` for all stages"
    for more in ([], ["--dry-run"]):
        code, _, err = curate("repredict", "--split", "labeled", "-w", root, *more)
        assert (code, err.count("\n")) == (WorkspaceError.exit_code, 1)
        assert "predict of 1 labeled frames in round 1 is missing or out of date" in err
        assert hint in err
    assert curate("predict", "--split", "labeled", "-w", root)[0] == 0
    assert curate("repredict", "--split", "labeled", "-w", root)[0] == 0
    config = root / "curate.toml"
    config.write_text(config.read_text().replace("{clouds}", "{clouds} "))
    config.write_text(config.read_text().replace("{results}", "{results} ''"))
    for command in ("repredict", "score"):
        code, _, err = curate(command, "--split", "labeled", "-w", root)
        assert (code, hint in err) == (WorkspaceError.exit_code, True)


def test_mistakes_are_found_by_init_and_doctor(curate: Curate, home: Path, tmp_path: Path) -> None:
    """`init` knows the program and the placeholders, `doctor` runs the command on a frame."""
    script = home / "my detector" / "infer.py"

    def init(command: str, *more: str) -> tuple[int, str, str]:
        return curate(
            "init", tmp_path / "work", "--root", home / "kitti", "--labeled", "0.1",
            "--detector", "command", "--set", f"detector.options.command={command}",
            "--set", 'run.priors=["points"]', *more,
        )  # fmt: skip

    for command, reason in {
        "infer-3d {data} {results}": "infer-3d cannot be started: no such program",
        "sh infer.sh {data} {result}": "unknown placeholder {result}; did you mean 'results'?",
    }.items():
        code, _, err = init(command)
        assert (code, err.count("\n")) == (ConfigError.exit_code, 1)
        assert reason in err
    for setting, reason in {
        "detector.options.command=python infer.py {data} {results}": "infer.py: no such file",
        "detector.options.files=['model.yaml']": "model.yaml: no such file",
        "train.command=cd x && python train.py": "train command: `&&` is shell syntax",
    }.items():
        code, _, err = init(command_of(script), "--set", setting)
        assert (code, err.count("\n")) == (ConfigError.exit_code, 1)
        assert reason in err
    assert not (tmp_path / "work").exists()
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "model.yaml").touch()
    code, _, err = init(command_of(script), "--set", "detector.options.files=['model.yaml']")
    assert code == 0, err
    code, out, err = curate("doctor", "-w", tmp_path / "work", "--json")
    findings = {(each["check"], each["state"]) for each in json.loads(out)["findings"]}
    assert {("views", "ok"), ("headings", "ok")} <= findings, out + err
    (tmp_path / "work" / "model.yaml").unlink()
    _, out, _ = curate("doctor", "-w", tmp_path / "work")
    assert "model.yaml: no such file" in out


def test_evaluate_runs_the_command_on_val_frames(
    curate: Curate, home: Path, tmp_path: Path
) -> None:
    """A frame that fails is an error there."""
    workspace = make(tmp_path / "work", home)
    code, out, err = curate("evaluate", "-w", workspace.root)
    assert code == 0, err
    assert "command on 2 val frames" in out
    failing = make(
        tmp_path / "other", home, command_of(home / "my detector/infer.py", "''", "exit")
    )
    code, _, err = curate("evaluate", "-w", failing.root)
    assert code in {ModelError.exit_code, FramesFailed.exit_code}
    assert "exit code 3" in err


def test_later_rounds_without_a_checkpoint_are_a_warning(
    home: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    workspace = make(tmp_path / "work", home, train={"command": "cp {labels} {output}"})
    predict.check(workspace)
    assert "does not use {teacher}" in caplog.text
