"""`curate audit`: the same stages and weights as for unlabeled frames, then the ground truth."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from support.pipelines_cli import Curate
from support.silent import Silent
from support.toys import toy_document, write_toy_kitti

from curate.calibration.features import feature_names
from curate.calibration.model import Calibration, fit_calibration
from curate.errors import ConfigError, FramesFailed, LeakageError, WorkspaceError
from curate.evaluation.audit import COMPARED
from curate.geometry.overlap import bev_iou
from db import bulk
from pipelines.assessment import audited_labels, audited_probabilities
from pipelines.assessment.audit import (
    EVIDENCE,
    POLICIES,
    AuditRequest,
    describe_audit,
    run_audit,
)
from pipelines.engine.rounds import open_round
from pipelines.labels.evidence import read_evidence
from pipelines.workspace.config import make_config
from pipelines.workspace.folds import open_folds
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

BIN = "SELECT low, labels, precision FROM audit_bin WHERE category = 'all' AND policy = 'uniform'"
REFERENCE = (
    "SELECT reference, equal_recall_power AS power, "
    "equal_recall_precision = weighted_precision AS same FROM audit "
    "WHERE category = 'all' AND policy = 'spsl'"
)


def audit(workspace: Workspace, **request: object):
    """Run an audit with few bootstrap draws; return the names of the stages that did something."""
    done: list[str] = []
    found = run_audit(
        workspace,
        AuditRequest(**{"replicates": 20, **request}),
        Silent(),
        lambda report: done.extend([report.stage] * bool(report.done)),
    )
    return found, done


def count(workspace: Workspace, sql: str) -> int:
    """Return a number from the database."""
    with workspace.database.reading() as connection:
        return connection.exec_driver_sql(sql).scalar_one()


def test_val_frames_are_processed_like_unlabeled_frames(workspace: Workspace) -> None:
    """Every stage runs on the four val frames; a second audit does nothing again."""
    found, done = audit(workspace)
    assert done == ["predict", "repredict", "points", "semantic"]
    some = found.figures.whole()["pspsl"]
    assert (found.figures.frames, some.labels, some.objects) == (4, 12, 12)
    assert set(found.figures.whole()) == {*POLICIES, *EVIDENCE} - {"probability"}
    assert any(each.startswith("The score has no known meaning") for each in describe_audit(found))
    again, done = audit(workspace)
    assert done == []
    assert again.figures.whole()["pspsl"].auroc == some.auroc


def test_the_weights_equal_those_of_solve(workspace: Workspace) -> None:
    """Eq. 11 written out, with lambda over the val labels only.

    Correctness by the nearest object.
    """
    found, _ = audit(workspace)
    context = open_round(workspace)
    keys = workspace.frames("val")
    _, evidence = read_evidence(workspace, context.number, list(keys.values()))
    loss = evidence.loss[~np.isnan(evidence.loss)]
    share = context.number / context.rounds
    lambda_u = share * loss.max() + (1 - share) * loss.mean()
    easiness = np.nan_to_num(np.clip(1 - evidence.loss / lambda_u, 0, 1))
    weights = easiness * evidence.rho["rho_diff"] * evidence.rho["rho_anno"]
    right = []
    truth = workspace.ground_truth("val")
    for key, labels in workspace.predictions(context.number, list(keys.values())).items():
        objects = truth[next(name for name, other in keys.items() if other == key)]
        iou = bev_iou(labels.boxes, objects.boxes)
        minimum = np.where(labels.categories == "Car", 0.7, 0.5)
        same = labels.categories[:, None] == objects.categories[None]
        right += (np.where(same, iou, 0).max(axis=1) > minimum).tolist()
    some = found.figures.whole()["pspsl"]
    assert some.right == sum(right)
    assert some.weighted_precision.value == pytest.approx(weights[right].sum() / weights.sum())


def test_the_audit_does_not_change_the_unlabeled_frames(workspace: Workspace) -> None:
    """No labels or weights of X_u appear, and weighted_labels hides those of val."""
    audit(workspace)
    assert count(workspace, "SELECT count(*) FROM weighted_labels") == 0
    assert count(workspace, "SELECT count(*) FROM weight") == 0
    sql = "SELECT count(*) FROM prediction JOIN frame ON frame.id = frame_id WHERE split <> 'val'"
    assert count(workspace, sql) == 0


def test_folds_are_workspaces_inside_the_workspace(workspace: Workspace) -> None:
    """Each holds out other labeled frames; together they cover all of them once.

    Then they are kept.
    """
    found, done = audit(workspace, folds=2)
    assert found.figures.frames == 2
    assert done[:2] == ["predict 1/2", "repredict 1/2"]
    assert "points 2/2" in done
    folds = list(open_folds(workspace, 2))
    home = workspace.root / "reports" / "audit" / "2-folds-seed-0"
    assert [fold.root for fold in folds] == [home / "fold-1", home / "fold-2"]
    val_frames = [set(fold.frames("val")) for fold in folds]
    labeled = set(workspace.frames("labeled"))
    assert val_frames[0] | val_frames[1] == labeled
    assert not val_frames[0] & val_frames[1]
    for fold, own in zip(folds, val_frames, strict=True):
        assert set(fold.frames("labeled")) == labeled - own
        assert fold.database.url != workspace.database.url
        assert count(fold, "SELECT count(*) FROM prediction") == 3
    assert count(workspace, "SELECT count(*) FROM prediction") == 0
    assert audit(workspace, folds=2)[1] == []


def test_a_changed_setting_is_applied_to_the_folds(workspace: Workspace) -> None:
    """Only the stages that depend on it run again."""
    audit(workspace, folds=2)
    changed = workspace.with_settings("points", statistic="mean")
    assert audit(changed, folds=2)[1] == ["points 1/2", "points 2/2"]


def test_labeled_frames_can_be_audited_if_the_detector_was_not_trained_on_them(
    workspace: Workspace,
) -> None:
    """The toy detector is not trained."""
    found, _ = audit(workspace, split="labeled")
    assert found.figures.frames == 2


@pytest.mark.parametrize(
    ("request_of", "error", "message"),
    [
        ({"split": "unlabeled"}, ConfigError, "use val or labeled"),
        ({"folds": 3}, ConfigError, "--folds 3: 2 labeled frames allow 2 to 2 folds"),
        ({"folds": 2, "round_number": 2}, ConfigError, "first round"),
        ({"names": ("nonsense",)}, ConfigError, "unknown policy 'nonsense'"),
    ],
)
def test_an_impossible_audit_is_rejected_before_any_work(
    workspace: Workspace, request_of: dict, error: type, message: str
) -> None:
    with pytest.raises(error, match=message):
        audit(workspace, **request_of)
    assert count(workspace, "SELECT count(*) FROM task") == 0


def test_the_frames_that_a_teacher_was_trained_on_are_rejected(workspace: Workspace) -> None:
    """A detector trained by curate has seen the labeled frames; the error says what to do."""
    trained = workspace.with_settings("detector", name="pillars")
    with pytest.raises(LeakageError, match="--folds"):
        audit(trained, split="labeled")


def test_without_val_frames_the_error_suggests_folds(curate: Curate, tmp_path: Path) -> None:
    write_toy_kitti(tmp_path / "none", frames=4)
    (tmp_path / "d.txt").write_text("")
    detector = ("--detector", "support.toys:ToyDetector", "--detector-path", tmp_path / "d.txt")
    work = tmp_path / "w"
    curate("init", work, "--root", tmp_path / "none", "--labeled", "0.5", *detector)
    code, _, err = curate("audit", "-w", work)
    assert code == WorkspaceError.exit_code
    assert "--folds" in err


def test_the_command_prints_plots_and_stores_the_audit(
    curate: Curate, workspace: Workspace
) -> None:
    """Sentences, a plot, and rows that a query finds; a second run replaces them."""
    for _ in range(2):
        code, out, err = curate("audit", "-w", workspace.root, "--replicates", "50")
        assert (code, err) == (0, "")
    assert "of 12 labels are correct" in out
    assert "Of the policies, " in out
    plot = workspace.root / "reports" / "audit-round-01-val-bev.png"
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert str(plot) in out
    sql = "SELECT policy, category, labels, auroc FROM audit"
    rows = json.loads(curate("query", sql, "--json", "-w", workspace.root)[1])
    assert len(rows) == 7 * 4
    assert {row["labels"] for row in rows if row["category"] == "all"} == {12}
    bins = json.loads(curate("query", BIN, "--json", "-w", workspace.root)[1])
    assert [(row["low"], row["labels"]) for row in bins] == [(0.9, 12)]
    assert count(workspace, "SELECT count(*) FROM audit_slice") == 7 * 4 * 7
    options = ("--policy", "spsl", "--policy", "score", "--replicates", "50")
    assert curate("audit", "-w", workspace.root, *options)[0] == 0
    assert (plot.parent / "audit-round-01-val-bev-spsl-score.png").is_file()


def test_the_json_has_the_same_values_as_the_tables(curate: Curate, workspace: Workspace) -> None:
    """Standard output has strict JSON and nothing else."""
    arguments = ("--policy", "pspsl", "--policy", "score", "--overlap", "3d", "--json")
    code, out, _ = curate("audit", "-w", workspace.root, *arguments)
    assert code == 0
    found = json.loads(out, parse_constant=pytest.fail)
    assert (found["audited"], found["overlap"], found["frames"]) == ("val", "3d", 4)
    sql = "SELECT policy, category, auroc, auroc_low FROM audit WHERE overlap = '3d'"
    rows = json.loads(curate("query", sql, "--json", "-w", workspace.root)[1])
    stored = {(row["policy"], row["category"]): (row["auroc"], row["auroc_low"]) for row in rows}
    printed = {
        (each["policy"], each["category"]): (each["auroc"]["value"], each["auroc"]["low"])
        for each in found["figures"]
        if each["slice"]["by"] == "all"
    }
    assert stored == printed
    assert len(stored) == 2 * 4


def test_a_failed_frame_is_left_out_and_counted(
    curate: Curate, workspace: Workspace, toy_kitti: Path
) -> None:
    """The audit continues without it and exits with a non-zero code."""
    frame = next(iter(workspace.frames("val")))
    (toy_kitti / "training" / "velodyne" / f"{frame}.bin").write_bytes(b"odd")
    code, out, err = curate("audit", "-w", workspace.root, "--replicates", "10")
    assert code == FramesFailed.exit_code
    assert f"{frame}.bin" in err
    assert "on 3 frames with 9 objects" in out


def test_the_objects_of_frames_without_labels_are_missed(
    curate: Curate, workspace: Workspace, toy_kitti: Path
) -> None:
    """Empty sweeps: no labels, no failed frame, every object is missed."""
    for frame in workspace.frames("val"):
        (toy_kitti / "training" / "velodyne" / f"{frame}.bin").write_bytes(b"")
    code, out, _ = curate("audit", "-w", workspace.root, "--replicates", "10")
    assert code == 0
    assert "There are no labels on 4 frames with 12 objects" in out


def test_an_audit_without_the_point_prior_has_no_point_slices(
    curate: Curate, workspace: Workspace
) -> None:
    """The points per label were not counted."""
    path = workspace.root / "curate.toml"
    path.write_text(path.read_text().replace('["points", "semantic"]', '["semantic"]'))
    code, _, err = curate("audit", "-w", workspace.root, "--replicates", "10")
    assert (code, err) == (0, "")
    sql = "SELECT count(*) FROM audit_slice WHERE kind = 'points'"
    assert count(workspace, sql) == 0


def test_an_unknown_overlap_is_rejected(curate: Curate, workspace: Workspace) -> None:
    """The message lists the known ones."""
    code, _, err = curate("audit", "-w", workspace.root, "--overlap", "2d")
    assert (code, err) == (ConfigError.exit_code, "error: --overlap 2d: use bev or 3d\n")


def test_iou_thresholds_of_the_settings_hold_for_folds_and_rerun_nothing(
    workspace: Workspace,
) -> None:
    """A label of a car with an IoU between the two thresholds is correct by the lower one only."""
    strict = workspace.with_settings("evaluation", overlaps={"Car": 0.95, "Cyclist": 0.95})
    loose = workspace.with_settings("evaluation", overlaps={"Car": 0.01, "Cyclist": 0.01})
    counts = []
    for each in (strict, loose):
        found, done = audit(each, folds=2)
        counts.append(found.figures.whole()["uniform"].right)
    assert counts[0] < counts[1]
    assert done == []


def test_the_reference_is_the_method_of_the_run_or_the_requested_one(workspace: Workspace) -> None:
    """A reference that is not audited is rejected."""
    assert audit(workspace)[0].figures.reference == "pspsl"
    spsl = workspace.with_settings("run", method="spsl")
    assert audit(spsl)[0].figures.reference == "spsl"
    assert audit(workspace, reference="score")[0].figures.reference == "score"
    with pytest.raises(ConfigError, match="--reference score: not audited; use one of pspsl, spsl"):
        audit(workspace, reference="score", names=("pspsl", "spsl"))


def test_the_command_stores_and_names_differences(curate: Curate, workspace: Workspace) -> None:
    """Every two policies in every figure; those that may be chance are called so."""
    policies = ("--policy", "spsl", "--policy", "uniform", "--policy", "score")
    code, out, _ = curate("audit", "-w", workspace.root, "--replicates", "50", *policies)
    assert code == 0
    assert "differences to spsl" in out
    query = ("query", "--named", "differences", "--json", "-w", workspace.root)
    rows = [row for row in json.loads(curate(*query)[1]) if row["category"] == "all"]
    pairs = {(row["policy"], row["other"]) for row in rows}
    assert pairs == {("spsl", "uniform"), ("spsl", "score"), ("uniform", "score")}
    assert {row["figure"] for row in rows} == set(COMPARED)
    for row in rows:
        real = row["low"] > 0 or row["high"] < 0
        assert row["verdict"] == ("real" if real else "may be chance")
    reference = json.loads(curate("query", REFERENCE, "--json", "-w", workspace.root)[1])
    assert reference == [{"reference": "spsl", "power": 1.0, "same": 1}]


def test_frames_of_a_sequence_are_drawn_together(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four val frames of two drives: too few to distinguish a difference from chance."""

    def drives(_dataset, frames):
        return {name: f"drive {i // 2}" for i, name in enumerate(sorted(frames))}

    monkeypatch.setattr(audited_labels, "sequences_of", drives)
    found, _ = audit(workspace)
    assert (found.figures.sequences, found.figures.resampled) == (2, "2 sequences")
    assert not any(each.beyond_chance for each in found.figures.comparisons)
    assert "every difference may be chance" in " ".join(describe_audit(found))


