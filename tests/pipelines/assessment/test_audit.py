"""`curate audit`: the same stages, the same weights, and only then the truth."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.pipelines_cli import Curate
from support.silent import Silent
from support.toys import write_toy_kitti

from curate.errors import ConfigError, FramesFailed, LeakageError, WorkspaceError
from curate.geometry.overlap import bev_iou
from pipelines.assessment.audit import EVIDENCE, POLICIES, AuditRequest, run_audit
from pipelines.assessment.audit_folds import open_folds
from pipelines.engine.rounds import open_round
from pipelines.labels.evidence import read_evidence
from pipelines.workspace.workspace import Workspace

BIN = "SELECT low, labels, precision FROM audit_bin WHERE category = 'all' AND policy = 'uniform'"


def audit(workspace: Workspace, **request: object):
    """An audit with few draws, and the names of the stages that did something."""
    done: list[str] = []
    found = run_audit(
        workspace,
        AuditRequest(**{"replicates": 20, **request}),
        Silent(),
        lambda report: done.extend([report.stage] * bool(report.done)),
    )
    return found, done


def count(workspace: Workspace, sql: str) -> int:
    """A number from the database."""
    with workspace.database.reading() as connection:
        return connection.exec_driver_sql(sql).scalar_one()


def test_val_frames_are_treated_as_if_they_were_unlabeled(workspace: Workspace) -> None:
    """Every stage runs on the four val frames; a second audit does nothing again."""
    found, done = audit(workspace)
    assert done == ["predict", "repredict", "points", "semantic"]
    some = found.figures.whole()["pspsl"]
    assert (found.figures.frames, some.labels, some.objects) == (4, 12, 12)
    assert set(found.figures.whole()) == {*POLICIES, *EVIDENCE}
    again, done = audit(workspace)
    assert done == []
    assert again.figures.whole()["pspsl"].auroc == some.auroc


def test_the_weights_are_those_that_solve_would_give_these_frames(workspace: Workspace) -> None:
    """Eq. 11 written out, with lambda over the val labels alone; right by the nearest object."""
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


def test_the_audit_leaves_the_unlabeled_frames_alone(workspace: Workspace) -> None:
    """Neither labels nor weights of X_u appear, and weighted_labels hides those of val."""
    audit(workspace)
    assert count(workspace, "SELECT count(*) FROM weighted_labels") == 0
    assert count(workspace, "SELECT count(*) FROM weight") == 0
    sql = "SELECT count(*) FROM prediction JOIN frame ON frame.id = frame_id WHERE split <> 'val'"
    assert count(workspace, sql) == 0


def test_folds_are_workspaces_inside_the_workspace(workspace: Workspace) -> None:
    """Each holds out other labeled frames; together all of them, none twice; then they are kept."""
    found, done = audit(workspace, folds=2)
    assert found.figures.frames == 2
    assert done[:2] == ["predict 1/2", "repredict 1/2"]
    assert "points 2/2" in done
    folds = list(open_folds(workspace, 2))
    home = workspace.root / "reports" / "audit" / "2-folds-seed-0"
    assert [fold.root for fold in folds] == [home / "fold-1", home / "fold-2"]
    held = [set(fold.frames("val")) for fold in folds]
    labeled = set(workspace.frames("labeled"))
    assert held[0] | held[1] == labeled
    assert not held[0] & held[1]
    for fold, own in zip(folds, held, strict=True):
        assert set(fold.frames("labeled")) == labeled - own
        assert fold.database.url != workspace.database.url
        assert count(fold, "SELECT count(*) FROM prediction") == 3
    assert count(workspace, "SELECT count(*) FROM prediction") == 0
    assert audit(workspace, folds=2)[1] == []


def test_a_changed_setting_reaches_the_folds(workspace: Workspace) -> None:
    """Only what depends on it is done again there."""
    audit(workspace, folds=2)
    changed = workspace.with_settings("points", statistic="mean")
    assert audit(changed, folds=2)[1] == ["points 1/2", "points 2/2"]


def test_the_labeled_frames_can_be_audited_with_a_detector_that_never_saw_them(
    workspace: Workspace,
) -> None:
    """The toy detector learned from nothing."""
    found, _ = audit(workspace, split="labeled")
    assert found.figures.frames == 2


@pytest.mark.parametrize(
    ("request_of", "error", "message"),
    [
        ({"split": "unlabeled"}, ConfigError, "only val and labeled"),
        ({"folds": 3}, ConfigError, "--folds 3: the 2 labeled frames make 2 to 2 folds"),
        ({"folds": 2, "round_number": 2}, ConfigError, "first round"),
        ({"names": ("nonsense",)}, ConfigError, "unknown policy 'nonsense'"),
    ],
)
def test_what_cannot_be_audited_is_rejected_before_anything_runs(
    workspace: Workspace, request_of: dict, error: type, message: str
) -> None:
    """In one line."""
    with pytest.raises(error, match=message):
        audit(workspace, **request_of)
    assert count(workspace, "SELECT count(*) FROM task") == 0


def test_the_frames_that_a_teacher_learned_from_are_rejected(workspace: Workspace) -> None:
    """A detector that curate trains knows the labeled frames; the remedy is named."""
    trained = workspace.with_settings("detector", name="pillars")
    with pytest.raises(LeakageError, match="--folds"):
        audit(trained, split="labeled")


def test_without_val_frames_folds_are_offered(curate: Curate, tmp_path: Path) -> None:
    """A one-line error."""
    write_toy_kitti(tmp_path / "none", frames=4)
    (tmp_path / "d.txt").write_text("")
    detector = ("--detector", "support.toys:ToyDetector", "--detector-path", tmp_path / "d.txt")
    work = tmp_path / "w"
    curate("init", work, "--root", tmp_path / "none", "--labeled", "0.5", *detector)
    code, _, err = curate("audit", "-w", work)
    assert code == WorkspaceError.exit_code
    assert "--folds" in err


def test_the_command_tells_draws_and_stores(curate: Curate, workspace: Workspace) -> None:
    """Sentences, a picture, rows that a query finds; a second run replaces them."""
    for _ in range(2):
        code, out, err = curate("audit", "-w", workspace.root, "--replicates", "50")
        assert (code, err) == (0, "")
    assert "of 12 labels are right" in out
    assert "Of the policies, " in out
    picture = workspace.root / "reports" / "audit-round-01-val-bev.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert str(picture) in out
    sql = "SELECT policy, category, labels, auroc FROM audit"
    rows = json.loads(curate("query", sql, "--json", "-w", workspace.root)[1])
    assert len(rows) == 7 * 4
    assert {row["labels"] for row in rows if row["category"] == "all"} == {12}
    bins = json.loads(curate("query", BIN, "--json", "-w", workspace.root)[1])
    assert [(row["low"], row["labels"]) for row in bins] == [(0.9, 12)]
    assert count(workspace, "SELECT count(*) FROM audit_slice") == 7 * 4 * 7


def test_the_json_says_the_same_as_the_tables(curate: Curate, workspace: Workspace) -> None:
    """Strict JSON and nothing else on standard output."""
    arguments = ("--policy", "pspsl", "--policy", "score", "--overlap", "3d", "--json")
    code, out, _ = curate("audit", "-w", workspace.root, *arguments)
    assert code == 0
    found = json.loads(out, parse_constant=pytest.fail)
    assert (found["audited"], found["overlap"], found["frames"]) == ("val", "3d", 4)
    sql = "SELECT policy, category, auroc, auroc_low FROM audit WHERE overlap = '3d'"
    rows = json.loads(curate("query", sql, "--json", "-w", workspace.root)[1])
    stored = {(row["policy"], row["category"]): (row["auroc"], row["auroc_low"]) for row in rows}
    told = {
        (each["policy"], each["category"]): (each["auroc"]["value"], each["auroc"]["low"])
        for each in found["figures"]
        if each["slice"]["by"] == "all"
    }
    assert stored == told
    assert len(stored) == 2 * 4


def test_a_failed_frame_is_left_out_and_counted(
    curate: Curate, workspace: Workspace, toy_kitti: Path
) -> None:
    """The audit ends with what there is, and a non-zero exit."""
    frame = next(iter(workspace.frames("val")))
    (toy_kitti / "training" / "velodyne" / f"{frame}.bin").write_bytes(b"odd")
    code, out, err = curate("audit", "-w", workspace.root, "--replicates", "10")
    assert code == FramesFailed.exit_code
    assert f"{frame}.bin" in err
    assert "on 3 frames with 9 objects" in out


def test_frames_without_labels_count_their_objects(
    curate: Curate, workspace: Workspace, toy_kitti: Path
) -> None:
    """Empty sweeps: nothing found, nothing failed, everything missed."""
    for frame in workspace.frames("val"):
        (toy_kitti / "training" / "velodyne" / f"{frame}.bin").write_bytes(b"")
    code, out, _ = curate("audit", "-w", workspace.root, "--replicates", "10")
    assert code == 0
    assert "There is no label on 4 frames with 12 objects" in out


def test_an_audit_without_the_point_prior_has_no_point_slices(
    curate: Curate, workspace: Workspace
) -> None:
    """Nobody has counted the points."""
    path = workspace.root / "curate.toml"
    path.write_text(path.read_text().replace('["points", "semantic"]', '["semantic"]'))
    code, _, err = curate("audit", "-w", workspace.root, "--replicates", "10")
    assert (code, err) == (0, "")
    sql = "SELECT count(*) FROM audit_slice WHERE kind = 'points'"
    assert count(workspace, sql) == 0


def test_an_unknown_overlap_is_rejected(curate: Curate, workspace: Workspace) -> None:
    """The message lists what there is."""
    code, _, err = curate("audit", "-w", workspace.root, "--overlap", "2d")
    assert (code, err) == (ConfigError.exit_code, "error: --overlap 2d: use bev or 3d\n")
