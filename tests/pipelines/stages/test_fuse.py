"""Fused boxes in a workspace: which box each stage uses, and what is stale after a change."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select
from support.pipelines_cli import Curate
from support.recorded_scenes import write_recorded_scenes
from support.rounds import run, run_stage
from support.silent import Silent

from curate.detections import Detections
from curate.evaluation.reliability import MatchSettings, Overlap, match_to_ground_truth
from curate.fusion import fuse_boxes
from curate.geometry.overlap import bev_iou
from curate.geometry.points_in_boxes import count_points_in_boxes
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.assessment.audit import AuditedRound, AuditRequest, run_audit
from pipelines.commands.audit import print_fusion
from pipelines.engine.schedule import check_stages
from pipelines.engine.stage import TruthFrames, TruthSource
from pipelines.labels.compared import compare_labels
from pipelines.labels.evidence import read_evidence, read_memory
from pipelines.labels.of_one_frame import read_frame
from pipelines.round import graph_of
from pipelines.workspace.config import make_config
from pipelines.workspace.config_file import write_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

UNCHANGED = ("predict", "repredict")


@pytest.fixture
def views(workspace: Workspace) -> Workspace:
    """Return a workspace with three views and without fusion.

    The toy detector gives every box the heading 0, so a mapped-back box has another one.
    """
    return workspace.with_settings("repredict", views=3)


def fusing(workspace: Workspace, **changes: Any) -> Workspace:
    """Return the workspace with fused boxes."""
    found = workspace.with_settings("repredict", fuse=True, **changes)
    write_config(found.root / "curate.toml", found.config)
    return found


def rows(workspace: Workspace, sql: str) -> list[tuple[Any, ...]]:
    """Return the rows of a query."""
    with workspace.database.reading() as connection:
        return [tuple(row) for row in connection.exec_driver_sql(sql)]


def expected(workspace: Workspace) -> dict[int, np.ndarray]:
    """Return the fused boxes by frame key, from the stored predictions and repredictions."""
    keys = list(workspace.frames("unlabeled").values())
    table = bulk.table("reprediction")
    found = {}
    for key, predictions in workspace.predictions(1, keys).items():
        query = select(
            table.c.category, table.c.score, *(table.c[name] for name in BOX_COLUMNS),
            table.c.matched_k,
        ).where(table.c.frame_id == key)  # fmt: skip
        stored = workspace.database.rows(query)
        matched = np.array([-1 if row[-1] is None else row[-1] for row in stored], dtype=int)
        others = Detections.from_rows([(*row[:-1], None) for row in stored])
        found[key] = fuse_boxes(predictions, others, matched)[0]
    return found


def test_every_later_stage_uses_the_fused_box(views: Workspace, curate: Curate) -> None:
    """The view, an export, points in the box, policies, pictures and explain; L is as before."""
    run(views)
    before = rows(views, "SELECT frame_id, k, loss FROM consistency")
    predicted = rows(views, "SELECT * FROM prediction")
    fused = fusing(views)
    run(fused)
    assert rows(fused, "SELECT frame_id, k, loss FROM consistency") == before
    assert rows(fused, "SELECT * FROM prediction") == predicted
    boxes = expected(fused)
    names = {key: name for name, key in fused.frames("unlabeled").items()}
    moved = 0
    columns = ", ".join(BOX_COLUMNS)
    sql = f"SELECT frame, k, {columns}, points FROM weighted_labels ORDER BY frame, k"
    shown = {row[:2]: row[2:] for row in rows(fused, sql)}
    with closing(sqlite3.connect(fused.root / "exports" / "labels.sqlite")) as exported:
        assert {row[:2]: row[2:] for row in exported.execute(sql)} == shown
    for key, of_frame in boxes.items():
        name = names[key]
        moved += int((of_frame != fused.predictions(1, [key])[key].boxes).any(axis=1).sum())
        np.testing.assert_array_equal(fused.labels(1, [key])[key].boxes, of_frame)
        np.testing.assert_array_equal(read_frame(fused, name, 1, "pspsl").labels.boxes, of_frame)
        points = count_points_in_boxes(fused.dataset.read(name).points, of_frame)
        for k, box in enumerate(of_frame):
            assert shown[name, k] == (*box.tolist(), points[k])
    assert moved > 10
    together = np.concatenate(list(boxes.values()))
    np.testing.assert_array_equal(
        read_evidence(fused, 1, list(boxes), boxes=True)[1].boxes, together
    )
    np.testing.assert_array_equal(read_memory(fused, 1, "pspsl").boxes, together)
    code, out, err = curate("explain", name, "0", "-w", fused.root)
    assert code == 0, err
    assert "  fused          mean of " in out
    x = fused.predictions(1, [key])[key].boxes[0, 0]
    assert f"  detector's box x {x:.4f}" in out
    assert f"  box            x {boxes[key][0, 0]:.4f}" in out
    assert "they differ" not in out


def test_a_change_makes_only_the_stages_after_fusion_stale(
    views: Workspace, curate: Curate
) -> None:
    """Off, on, off: the detector never runs again, and the labels are those of before."""
    run(views)
    labels = rows(views, "SELECT * FROM weighted_labels ORDER BY frame, k")
    fused = fusing(views)
    done = run(fused)
    assert {name: done[name] for name in UNCHANGED} == dict.fromkeys(UNCHANGED, 0)
    assert all(done[name] for name in ("fuse", "points", "semantic", "solve", "export"))
    with_fusion = rows(fused, "SELECT * FROM weighted_labels ORDER BY frame, k")
    assert with_fusion != labels
    assert set(run(fused).values()) == {0}
    done = run(views)
    assert {name: done[name] for name in UNCHANGED} == dict.fromkeys(UNCHANGED, 0)
    assert all(done[name] for name in ("points", "semantic", "solve", "export"))
    assert "fuse" not in done
    assert rows(views, "SELECT * FROM weighted_labels ORDER BY frame, k") == labels
    assert rows(views, "SELECT * FROM fused_box") == []
    code, out, err = curate("repredict", "--json", "-w", fused.root)
    assert code == 0, err
    stages = {each["stage"]: each["done"] for each in json.loads(out)}
    assert stages == {"repredict": 0, "fuse": 6}
    run(fused)
    assert rows(fused, "SELECT * FROM weighted_labels ORDER BY frame, k") == with_fusion


@pytest.mark.parametrize("views", [1, 3])
def test_few_views_are_reported_before_the_first_frame(
    workspace: Workspace, caplog: pytest.LogCaptureFixture, views: int
) -> None:
    """With one view; with three there is nothing to report."""
    fused = fusing(workspace, views=views)
    check_stages(fused, graph_of(fused), "pspsl")
    lines = [each for each in caplog.messages if "repredict.fuse" in each]
    assert len(lines) == (views < 3)
    for line in lines:
        assert line.startswith("repredict.fuse = true: repredict.views is 1; use 3 or more")
        assert "\n" not in line


def test_frames_without_a_match_keep_their_labels(views: Workspace) -> None:
    """A minimum IoU that nothing reaches: every box is that of the detector, and has evidence."""
    fused = fusing(views, minimum_iou=0.999)
    for name in ("predict", "repredict", "fuse", "points"):
        assert run_stage(fused, name).done == 6
    assert set(rows(fused, "SELECT DISTINCT boxes FROM fused_box")) == {(1,)}
    keys = list(fused.frames("unlabeled").values())
    for key, found in fused.predictions(1, keys).items():
        np.testing.assert_array_equal(fused.labels(1, [key])[key].boxes, found.boxes)
    assert rows(fused, "SELECT count(*) FROM point_prior") == [(18,)]


def test_the_audit_shows_the_share_of_correct_boxes_before_and_after(
    views: Workspace, curate: Curate, capsys: pytest.CaptureFixture
) -> None:
    """By both overlaps, counted here from the stored boxes; as a table and as JSON."""
    fused = fusing(views)
    found = run_audit(fused, AuditRequest(replicates=20), Silent(), lambda _: None)
    for overlap in ("bev", "3d"):
        check_effect(fused, found, overlap)
    print_fusion(found)
    assert "share of correct labels before and after fusion" in capsys.readouterr().out
    here = ("-w", fused.root, "--policy", "score", "--replicates", "10", "--json")
    shown = json.loads(curate("audit", *here)[1])["fusion"]
    assert [each["category"] for each in shown] == 2 * ["all", *fused.config.dataset.categories]
    assert {"before", "after", "difference"} <= set(shown[0])


def check_effect(fused: Workspace, found: AuditedRound, overlap: Overlap) -> None:
    """Compare the effect in an audit with shares that are counted here."""
    [effect] = [each for each in found.fusion if (each.overlap, each.category) == (overlap, "all")]
    settings = MatchSettings(overlap)
    truth = fused.ground_truth("val")
    for read, share in ((fused.predictions, effect.before), (fused.labels, effect.after)):
        correct = []
        for name, key in fused.frames("val").items():
            labels = read(1, [key])[key]
            correct += match_to_ground_truth(labels, truth[name], settings, None).correct.tolist()
        assert share.value == pytest.approx(np.mean(correct))
    assert effect.labels == 12
    assert effect.difference.value == pytest.approx(effect.after.value - effect.before.value)
    assert found.figures.whole()["pspsl"].share_right.value == next(
        each.after.value for each in found.fusion if each.overlap == "bev"
    )


def test_results_with_copies_of_their_own_are_fused(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Recorded predictions with one mirrored copy: their number of views is reported."""
    document = write_recorded_scenes(tmp_path / "data", 6, 4)
    document |= {"run": {"priors": ["points"]}, "repredict": {"fuse": True, "views": 5}}
    labeled = str(tmp_path / "data" / "labeled.txt")
    fused = initialise(tmp_path / "work", make_config(document, "test"), labeled, "")
    for name in ("predict", "repredict", "fuse"):
        assert run_stage(fused, name).done == 2
    [line] = [each for each in caplog.messages if "repredict.fuse" in each]
    assert "views of the results: 1; use 3 or more" in line
    boxes = expected(fused)
    for key, found in fused.labels(1, list(boxes)).items():
        np.testing.assert_array_equal(found.boxes, boxes[key])
    assert rows(fused, "SELECT count(*) FROM fused_box WHERE boxes = 2")[0][0] > 20