@pytest.fixture
def labeled_only(tmp_path: Path, weights_file: Path) -> Workspace:
    """Return a workspace of 24 labeled frames, with correct and wrong labels."""
    write_toy_kitti(tmp_path / "many", frames=24)
    config = make_config(toy_document(tmp_path / "many", weights_file), "test")
    return initialise(tmp_path / "many-work", config, "1.0", "")


def test_no_fit_sees_the_labels_that_it_is_judged_by(
    labeled_only: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten fits; each leaves out other frames, and together they leave out every frame once."""
    left_out: list[int] = []

    def fit(evidence, correct, frame_index, **options):
        left_out.extend(set(range(24)) - set(frame_index.tolist()))
        return fit_calibration(evidence, correct, frame_index, **options)

    monkeypatch.setattr(audited_probabilities, "fit_calibration", fit)
    found, _ = audit(labeled_only, split="labeled")
    assert sorted(left_out) == list(range(24))
    assert {*found.names} == {*POLICIES, *EVIDENCE, "learned"}
    assert found.figures.whole()["probability"].auroc.value > 0.5
    text = " ".join(describe_audit(found))
    assert "probabilities of each label are from a fit to the labels of other frames" in text


def test_folds_are_fitted_to_the_other_folds(labeled_only: Workspace) -> None:
    """Every label has a probability; the summary names the other folds."""
    found, _ = audit(labeled_only, folds=3, names=("probability", "learned"))
    assert found.unmeasured == ()
    assert "fit to the labels of the other folds" in " ".join(describe_audit(found))


def test_too_few_labels_for_a_fit_are_described(workspace: Workspace) -> None:
    """Probabilities are then not measured, and not among the default names."""
    found, _ = audit(workspace, split="labeled", names=("probability", "score"))
    assert found.unmeasured == ("probability",)
    text = " ".join(describe_audit(found))
    assert re.search(r"Not measured: probability: \d correct and \d wrong labels of 1 frames", text)
    found, _ = audit(workspace, split="labeled")
    assert "probability" not in found.names
    text = " ".join(describe_audit(found))
    assert re.search(r"Left out: learned, probability: \d correct and \d wrong", text)


def test_a_comparison_with_what_was_not_measured_is_printed(
    curate: Curate, workspace: Workspace
) -> None:
    """There is no difference to show then."""
    code, out, err = curate(
        *("audit", "-w", workspace.root, "--split", "labeled", "--replicates", "10"),
        *("--policy", "pspsl", "--policy", "probability"),
    )
    assert (code, err) == (0, "")
    assert "Not measured: probability" in out
    assert "differences to" not in out


def test_val_frames_need_the_calibration_of_the_round(workspace: Workspace) -> None:
    """Without one, an explicit request fails before any work; with one, it is audited."""
    with pytest.raises(WorkspaceError, match="round 1 has no calibration"):
        audit(workspace, names=("learned",))
    assert count(workspace, "SELECT count(*) FROM task") == 0
    categories = workspace.config.dataset.categories
    features = len(feature_names(categories))
    ones = (1.0,) * features
    stored = Calibration(
        *(categories, (), {}, (0.0,) * features, ones, (1.0,) + (0.0,) * (features - 1), 0.0),
        *(0.3, 60, 40, 20),
    )
    row = {"round": 1, "source": "calibration", "folds": 0, "overlap": "bev"}
    row |= {"thresholds": "kitti", "teacher": "", "frames": 20, "labels": 60, "neutral": 0}
    row |= {"right_labels": 40, "unit": "frame", "held_out_frames": 0, "fit": stored.as_json()}
    with workspace.database.writing() as connection:
        bulk.insert_rows(connection, "calibration", [row])
    found, _ = audit(workspace.with_settings("calibrate", thresholds="kitti"))
    assert {"learned", "probability"} < {*found.names}
    # The only coefficient is that of logit(score), so the probability is the score.
    one, other = (found.figures.whole()[name] for name in ("probability", "score"))
    assert one.weighted_recall.value == pytest.approx(other.weighted_recall.value, rel=1e-3)
    summary = " ".join(describe_audit(found))
    assert "calibration of round 1, which was not fitted to these frames" in summary
    assert "relaxed" not in summary
    relaxed = workspace.with_settings("calibrate", thresholds="relaxed")
    summary = " ".join(describe_audit(audit(relaxed)[0]))
    assert "probability of being correct by bev IoU and relaxed thresholds" in summary
