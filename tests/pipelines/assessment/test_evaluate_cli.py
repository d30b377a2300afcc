"""`curate evaluate`: the official AP, one-line errors, outcomes in SQL."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.pipelines_cli import Curate
from support.toys import toy_calibration, toy_document

from curate.datasets.kitti.calibration import write_calibration
from curate.errors import ConfigError, DataError, WorkspaceError
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

LINE = "Car 0.00 0 0.50 100 100 180 160 1.5 1.6 4.0 0.0 1.7 20.0 0.3"
MISSED = "SELECT frame, k, category, iou FROM evaluation WHERE outcome = 'fn'"


@pytest.fixture
def workspace(tmp_path: Path, toy_kitti: Path, weights_file: Path) -> Workspace:
    """Return the toy workspace with a sharper camera, so that no object is too small to count."""
    calibration = toy_calibration()
    sharp = np.diag([10.0, 10.0, 1.0]) @ calibration.projection
    for frame in range(12):
        write_calibration(
            toy_kitti / "training" / "calib" / f"{frame:06d}.txt",
            replace(calibration, projection=sharp),
        )
        image = np.zeros((400, 1200, 3), dtype=np.uint8)
        cv2.imwrite(str(toy_kitti / "training" / "image_2" / f"{frame:06d}.png"), image)
    config = make_config(toy_document(toy_kitti, weights_file), "test")
    return initialise(tmp_path / "work", config, "0.25", "")


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Return labels and results of two frames: one has a detected car, one is empty."""
    labels, results = tmp_path / "label_2", tmp_path / "results"
    for folder, line in ((labels, LINE), (results, f"{LINE} 0.5")):
        folder.mkdir()
        (folder / "000001.txt").write_text(line + "\n")
        (folder / "000002.txt").write_text("")
    return labels, results


def evaluate(curate: Curate, folders: tuple[Path, Path], *more: object) -> tuple[int, str, str]:
    """Run the command on two folders."""
    return curate("evaluate", "--labels", folders[0], "--results", folders[1], *more)


def test_it_prints_the_same_values_as_the_official_program(
    curate: Curate, kitti_eval_root: Path
) -> None:
    """Values agree to 1e-4 for categories with 41 objects or more."""
    code, out, _ = evaluate(
        curate, (kitti_eval_root / "label_2", kitti_eval_root / "results"), "--json"
    )
    assert code == 0
    found, expected = json.loads(out), json.loads((kitti_eval_root / "expected.json").read_text())
    for table in ("AP_R40", "AP_R11"):
        for category, by_figure in expected[table].items():
            for figure, values in by_figure.items():
                for d, value in enumerate(values):
                    if found["objects"][category][d] >= 41:
                        ours = found[table][category][figure][d]
                        assert ours == pytest.approx(value, abs=1e-4), (table, category, figure)


def test_it_shows_r40_and_r11_side_by_side(curate: Curate, folders: tuple[Path, Path]) -> None:
    """And the recall; a detected car is exactly 100."""
    code, out, _ = evaluate(curate, folders)
    assert code == 0
    count = len(list(folders[1].glob("*.txt")))
    assert out.startswith(f"{folders[1]} on {count} frames\n")
    lines = {tuple(line.split()[:2]): line.split()[2:] for line in out.splitlines() if line.strip()}
    assert lines[("Car", "3d")] == ["100.00"] * 6
    assert lines[("Car", "aos")] == ["100.00"] * 6
    assert "recall 3d > 0.7" in out


