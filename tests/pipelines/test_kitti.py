"""The commands on real KITTI frames, with recorded detections and a real segmenter."""

import csv
import json
import sqlite3
from pathlib import Path

import pytest
from support.pipelines_cli import Curate

pytestmark = pytest.mark.kitti

FRAMES = ("000000", "000004", "000008", "000016", "000020", "000025")


@pytest.fixture
def real_frames(tmp_path: Path, kitti_root: Path) -> Path:
    """Return six real frames in KITTI's layout."""
    for folder, ending in (("velodyne", "bin"), ("image_2", "png"), ("calib", "txt")):
        (tmp_path / "kitti" / folder).mkdir(parents=True)
        for frame in FRAMES:
            name = f"{frame}.{ending}"
            (tmp_path / "kitti" / folder / name).symlink_to(kitti_root / "training" / folder / name)
    (tmp_path / "kitti" / "label_2").symlink_to(kitti_root / "training" / "label_2")
    return tmp_path / "kitti"


def test_real_frames_get_weights_that_a_query_lists(
    curate: Curate, tmp_path: Path, real_frames: Path, kitti_root: Path
) -> None:
    """Stage by stage to the exported file.

    The parked cars in front have high weights, clutter does not.
    """
    work = tmp_path / "work"
    (tmp_path / "labeled.txt").write_text("000000\n000004\n")
    code, out, err = curate(
        "init", work, "--dataset", "kitti", "--root", real_frames, "--follow-links",
        "--labeled", tmp_path / "labeled.txt",
        "--detector", "recorded", "--detector-path", kitti_root / "recorded" / "pointgnn_T0.csv",
        "--segmenter", "onnx", "--segmenter-classes", "voc", "--segmenter-path",
        kitti_root / "segmenter" / "deeplabv3_mnv2_pascal_quant.onnx",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert "2 labeled, 4 unlabeled and 0 val frames" in out
    for command in ("predict", "repredict", "score", "solve", "export"):
        code, out, err = curate(command, "-w", work)
        assert code == 0, err
    sql = "SELECT frame, k, score, points, rho_anno, weight FROM weighted_labels ORDER BY weight"
    rows = json.loads(curate("query", sql, "--json", "-w", work)[1])
    record = csv.DictReader((kitti_root / "recorded" / "pointgnn_T0.csv").read_text().splitlines())
    recorded = [row for row in record if row["frame"] in FRAMES[2:] and row["view"] == "0"]
    assert len(rows) == len(recorded)
    best = [row for row in rows if row["frame"] == "000008" and row["weight"] > 0.5]
    assert len(best) >= 4
    assert all(row["weight"] == 0 for row in rows if row["points"] == 0)
    with sqlite3.connect(work / "exports" / "labels.sqlite") as file:
        assert file.execute("SELECT count(*) FROM weighted_labels").fetchone() == (len(rows),)
        truth = file.execute("SELECT DISTINCT frame FROM ground_truth ORDER BY 1").fetchall()
    assert truth == [("000000",), ("000004",)]


def test_frames_without_labels_are_read_too(
    curate: Curate, tmp_path: Path, kitti_root: Path
) -> None:
    """The raw drive has no label_2; the record defines its own augmented copies."""
    work = tmp_path / "work"
    code, out, err = curate(
        "init", work, "--root", kitti_root / "raw", "--labeled", "0",
        "--detector", "recorded",
        "--detector-path", kitti_root / "recorded" / "pointgnn_T0_raw.csv",
    )  # fmt: skip
    assert code == 0, err
    assert "0 labeled, 13 unlabeled" in out
    code, out, err = curate("run", "-w", work)
    assert code == 0, err
    sql = "SELECT count(*) AS n, max(weight) AS best FROM weighted_labels"
    [row] = json.loads(curate("query", sql, "--json", "-w", work)[1])
    assert row["n"] > 100
    assert row["best"] > 0.9


def test_real_labels_are_fused_and_compared_with_labeled_boxes(
    curate: Curate, tmp_path: Path, real_frames: Path, kitti_root: Path
) -> None:
    """Fused boxes and references on real frames: what is stored explains every weight.

    The detector finds cars only, so one reference applies to all labels.
    """
    work = tmp_path / "work"
    (tmp_path / "labeled.txt").write_text("000000\n000004\n")
    code, _, err = curate(
        "init", work, "--root", real_frames, "--follow-links",
        "--labeled", tmp_path / "labeled.txt",
        "--detector", "recorded", "--detector-path", kitti_root / "recorded" / "pointgnn_T0.csv",
        "--segmenter", "onnx", "--segmenter-classes", "voc", "--segmenter-path",
        kitti_root / "segmenter" / "deeplabv3_mnv2_pascal_quant.onnx",
        "--set", "repredict.fuse=true", "--set", "semantic.reference=true",
    )  # fmt: skip
    assert code == 0, err
    code, _, err = curate("run", "-w", work)
    assert code == 0, err
    sql = (
        "SELECT w.*, p.x AS detected_x, f.boxes, c.matched_views FROM weighted_labels w "
        "JOIN frame USING (frame) JOIN prediction p ON p.frame_id = frame.id AND p.k = w.k "
        "JOIN fused_box f ON f.frame_id = frame.id AND f.k = w.k "
        "JOIN consistency c ON c.frame_id = frame.id AND c.k = w.k"
    )
    rows = json.loads(curate("query", sql, "--json", "--limit", "999", "-w", work)[1])
    assert len(rows) > 30
    for row in rows:
        assert row["boxes"] == 1 + row["matched_views"]
        assert (row["x"] != row["detected_x"]) is (row["boxes"] > 1)
        assert abs(row["x"] - row["detected_x"]) < 2
    [reference] = {row["share_reference"] for row in rows}
    assert 0.15 < reference <= 1
    for row in rows:
        if row["box_pixels"]:
            share = min(1, row["mask_pixels"] / row["box_pixels"] / reference)
            assert row["rho_anno"] == pytest.approx((row["score"] * share) ** 0.5)
    best = max(rows, key=lambda row: row["weight"])
    out = curate("explain", best["frame"], str(best["k"]), "-w", work)[1]
    assert "mean of 2 boxes" in out
    assert "they differ" not in out
