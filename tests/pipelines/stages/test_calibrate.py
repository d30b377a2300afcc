"""calibrate: the frames that it may learn from, what it stores, and when it runs again."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.pipelines_cli import Curate
from support.rounds import run_stage, run_workspace, state_of
from support.silent import Silent
from support.toys import toy_document, write_toy_kitti

from curate.errors import ConfigError
from curate.geometry.overlap import bev_iou
from pipelines.assessment.audit import AuditRequest, run_audit
from pipelines.engine.executors.serial import SerialExecutor
from pipelines.engine.preview import preview_all
from pipelines.engine.runner import run_first, run_frames
from pipelines.labels.calibration import read_calibration
from pipelines.labels.label_evidence import further_columns
from pipelines.round import graph_of, open_plan
from pipelines.stages.calibration_frames import choose_source
from pipelines.workspace.config import make_config
from pipelines.workspace.folds import open_folds
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

OVERLAPS = {"Car": 0.3, "Pedestrian": 0.5, "Cyclist": 0.21}
"""IoU that most labels of the toy detector exceed."""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return 26 frames, of which 18 are for validation, and the file of a detector."""
    root = tmp_path_factory.mktemp("calibrate")
    write_toy_kitti(root / "kitti", frames=26, val=18)
    (root / "detector.txt").touch()
    return root


def make(data: Path, root: Path, calibration: str = "0.56", **sections: Any) -> Workspace:
    """Return a workspace of 5 labeled, 3 unlabeled, 8 val and 10 frames set aside by default."""
    root.mkdir(exist_ok=True)
    detector = shutil.copy(data / "detector.txt", root / "detector.txt")
    document: dict[str, Any] = toy_document(data / "kitti", Path(detector))
    document["run"] = {"method": "learned", "executor": "serial", "priors": ("points",)}
    document["evaluation"], document["calibrate"] = {"overlaps": OVERLAPS}, {"thresholds": "kitti"}
    for name, values in sections.items():
        document[name] = {**document.get(name, {}), **values}
    return initialise(root / "work", make_config(document, "test"), "0.6", "", calibration)