def test_the_first_evaluation_reports_that_kernels_are_compiled(
    curate: Curate, folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The line goes to standard error, so standard output stays JSON."""
    monkeypatch.setattr("curate.geometry.compiled.is_compiled", lambda _kernel: False)
    code, out, err = evaluate(curate, folders, "--json")
    assert (code, err) == (0, "compiling the evaluation code (first use only, some seconds)\n")
    assert json.loads(out)["objects"]["Car"]


def test_a_list_selects_the_frames_to_compare(
    curate: Curate, folders: tuple[Path, Path], tmp_path: Path
) -> None:
    """Labels of a whole dataset, results of its val split."""
    (folders[0] / "000003.txt").write_text(LINE + "\n")
    assert evaluate(curate, folders)[0] == DataError.exit_code
    (tmp_path / "val.txt").write_text("000001\r\n000002\r\n")
    code, out, _ = evaluate(curate, folders, "--frames", tmp_path / "val.txt", "--json")
    assert code == 0
    assert json.loads(out)["objects"]["Car"] == [1, 1, 1]


@pytest.mark.parametrize("content", [b"", b"\xff\x00"])
def test_an_empty_list_of_frames_is_rejected(
    curate: Curate, folders: tuple[Path, Path], tmp_path: Path, content: bytes
) -> None:
    """The one-line error contains the file."""
    (tmp_path / "val.txt").write_bytes(content)
    code, _, err = evaluate(curate, folders, "--frames", tmp_path / "val.txt")
    assert code == DataError.exit_code
    assert "val.txt:" in err
    assert err.count("\n") == 1


def test_a_missing_checkpoint_gives_a_one_line_error(curate: Curate, workspace: Workspace) -> None:
    code, _, err = curate("evaluate", "-w", workspace.root, "--checkpoint", "nowhere")
    assert code == WorkspaceError.exit_code
    assert err == "error: --checkpoint nowhere: no such file\n"


@pytest.mark.parametrize(
    ("file", "text", "place", "message"),
    [
        ("results/000001.txt", LINE, "000001.txt:1", "15 fields"),
        ("results/000001.txt", f"{LINE} 0.5\n{LINE} 0.5 1", "000001.txt:2", "17 fields"),
        ("results/000001.txt", f"{LINE} nan", "000001.txt:1", "'nan' is not a finite number"),
        ("results/000001.txt", f"{LINE} high", "000001.txt:1", "'high' is not a number"),
        (
            "results/000001.txt",
            f"\n{LINE.replace('1.5 1.6', '1.5 -1.6')} 0.5",
            "000001.txt:2",
            "1.5 -1.6 4.0, but must be positive",
        ),
        ("results/000001.txt", f"Ship{LINE[3:]} 0.5", "000001.txt:1", "unknown category 'Ship'"),
        ("label_2/000001.txt", f"{LINE} 0.5 1", "000001.txt:1", "17 fields"),
        ("results/000009.txt", f"{LINE} 0.5", "label_2/000009.txt", "no label file"),
    ],
)
def test_invalid_files_give_a_one_line_error_with_the_position(
    curate: Curate, tmp_path: Path, folders: tuple[Path, Path],
    file: str, text: str, place: str, message: str,
) -> None:  # fmt: skip
    """File, line and reason; nothing on standard output."""
    (tmp_path / file).write_text(text + "\n")
    code, out, err = evaluate(curate, folders)
    assert (code, out) == (DataError.exit_code, "")
    assert place in err
    assert message in err
    assert err.count("\n") == 1


def test_a_missing_result_file_is_not_treated_as_empty(
    curate: Curate, folders: tuple[Path, Path]
) -> None:
    """An incomplete run is not evaluated; the error says what to do."""
    (folders[1] / "000002.txt").unlink()
    code, _, err = evaluate(curate, folders)
    assert code == DataError.exit_code
    assert "results/000002.txt: no result file for frame 000002; write an empty file" in err


@pytest.mark.parametrize("empty", [(0,), (1,), (0, 1)])
def test_without_ground_truth_there_is_no_value_and_without_detections_it_is_zero(
    curate: Curate, folders: tuple[Path, Path], empty: tuple[int, ...]
) -> None:
    """Nothing can be computed without an object: null and "-", not 0; a missed object gives 0."""
    for side in empty:
        (folders[side] / "000001.txt").write_text("")
    code, out, err = evaluate(curate, folders, "--json")
    assert code == 0
    found = json.loads(out, parse_constant=pytest.fail)
    expected = [None if 0 in empty else 0] * 3
    assert found["AP_R40"]["Car"]["3d"] == found["AP_R11"]["Car"]["image"] == expected
    assert found["recall_3d"]["Car"]["0.7"] == expected
    assert found["objects"]["Car"] == [1 - (0 in empty)] * 3
    warned = [("objects", 0), ("results", 1)]
    for side, number in warned:
        sentence = f"There are no {side} of Car, Pedestrian, Cyclist"
        assert (sentence in found["notes"]) == (number in empty)
        assert (f"warning: {sentence}\n" in err) == (number in empty)
    _, out, _ = evaluate(curate, folders)
    row = next(line.split() for line in out.splitlines() if line.startswith("Car         3d"))
    assert row[2:] == (["-"] if 0 in empty else ["0.00"]) * 6


def test_detections_with_equal_scores_are_counted_together(
    curate: Curate, folders: tuple[Path, Path]
) -> None:
    """With a false positive of the same score, the precision is 1/2 in any order."""
    far = LINE.replace("0.0 1.7 20.0", "9.0 1.7 40.0").replace("100 100 180 160", "300 100 380 160")
    answers = []
    for lines in ([LINE, far], [far, LINE]):
        (folders[1] / "000001.txt").write_text("".join(f"{line} 0.5\n" for line in lines))
        answers.append(json.loads(evaluate(curate, folders, "--json")[1]))
    assert answers[0] == answers[1]
    assert answers[0]["AP_R40"]["Car"]["3d"] == [50, 50, 50]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--labels", "label_2"), "--labels and --results go together"),
        (("--results", "results"), "--labels and --results go together"),
        (("--labels", "label_2", "--results", "results", "--store"), "--store needs a workspace"),
        (("--round", "1", "--checkpoint", "x"), "--round or --checkpoint"),
    ],
)
def test_conflicting_options_are_rejected(
    curate: Curate, arguments: tuple[str, ...], message: str
) -> None:
    """Before any file is opened."""
    code, _, err = curate("evaluate", *arguments)
    assert code == ConfigError.exit_code
    assert message in err


def test_without_val_predictions_the_error_contains_the_command(
    curate: Curate, workspace: Workspace
) -> None:
    curate("predict", "-w", workspace.root)
    code, _, err = curate("evaluate", "--round", "1", "-w", workspace.root)
    assert code == WorkspaceError.exit_code
    assert "curate predict --split val --round 1" in err


def test_missed_objects_can_be_queried(curate: Curate, workspace: Workspace) -> None:
    """Found and missed objects of a round's val predictions match the recall.

    A new run replaces them.
    """
    curate("predict", "--split", "val", "-w", workspace.root)
    for _ in range(2):
        code, out, _ = curate("evaluate", "--round", "1", "--store", "-w", workspace.root)
        assert code == 0
    assert "stored as source 'round 1'" in out
    figures = json.loads(curate("evaluate", "--round", "1", "--json", "-w", workspace.root)[1])
    missed = query_rows(curate, workspace, MISSED)
    found = query_rows(curate, workspace, "SELECT * FROM evaluation WHERE outcome = 'tp'")
    objects = [row for row in found if row["side"] == "object"]
    assert not any("without one" in note for note in figures["notes"])
    # The toy labels all have the same 2D box, so that all objects count.
    assert "2D boxes are 0 0 100 39, a placeholder: difficulty" in figures["notes"][0]
    for category, overlap in (("Car", "0.7"), ("Pedestrian", "0.5"), ("Cyclist", "0.5")):
        tp = sum(row["category"] == category for row in objects)
        fn = sum(row["category"] == category for row in missed)
        assert tp + fn == figures["objects"][category][2]
        assert 100 * tp / (tp + fn) == pytest.approx(figures["recall_3d"][category][overlap][2])
    assert missed
    assert objects
    assert all(row["iou"] <= 0.7 for row in missed)
    sql = "SELECT * FROM evaluation_ap WHERE figure = '3d' AND category = 'Cyclist'"
    rows = {row["difficulty"]: row for row in query_rows(curate, workspace, sql)}
    stored = [rows[level]["ap_r40"] for level in figures["difficulties"]]
    assert stored == figures["AP_R40"]["Cyclist"]["3d"]
    assert [value is None for value in stored] == [n == 0 for n in figures["objects"]["Cyclist"]]


def test_outcomes_contain_their_boxes(curate: Curate, workspace: Workspace) -> None:
    """Of ground truth and of predictions; matches refer to each other."""
    curate("predict", "--split", "val", "-w", workspace.root)
    curate("evaluate", "--round", "1", "--store", "-w", workspace.root)
    rows = query_rows(curate, workspace, "SELECT * FROM evaluation")
    truth = workspace.ground_truth("val")
    stored = workspace.predictions(1, list(workspace.frames("val").values()))
    for row in rows:
        own = truth[row["frame"]] if row["side"] == "object" else None
        own = own or stored[workspace.frames("val")[row["frame"]]]
        assert np.allclose([row["x"], row["length"], row["yaw"]], own.boxes[row["k"]][[0, 3, 6]])
        assert row["category"] == own.categories[row["k"]]
        if row["matched_k"] is not None:
            other = {"object": "detection", "detection": "object"}[row["side"]]
            [match] = [
                each
                for each in rows
                if (each["frame"], each["side"], each["k"])
                == (row["frame"], other, row["matched_k"])
            ]
            assert (match["matched_k"], match["iou"]) == (row["k"], row["iou"])


def test_a_checkpoint_is_stored_under_its_path(
    curate: Curate, workspace: Workspace, weights_file: Path
) -> None:
    """Beside the outcomes of the round."""
    curate("predict", "--split", "val", "-w", workspace.root)
    curate("evaluate", "--round", "1", "--store", "-w", workspace.root)
    code, _, err = curate("evaluate", "--store", "-w", workspace.root)
    # The kernels are compiled by whichever test comes first.
    once = "compiling the evaluation code (first use only, some seconds)\n"
    assert (code, err.removeprefix(once)) == (0, "")
    sql = "SELECT source, count(*) AS n FROM evaluation GROUP BY source ORDER BY source"
    rows = query_rows(curate, workspace, sql)
    assert [row["source"] for row in rows] == sorted([str(weights_file), "round 1"])
    assert rows[0]["n"] == rows[1]["n"]


def query_rows(curate: Curate, workspace: Workspace, sql: str) -> list[dict]:
    """Return the rows of a query."""
    return json.loads(curate("query", sql, "--json", "-w", workspace.root)[1])