def test_a_calibration_judges_the_fused_boxes(views: Workspace) -> None:
    """Its evidence is that of the fused boxes, so the truth is compared with them as well."""
    workspace = fusing(views)
    request = AuditRequest(replicates=10, names=("pspsl",))
    context = run_audit(workspace, request, Silent(), lambda _: None).context
    keys, truth = workspace.frames("val"), workspace.ground_truth("val")

    def best(read: Any) -> np.ndarray:
        found = read(1, list(keys.values()))
        overlaps = [bev_iou(found[key].boxes, truth[name].boxes) for name, key in keys.items()]
        return np.concatenate([np.nan_to_num(each).max(axis=1) for each in overlaps])

    fused, plain = best(workspace.labels), best(workspace.predictions)
    k = int(np.argmax(np.abs(fused - plain)))
    threshold = (fused[k] + plain[k]) / 2
    assert ((fused > threshold) != (plain > threshold)).any()
    frames = TruthFrames(TruthSource(workspace, "val", "val"), context, list(keys.values()), ())
    overlaps = dict.fromkeys(workspace.config.dataset.categories, float(threshold))
    found = compare_labels(frames, workspace.config, overlaps)
    assert found.correct.sum() == (fused > threshold).sum()
    assert (
        found.evidence.boxes.tolist()
        == np.concatenate(
            [workspace.labels(1, [key])[key].boxes for key in sorted(keys.values())]
        ).tolist()
    )