@pytest.fixture(scope="module")
def calibrated(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Return a workspace in which everything has run; tests must not write to it."""
    workspace = make(data, tmp_path_factory.mktemp("calibrated"))
    run_workspace(workspace, train=False)
    return workspace


def stored(workspace: Workspace, table: str = "calibration") -> list[dict[str, Any]]:
    """Return the rows of a table."""
    with workspace.database.reading() as connection:
        rows = connection.exec_driver_sql(f"SELECT * FROM {table}").mappings().all()
    return [dict(row) for row in rows]


def done(workspace: Workspace) -> list[str]:
    """Bring everything up to date, and return the stages that did something."""
    return [each.stage for each in run_workspace(workspace, train=False) if each.done]


def correct_labels(workspace: Workspace, split: str) -> int:
    """Return how many labels have a sufficient overlap with the object of their category."""
    truth, keys, found = workspace.ground_truth(split), workspace.frames(split), 0
    for name, key in keys.items():
        labels = workspace.predictions(1, [key])[key]
        iou = bev_iou(labels.boxes, truth[name].boxes)
        same = labels.categories[:, None] == truth[name].categories[None]
        best = np.where(same, iou, 0).max(axis=1)
        found += int((best > [OVERLAPS[name] for name in labels.categories.tolist()]).sum())
    return found


def test_it_learns_from_frames_that_are_set_aside(calibrated: Workspace) -> None:
    """They are predicted like unlabeled frames, and give each label its probability."""
    [row] = stored(calibrated)
    assert (row["source"], row["frames"], row["labels"], row["neutral"]) == (
        *("calibration", 10, 30, 0),
    )
    assert row["right_labels"] == correct_labels(calibrated, "calibration")
    assert 0.5 < row["auroc"] <= 1
    assert row["fallback"] is None
    fit = read_calibration(calibrated, 1)
    assert (fit.frames, fit.labels, fit.correct) == (10, 30, row["right_labels"])
    weights = [each for each in stored(calibrated, "weight") if each["policy"] == "learned"]
    assert len(weights) == 9
    assert all(0 < each["probability"] < 1 for each in weights)
    assert stored(calibrated, "calibration_label") == []


def test_further_evidence_is_learned_from_frames_that_are_set_aside(
    data: Path, tmp_path: Path
) -> None:
    """Also if no frames are left for max_wrong, so that none of them has such evidence."""
    workspace = make(data, tmp_path, run={"priors": ("points", "density")})
    run_workspace(workspace, train=False)
    fit = read_calibration(workspace, 1)
    assert fit.further == further_columns(workspace.config) != ()
    assert stored(workspace, "calibration_label") == []


def test_a_second_run_does_nothing(calibrated: Workspace) -> None:
    assert done(calibrated) == []


def test_a_changed_threshold_repeats_the_fit_and_what_follows(data: Path, tmp_path: Path) -> None:
    """No label is made again; a change back repeats only these stages, too."""
    workspace = make(data, tmp_path)
    run_workspace(workspace, train=False)
    changed = workspace.with_settings("calibrate", overlap="3d")
    assert done(changed) == ["calibrate", "solve", "export"]
    assert stored(workspace)[0]["overlap"] == "3d"
    for section, values in (
        ("run", {"priors": ("points", "density")}),
        ("dataset", {"categories": (*OVERLAPS, "Tram")}),
        ("evaluation", {"overlaps": {"Car": 0.1}}),
        ("calibrate", {"thresholds": "relaxed"}),
    ):
        other = changed.with_settings(section, **values)
        assert state_of(other, "calibrate", "learned") == "stale", section
        assert state_of(other, "solve", "learned") == "stale", section
    workspace.config.detector.path.write_text("\n")
    assert state_of(changed, "calibrate", "learned") == "stale"


def test_an_interrupted_fit_resumes_with_the_labels_that_are_there(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames are not predicted again, and nothing of the fit is stored before it is complete."""
    workspace = make(data, tmp_path)

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("pipelines.stages.calibrate.fit_calibration", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_workspace(workspace, train=False)
    assert stored(workspace) == []
    assert done(workspace) == ["calibrate", "solve", "export"]


def test_policies_that_read_no_probability_have_no_such_stage(
    data: Path, tmp_path: Path, curate: Curate
) -> None:
    workspace = make(data, tmp_path, run={"method": "pspsl"})
    assert "calibrate" not in done(workspace)
    assert "calibrate" not in curate("graph", "-w", workspace.root)[1]
    assert "calibrate" not in curate("status", "-w", workspace.root)[1]
    code, _, err = curate("solve", "--policy", "learned", "-w", workspace.root)
    assert code != 0
    assert "run `curate calibrate --round 1 --policy learned`" in err
    code, out, err = curate("calibrate", "--dry-run", "-w", workspace.root)
    assert code == 0, err
    assert "predict calibration would work on 10 frames" in out
    for command in (("calibrate",), ("solve", "--policy", "learned")):
        assert curate(*command, "-w", workspace.root)[0] == 0
    assert len(stored(workspace)) == 1
    code, _, err = curate("calibrate", "--policy", "spsl", "-w", workspace.root)
    assert (code, err) == (
        *(ConfigError.exit_code, "error: policy spsl does not need `curate calibrate`\n"),
    )


def test_half_of_the_frames_set_aside_are_kept_for_max_wrong(data: Path, tmp_path: Path) -> None:
    """Neither half has a frame of the other."""
    workspace = make(data, tmp_path, solve={"learned": {"max_wrong": 0.6}}, calibration="0.89")
    run_workspace(workspace, train=False)
    [row] = stored(workspace)
    assert (row["frames"], row["held_out_frames"], row["unit"]) == (8, 8, "frame")
    held_out = stored(workspace, "calibration_label")
    assert len(held_out) == 24
    names = {key: name for name, key in workspace.frames("calibration").items()}
    assert all(each["unit"] == names[each["frame_id"]] for each in held_out)
    assert read_calibration(workspace, 1).frames == 8
    probabilities = {round(each["probability"], 9) for each in held_out}
    assert len(probabilities) > 20
    # After a change and a change back, the held-out labels are gone, so the fit is repeated.
    changed = workspace.with_settings("detector", minimum_score=0.2)
    for each in (changed, workspace):
        plan = open_plan(each, 1, split="calibration")
        predict = plan.graph.frames_stage("predict")
        run_frames(plan, predict, SerialExecutor(), Silent(), "calibration")
    assert stored(workspace, "calibration_label") == []
    assert "calibrate" in done(workspace)
    assert len(stored(workspace, "calibration_label")) == 24


def test_too_few_frames_set_aside_are_used_only_without_others(data: Path, tmp_path: Path) -> None:
    """Labeled frames are enough for a fit then."""
    workspace = make(data, tmp_path, calibration="0.22", detector={"unseen": "labeled"})
    assert len(workspace.frames("calibration")) == 4
    assert choose_source(workspace, 1) == "labeled"
    explicit = workspace.with_settings("calibrate", source="calibration")
    assert choose_source(explicit, 1) == "calibration"


def test_a_preview_has_the_stages_of_the_frames_to_learn_from(data: Path, tmp_path: Path) -> None:
    """It names the teachers of folds too, and the settings in curate.toml that changed."""
    workspace = make(data, tmp_path)
    run_workspace(workspace, train=False)

    def planned(workspace: Workspace) -> dict[str, tuple[str, ...]]:
        found = preview_all(workspace, graph_of(workspace), None)
        return {each.stage: each.reasons for each in found}

    assert planned(workspace)["calibrate"] == ()
    for section, values, name in (
        ("solve", {"learned": {"max_wrong": 0.5}}, "solve.learned.max_wrong"),
        ("calibrate", {"thresholds": "relaxed"}, "calibrate.thresholds"),
        ("evaluation", {"overlaps": {**OVERLAPS, "Car": 0.1}}, "evaluation.overlaps.Car"),
    ):
        config = workspace.config.model_dump()
        config[section] |= values
        changed = replace(workspace, config=make_config(config, "test"))
        assert planned(changed)["calibrate"] == (f"changed settings: {name}",)
    trained = make(
        data,
        tmp_path / "trained",
        "",
        detector={"name": "support.trainable_toy:GridDetector", "path": None},
        train={"pretrain_steps": 1, "pasted": 0},
        calibrate={"folds": 2},
    )
    for first in graph_of(trained).first_stages:
        run_first(trained, first, Silent())
    assert planned(trained)["pretrain of each fold"] == ("there are no folds yet",)
    list(open_folds(trained, 2))
    assert planned(trained)["pretrain 1/2"] == ("never ran",)


def test_labeled_frames_can_be_used_if_the_detector_has_not_seen_them(
    data: Path, tmp_path: Path
) -> None:
    """All of them, or those in a list; then all frames set aside are for max_wrong."""
    listed = tmp_path / "unseen.txt"
    learned = {"learned": {"max_wrong": 0.6}}
    workspace = make(
        data,
        tmp_path,
        detector={"unseen": "labeled"},
        calibrate={"source": "labeled"},
        solve=learned,
    )
    some = sorted(workspace.frames("labeled"))[:4]
    listed.write_text("\n".join([*some, *workspace.frames("calibration")]))
    run_stage_and_before(workspace)
    [row] = stored(workspace)
    assert (row["source"], row["frames"], row["held_out_frames"]) == ("labeled", 5, 0)
    assert "needs 20 correct labels" in row["fallback"]
    changed = workspace.with_settings("detector", unseen=listed)
    assert state_of(changed, "calibrate", "learned") == "stale"
    run_stage_and_before(changed)
    assert stored(workspace)[0]["frames"] == 4


def run_stage_and_before(workspace: Workspace) -> None:
    """Run everything except what follows the calibration."""
    for report in run_workspace(workspace, train=False):
        assert report.failed == 0


@pytest.mark.parametrize(
    ("sections", "calibration", "message"),
    [
        ({}, "", "may have been trained on the labeled frames.*detector.unseen.*--calibration"),
        ({"calibrate": {"source": "folds"}}, "0.6", "curate cannot train detector"),
        ({"calibrate": {"source": "calibration"}}, "", "no such frames; set frames aside"),
        ({"calibrate": {"source": "labeled"}}, "0.6", "may have been trained on the labeled"),
        (
            {"detector": {"unseen": "labeled"}, "solve": {"learned": {"max_wrong": 0.1}}},
            *("", "max_wrong needs frames.*--calibration"),
        ),
        ({"solve": {"learned": {"max_wrong": 0.1}}}, "0.28", "5 frames of 5 frames are too few"),
    ],
)
def test_frames_that_the_teacher_may_have_seen_are_rejected_before_any_work(
    data: Path, tmp_path: Path, sections: dict, calibration: str, message: str
) -> None:
    workspace = make(data, tmp_path, calibration, **sections)
    with pytest.raises(ConfigError, match=message):
        run_workspace(workspace, train=False)
    assert stored(workspace, "task") == []


def test_a_list_of_unseen_frames_is_compared_with_the_frames(
    data: Path, tmp_path: Path, curate: Curate
) -> None:
    """A frame set aside that is not in it may have been seen; the doctor and init say so."""
    listed = tmp_path / "unseen.txt"
    listed.write_text("000001\n")
    workspace = make(data, tmp_path, detector={"unseen": listed})
    settings = workspace.root / "curate.toml"
    out = curate("doctor", "-w", workspace.root)[1]
    assert "10 frames set aside are not in detector.unseen" in out or "lists no labeled" in out
    text = settings.read_text()
    settings.write_text(text.replace('source = "auto"', 'source = "calibration"'))
    code, _, err = curate("run", "-w", workspace.root)
    assert code == ConfigError.exit_code
    assert "10 frames set aside are not in detector.unseen (" in err
    listed.write_text("nonsense\n")
    assert "detector.unseen" in curate("run", "-w", workspace.root)[2]
    code, _, err = curate(
        *("init", tmp_path / "other", "--root", data / "kitti", "--unseen", tmp_path / "none"),
        *("--detector", "support.toys:ToyDetector", "--detector-path", data / "detector.txt"),
    )
    assert code == ConfigError.exit_code
    assert "no such file; give a file of frame ids, or labeled" in err


def test_too_few_frames_fall_back_to_pspsl(data: Path, tmp_path: Path) -> None:
    """Of fewer than five frames, nothing is even predicted; the summary says why."""
    workspace = make(data, tmp_path, calibration="0.22")
    reports = {each.stage: each for each in run_workspace(workspace, train=False)}
    assert "predict calibration" not in reports
    assert "no fit, because there are only 0 correct" in reports["calibrate"].summary
    assert "pspsl" in reports["solve"].summary
    run_stage(workspace, "solve", policy="pspsl")
    v: dict[str, list[float]] = {"learned": [], "pspsl": []}
    for each in stored(workspace, "weight"):
        v[each["policy"]].append(each["v"])
    assert v["learned"] == v["pspsl"]


def test_labels_that_are_all_wrong_fall_back_to_pspsl(data: Path, tmp_path: Path) -> None:
    """At an overlap that no label reaches; a category without labels is none of the reasons."""
    workspace = make(data, tmp_path, evaluation={"overlaps": dict.fromkeys(OVERLAPS, 0.99)})
    run_workspace(workspace, train=False)
    [row] = stored(workspace)
    assert (row["labels"], row["right_labels"], row["fit"]) == (30, 0, None)
    loose = workspace.with_settings("evaluation", overlaps=OVERLAPS)
    run_workspace(loose.with_settings("dataset", categories=(*OVERLAPS, "Tram")), train=False)
    [row] = stored(workspace)
    assert "Tram" in json.loads(row["fit"])["categories"]


def test_folds_are_trained_once_and_shared_with_the_audit(data: Path, tmp_path: Path) -> None:
    """Later rounds train each fold on the labels of the round before, without its frames."""
    workspace = make(
        data,
        tmp_path,
        "",
        detector={"name": "support.trainable_toy:GridDetector", "path": None},
        train={"pretrain_steps": 30, "round_steps": 10, "pasted": 0},
        calibrate={"folds": 2},
        run={"rounds": 2},
    )
    reports = run_workspace(workspace)
    trained = [each.stage for each in reports if each.stage.startswith(("pretrain", "train"))]
    assert [name for name in trained if name.endswith("/2")] == [
        *("pretrain 1/2", "pretrain 2/2", "pretrain 1/2", "train-round 1 1/2"),
        *("pretrain 2/2", "train-round 1 2/2"),
    ]
    rows = stored(workspace)
    assert [(each["round"], each["source"], each["folds"]) for each in rows] == [
        *((1, "folds", 2), (2, "folds", 2)),
    ]
    assert [each["frames"] for each in rows] == [5, 5]
    assert [each.stage for each in run_workspace(workspace) if each.done] == []
    repeated: list[str] = []
    run_audit(
        workspace,
        AuditRequest(folds=2, replicates=5, names=("score",)),
        Silent(),
        lambda report: repeated.extend([report.stage] * bool(report.done)),
    )
    assert repeated == []
