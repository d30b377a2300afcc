"""Result files of an external detector without a second pass, and the steps of a new user."""

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from support.pipelines_cli import Curate

from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.labels import from_detections, write_objects
from curate.detections import Detections
from curate.errors import ConfigError


@pytest.fixture
def results(tmp_path: Path, toy_kitti: Path) -> Path:
    """Return KITTI result files of a detector that finds all objects, with a score of 0.9."""
    dataset = KittiDataset(toy_kitti)
    folder = tmp_path / "results"
    folder.mkdir()
    for name in dataset.frame_ids():
        frame, truth = dataset.read(name), dataset.annotations(name)
        # A centimetre off: exact copies of the labels would be reported as a leak.
        beside = np.add(truth.boxes, [0.01, 0, 0, 0, 0, 0, 0])
        found = Detections(beside, truth.alpha + 0.9, truth.categories)
        objects = from_detections(found, frame.calibration, frame.image_size)
        write_objects(folder / f"{name}.txt", objects)
    return folder


def begin(curate: Curate, work: Path, root: Path, results: Path, *more: object) -> None:
    """Create a workspace over the result files."""
    code, _, err = curate(
        "init", work, "--root", root, "--labeled", "0.25",
        "--detector", "recorded", "--detector-path", results, *more,
    )  # fmt: skip
    assert code == 0, err


def test_without_a_second_pass_labels_are_kept_with_weight_0(
    curate: Curate, tmp_path: Path, toy_kitti: Path, results: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Without evidence the weight is 0, and no label is lost; doctor says what to do."""
    work = tmp_path / "work"
    begin(curate, work, toy_kitti, results)
    code, out, _ = curate("doctor", "-w", work)
    assert code == 0
    assert "solve.self_paced = false" in out
    code, out, err = curate("run", "-w", work)
    assert code == 0, err
    assert "18 labels, 0 with weight > 0" in out
    assert "no second pass" in caplog.text
    sql = "SELECT count(*) AS n, count(loss) AS losses, sum(weight) AS v FROM weighted_labels"
    [row] = json.loads(curate("query", sql, "--json", "-w", work)[1])
    assert row == {"n": 18, "losses": 0, "v": 0.0}


def test_a_setting_uses_only_the_priors_as_weight(
    curate: Curate, tmp_path: Path, toy_kitti: Path, results: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Every label has weight rho_det, and explain recomputes it."""
    work = tmp_path / "work"
    begin(curate, work, toy_kitti, results, "--set", "solve.self_paced=false")
    assert "the weights come from the priors only" in curate("doctor", "-w", work)[1]
    code, _, err = curate("run", "-w", work)
    assert code == 0, err
    assert "no second pass" not in caplog.text
    sql = "SELECT frame, k, rho_det, weight FROM weighted_labels ORDER BY weight DESC"
    rows = json.loads(curate("query", sql, "--json", "-w", work)[1])
    assert len(rows) == 18
    assert all(row["weight"] == row["rho_det"] > 0 for row in rows)
    code, out, _ = curate("explain", rows[0]["frame"], rows[0]["k"], "-w", work)
    assert code == 0
    assert "no second pass over augmented copies" in out
    assert f"recomputed     {rows[0]['weight']:.4f}" in out
    assert "differ" not in out
    assert curate("report", "-w", work)[0] == 0
    page = (work / "reports" / "round-01-pspsl.html").read_text()
    assert "no second pass" in page
    assert "no reprediction matched it" not in page


def test_result_files_can_be_taught_by_result_files(
    curate: Curate, tmp_path: Path, toy_kitti: Path, results: Path
) -> None:
    """The command writes the next detector's files.

    After a new training they replace the old ones.
    """
    work = tmp_path / "work"
    begin(curate, work, toy_kitti, results, "--set", "solve.self_paced=false")
    assert curate("run", "-w", work)[0] == 0
    for moved in ("surer", "surest"):
        code = (
            "import os, pathlib; output = pathlib.Path(os.environ['CURATE_OUTPUT']);"
            "output.mkdir(exist_ok=True); teacher = pathlib.Path(os.environ['CURATE_TEACHER']);"
            "[(output / path.name).write_text(path.read_text().replace('0.9', '0.95'))"
            f" for path in teacher.iterdir()]; (output / '{moved}').write_text('yes')"
        )
        command = shlex.join([sys.executable, "-c", code])
        ended, _, err = curate(
            "train-round", "--round", 1, "--command", command, "--workspace", work
        )
        assert ended == 0, err
    student = work / "checkpoints" / "round-01-pspsl"
    assert len(list(student.glob("*.txt"))) == len(list(results.iterdir()))
    assert [path.name for path in student.iterdir() if not path.suffix] == ["surest"]
    ended, _, err = curate("run", "--rounds", 2, "-w", work)
    assert ended == 0, err
    assert "train-round up to date" in curate("run", "--rounds", 1, "-w", work)[1]
    sql = "SELECT round, avg(score) AS score FROM weighted_labels GROUP BY round"
    rows = json.loads(curate("query", sql, "--json", "-w", work)[1])
    assert [row["round"] for row in rows] == [1, 2]
    assert rows[0]["score"] < rows[1]["score"]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("self_paced=false", "write section.key=value"),
        ("solve.self_paced", "write section.key=value"),
        ("solve.self_paced=perhaps", "solve.self_paced"),
        ("solve.selfpaced=true", "solve.selfpaced"),
        ("run.seed.first=3", "run.seed"),
    ],
)
def test_a_wrong_setting_is_rejected(
    curate: Curate, tmp_path: Path, toy_kitti: Path, setting: str, message: str
) -> None:
    """Before a workspace is created."""
    code, _, err = curate("init", tmp_path / "w", "--root", toy_kitti, "--set", setting)
    assert code == ConfigError.exit_code
    assert message in err
    assert err.count("\n") == 1
    assert not (tmp_path / "w").exists()


def test_the_class_numbers_of_a_segmenter_must_be_specified(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """By name or as a table; a guess could use the wrong pixels."""
    (tmp_path / "maps").mkdir()
    words = [
        "--root", toy_kitti, "--labeled", "0.25",
        "--segmenter", "saved", "--segmenter-path", tmp_path / "maps",
    ]  # fmt: skip
    code, _, err = curate("init", tmp_path / "w", *words)
    assert code == ConfigError.exit_code
    assert "--segmenter-classes) to one of voc, cityscapes, cityscapes-label-ids, coco" in err
    code, _, err = curate("init", tmp_path / "w", *words, "--segmenter-classes", "ade")
    assert code == ConfigError.exit_code
    assert "unknown class set 'ade'" in err
    table = "segmenter.options.classes={Car=[13], Pedestrian=[11], Cyclist=[18]}"
    code, _, err = curate("init", tmp_path / "w", *words, "--set", table)
    assert code == 0, err
    code, out, _ = curate("doctor", "-w", tmp_path / "w")
    assert "000" in out


def test_frames_without_a_result_are_reported_before_work_starts(
    curate: Curate, tmp_path: Path, toy_kitti: Path, results: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """At init and by doctor; labeled frames need no result."""
    work = tmp_path / "work"
    begin(curate, work, toy_kitti, results)
    assert "no results for" not in caplog.text
    rows = json.loads(curate("query", "SELECT frame, split FROM frame", "--json", "-w", work)[1])
    by_split: dict[str, list[str]] = {}
    for row in rows:
        by_split.setdefault(row["split"], []).append(row["frame"])
    for names in by_split.values():
        (results / f"{names[0]}.txt").unlink()
    begin(curate, tmp_path / "other", toy_kitti, results)
    expected = (
        f"no results for 1 of {len(by_split['unlabeled'])} unlabeled frames "
        f"({by_split['unlabeled'][0]}) and 1 of {len(by_split['val'])} val frames"
    )
    assert expected in caplog.text
    _, out, _ = curate("doctor", by_split["unlabeled"][1], "-w", tmp_path / "other")
    assert "suspect  results" in out


def test_results_without_a_box_are_reported_at_init(
    curate: Curate, tmp_path: Path, toy_kitti: Path, results: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for path in results.iterdir():
        path.write_text("")
    begin(curate, tmp_path / "work", toy_kitti, results)
    assert f"the results {results} have no boxes: every frame will be empty" in caplog.text


def test_lines_without_alpha_are_named_when_aos_is_missing(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """Ground truth against itself, with a score after each line, DontCare regions included."""
    labels, copies = toy_kitti / "training" / "label_2", tmp_path / "copies"
    copies.mkdir()
    region = "DontCare -1 -1 -10 1 1 9 9 -1 -1 -1 -1000 -1000 -1000 -10"
    for path in labels.iterdir():
        lines = [*path.read_text().splitlines(), region]
        (copies / path.name).write_text("".join(f"{line} 1\n" for line in lines))
    code, out, err = curate("evaluate", "--labels", labels, "--results", copies)
    assert code == 0, err
    assert "results have alpha -10, unknown (DontCare)" in out
