"""The command line as a user runs it: output, exit codes, invalid input."""

import csv
import io
import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from support.pipelines_cli import Curate

from curate.errors import ConfigError, DataError, FramesFailed, WorkspaceError
from pipelines.commands.options import open_workspace

LABELS = "SELECT frame, k, weight FROM weighted_labels ORDER BY frame, k"


@pytest.fixture
def made(curate: Curate, tmp_path: Path, toy_kitti: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a toy workspace created by `curate init`; it is the current folder."""
    weights = tmp_path / "detector.txt"
    weights.write_text("")
    folder = tmp_path / "work"
    code, out, err = curate(
        "init", folder, "--root", toy_kitti, "--labeled", "0.25",
        "--detector", "support.toys:ToyDetector", "--detector-path", weights,
        "--segmenter", "support.toys:ToySegmenter", "--segmenter-path", weights,
    )  # fmt: skip
    assert code == 0, err
    assert "2 labeled, 6 unlabeled and 4 val frames" in out
    monkeypatch.chdir(folder)
    return folder


def test_the_stages_run_one_by_one_and_store_the_weights(curate: Curate, made: Path) -> None:
    """Every stage is a command; the last one writes the weights to the exported file."""
    for command in ("predict", "repredict", "score", "solve", "export"):
        code, out, err = curate(command)
        assert (code, err) == (0, ""), command
    with sqlite3.connect(made / "exports" / "labels.sqlite") as file:
        exported = file.execute(LABELS).fetchall()
    code, out, _ = curate("query", LABELS, "--json")
    assert [tuple(row.values()) for row in json.loads(out)] == exported
    assert len(exported) == 18


def test_run_does_all_stages_and_prints_each(curate: Curate, made: Path) -> None:
    """The second run prints that there was nothing to do."""
    code, out, _ = curate("run")
    assert code == 0
    assert [line.split()[2] for line in out.splitlines()] == [
        "predict", "repredict", "points", "semantic", "solve", "export",
    ]  # fmt: skip
    code, out, _ = curate("run", "--json")
    assert {report["done"] for report in json.loads(out)} == {0}


def test_status_shows_every_stage(curate: Curate, made: Path) -> None:
    """Waiting before the run, done after it, stale after a changed setting."""
    curate("predict")
    _, out, _ = curate("status", "--json")
    states = {row["stage"]: row["state"] for row in json.loads(out)}
    assert states["predict"] == "done"
    assert states["repredict"] == states["solve"] == "waiting"
    curate("run")
    path = made / "curate.toml"
    path.write_text(path.read_text().replace('scope = "round"', 'scope = "frame"'))
    _, out, _ = curate("status", "--json")
    states = {row["stage"]: row["state"] for row in json.loads(out)}
    assert states["semantic"] == "done"
    assert states["solve"] == states["export"] == "stale"


def test_a_failed_frame_gives_a_count_and_a_non_zero_exit_code(
    curate: Curate, made: Path, toy_kitti: Path
) -> None:
    """`status --failed` lists it with its error."""
    _, out, _ = curate("query", "SELECT frame FROM frame WHERE split = 'unlabeled'", "--json")
    frame = json.loads(out)[0]["frame"]
    (toy_kitti / "training" / "calib" / f"{frame}.txt").unlink()
    code, out, err = curate("predict")
    assert code == FramesFailed.exit_code
    assert "5 frames done" in out
    assert f"calib/{frame}.txt" in err
    assert "1 frame results failed" in err
    _, out, _ = curate("status", "--failed")
    assert f"calib/{frame}.txt" in out


def test_explain_recomputes_the_weight(curate: Curate, made: Path) -> None:
    """Only from the stored numbers."""
    curate("run")
    _, out, _ = curate(
        "query", "SELECT frame, k, weight FROM weighted_labels ORDER BY weight DESC", "--json"
    )
    best = json.loads(out)[0]
    code, out, _ = curate("explain", best["frame"], best["k"], "--json")
    assert code == 0
    found = json.loads(out)
    assert found["recomputed"] == pytest.approx(best["weight"])
    assert found["lines"][1].startswith("  score          has no known meaning")
    assert found["age"]["lambda_u"] == pytest.approx(found["label"]["lambda_u"])
    evidence = {**found["evidence"], **found["evidence"]["rho"]}
    for name in ("loss", "rho_diff", "rho_anno", "rho_det"):
        assert evidence[name] == pytest.approx(found["label"][name])
    code, out, _ = curate("explain", best["frame"], best["k"])
    assert all(f"Eq. {number}" in out for number in (4, 8, 9, 11))
    assert "they differ" not in out
    with closing(sqlite3.connect(made / "curate.db")) as connection:
        connection.execute("UPDATE weight SET v = v / 2")
        connection.commit()
    assert "they differ" in curate("explain", best["frame"], best["k"])[1]


@pytest.mark.parametrize(
    "sql",
    [
        "DELETE FROM weight",
        "UPDATE frame SET split = 'val'",
        "DROP VIEW weighted_labels",
        "ATTACH '/tmp/other.db' AS other",
        "PRAGMA query_only = OFF",
        "CREATE TABLE x (a)",
        "SELECT 1; SELECT 2",
        "SELECT nonsense FROM nowhere",
        "",
    ],
)
def test_a_query_is_read_only(curate: Curate, made: Path, sql: str) -> None:
    """Anything else is a one-line error."""
    code, out, err = curate("query", sql)
    assert (code, out) == (ConfigError.exit_code, "")
    assert err.startswith("error: query: ")
    assert err.count("\n") == 1


def test_a_query_prints_csv(curate: Curate, made: Path) -> None:
    """With a header."""
    _, out, _ = curate("query", "SELECT frame, split FROM frame ORDER BY 1", "--csv")
    rows = list(csv.reader(io.StringIO(out)))
    assert rows[0] == ["frame", "split"]
    assert len(rows) == 13


def test_outside_a_workspace_the_error_says_what_to_do(
    curate: Curate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line and the exit code of its kind."""
    monkeypatch.chdir(tmp_path)
    code, _, err = curate("status")
    assert code == WorkspaceError.exit_code
    assert "curate init" in err


def test_all_wrong_settings_are_reported_at_once(curate: Curate, made: Path) -> None:
    """A misspelt key and a value out of range."""
    path = made / "curate.toml"
    text = path.read_text().replace("minimum_score = 0.1", "minimum_score = 7.0")
    path.write_text(text.replace("[semantic]", "[semantic]\nmeen = 1"))
    code, _, err = curate("predict")
    assert code == ConfigError.exit_code
    assert "detector.minimum_score" in err
    assert "semantic.meen" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("former", "later", "message"),
    [
        ('priors = ["points", "semantic"]', 'priors = ["pointz"]', "unknown prior 'pointz'"),
        ('priors = ["points", "semantic"]', 'priors = ["points", "points"]', "listed twice"),
        ('categories = ["Car", "Pedestrian", "Cyclist"]', "categories = []", "dataset.categories"),
        ("scale_range = [0.95, 1.05]", "scale_range = [1.2, 0.8]", "lower limit"),
        ("scale_range = [0.95, 1.05]", "scale_range = [1e308, 1e308]", "repredict.scale_range"),
        ("minimum_iou = 0.1", "minimum_iou = 1.0", "repredict.minimum_iou"),
        ("seed = 0", "seed = -1", "run.seed"),
        ("seed = 0", "seed = 99999999999999999999", "run.seed"),
        ('method = "pspsl"', 'method = "nope"', "unknown policy 'nope'"),
        ("[run]", '[run]\ndatabase = "nonsense"', "run.database: not the URL of a database"),
        ("[run]", '[run]\ndatabase = "oracle9://x"', "oracle9"),
    ],
)
def test_an_invalid_setting_is_rejected_before_any_work(
    curate: Curate, made: Path, former: str, later: str, message: str
) -> None:
    """It gives one line, not a failed frame each."""
    path = made / "curate.toml"
    assert former in path.read_text()
    path.write_text(path.read_text().replace(former, later))
    code, out, err = curate("run")
    assert (code, out) == (ConfigError.exit_code, "")
    assert message in err
    assert err.count("\n") == 1


def test_a_policy_option_of_another_type_gives_a_one_line_error(curate: Curate, made: Path) -> None:
    """The option, its value and what it should be, without a traceback."""
    path = made / "curate.toml"
    options = 'options = {threshold = {threshold = "high"}}'
    path.write_text(
        path.read_text().replace("options = {}\n\n[solve.learned]", f"{options}\n\n[solve.learned]")
    )
    curate("run")
    code, _, err = curate("solve", "--policy", "threshold")
    assert code == ConfigError.exit_code
    assert "policy 'threshold': option threshold = \"high\" should be a valid number" in err
    assert err.count("\n") == 1


def test_frames_lost_in_an_earlier_stage_are_not_counted_as_done(
    curate: Curate, made: Path, toy_kitti: Path
) -> None:
    """A later stage does not report a frame that it never got."""
    name = json.loads(
        curate("query", "SELECT frame FROM frame WHERE split='unlabeled'", "--json")[1]
    )
    (toy_kitti / "training" / "calib" / f"{name[0]['frame']}.txt").unlink()
    reports = json.loads(curate("run", "--json")[1])
    assert [report["kept"] for report in reports if report["stage"] == "repredict"] == [0]


def test_status_lists_no_training_for_an_external_detector(curate: Curate, made: Path) -> None:
    """Only a detector that curate trains waits for a training."""
    curate("run")
    states = {row["stage"]: row["state"] for row in json.loads(curate("status", "--json")[1])}
    assert set(states.values()) == {"done"}
    assert not {"pretrain", "train-round"} & set(states)


def test_json_contains_only_valid_json_values(curate: Curate, made: Path) -> None:
    """Infinity is null."""
    _, out, _ = curate("query", "SELECT 1e400 AS far, 2 AS near", "--json")
    assert out.count("null") == 1
    assert json.loads(out) == [{"far": None, "near": 2}]


@pytest.mark.parametrize("option", ["--labeled", "--val"])
def test_a_list_can_contain_a_frame_twice(
    curate: Curate, tmp_path: Path, toy_kitti: Path, option: str
) -> None:
    """It counts once."""
    (tmp_path / "ids.txt").write_text("000001\n000003\n000001\n")
    code, out, err = curate(
        "init", tmp_path / "w", "--root", toy_kitti, option, tmp_path / "ids.txt"
    )
    assert code == 0, err
    assert f"2 {option.removeprefix('--')}" in out


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\x90\xff\x00", "ids.txt:1: not UTF-8 text (byte 0x90); save the file as UTF-8"),
        (b"000099\n", "ids.txt:1: there is no frame '000099'; the nearest are '000009' and"),
        (b"000011\n", "frame 000011 is not among the training frames"),
        (b"000002\n", "000002 has no label file"),
    ],
)
def test_an_invalid_list_of_frames_gives_a_one_line_error(
    curate: Curate, tmp_path: Path, toy_kitti: Path, content: bytes, message: str
) -> None:
    """A binary file, an unknown frame, a frame without a label."""
    (toy_kitti / "training" / "label_2" / "000002.txt").unlink()
    (tmp_path / "ids.txt").write_bytes(content)
    code, _, err = curate(
        "init", tmp_path / "w", "--root", toy_kitti, "--labeled", tmp_path / "ids.txt"
    )
    assert code == ConfigError.exit_code
    assert message in err
    assert err.count("\n") == 1
    assert not (tmp_path / "w").exists()


def test_a_workspace_with_a_killed_init_is_reported(curate: Curate, made: Path) -> None:
    """Settings without frames: the error says what to do, and no empty export is written."""
    for path in made.glob("curate.db*"):
        path.unlink()
    code, out, err = curate("run")
    assert (code, out) == (WorkspaceError.exit_code, "")
    assert "rerun `curate init`" in err
    assert not (made / "exports" / "labels.sqlite").exists()


def test_relative_paths_in_the_settings_start_at_the_workspace(
    curate: Curate, made: Path, toy_kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From any current folder, and after data and workspace have moved together."""
    path = made / "curate.toml"
    path.write_text(path.read_text().replace(f'"{tmp_path}/', '"../'))
    assert 'root = "../' in path.read_text()
    monkeypatch.chdir(toy_kitti)
    assert curate("run", "-w", made)[0] == 0
    (tmp_path / "home").mkdir()
    for name in ("kitti", "detector.txt", "work"):
        (tmp_path / name).rename(tmp_path / "home" / name)
    code, _, err = curate("score", "-w", tmp_path / "home" / "work")
    assert (code, err) == (0, "")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--detector", "nope"), "unknown detector 'nope'"),
        (("--detector", "recorded"), "give --detector-path"),
        (("--detector", "recorded", "--detector-path", "a.csv"), "a.csv: no such file"),
        (("--segmenter", "nope"), "unknown segmenter 'nope'"),
        (("--segmenter", "onnx"), "give --segmenter-path"),
        (("--segmenter", "onnx", "--segmenter-path", "a.onnx"), "a.onnx: no such file"),
    ],
)
def test_a_workspace_is_not_created_with_missing_files(
    curate: Curate, tmp_path: Path, toy_kitti: Path, options: tuple[str, ...], message: str
) -> None:
    """The error comes at once, not hours later in the stage that needs them."""
    code, _, err = curate("init", tmp_path / "w", "--root", toy_kitti, *options)
    assert code == ConfigError.exit_code
    assert message in err
    assert not (tmp_path / "w").exists()


def test_val_frames_without_labels_are_reported_with_a_fix(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """The dataset's own val list may contain frames without labels."""
    (toy_kitti / "training" / "label_2" / "000010.txt").unlink()
    code, _, err = curate("init", tmp_path / "w", "--root", toy_kitti, "--labeled", "0.25")
    assert code == ConfigError.exit_code
    assert "val frame 000010 has no label file; give --val 0" in err


def test_a_workspace_can_be_in_a_folder_of_any_name(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """Special characters of URLs and TOML are allowed."""
    folder = tmp_path / 'a "b" ü %41?c=d#e'
    assert curate("init", folder, "--root", toy_kitti, "--labeled", "0.25")[0] == 0
    code, out, err = curate("query", "SELECT count(*) FROM frame", "--csv", "-w", folder)
    assert (code, out.split()[-1], err) == (0, "12", "")
    assert (folder / "curate.db").is_file()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("Car 0.00 0 1.0 1 2 3 4", "label_2"),
        ("Spaceship 0 0 0 1 2 3 4 1 1 1 1 1 9 0", "Spaceship"),
    ],
)
def test_a_damaged_label_of_a_val_frame_stops_init(
    curate: Curate, tmp_path: Path, toy_kitti: Path, line: str, message: str
) -> None:
    """The error contains file and line, and no incomplete workspace is left."""
    path = toy_kitti / "training" / "label_2" / "000010.txt"
    path.write_text(path.read_text() + line + "\n")
    code, _, err = curate("init", tmp_path / "w", "--root", toy_kitti)
    assert code == DataError.exit_code
    assert "000010.txt:4" in err
    assert message in err
    assert not (tmp_path / "w").exists()


def test_the_label_of_an_unlabeled_frame_is_never_opened(
    curate: Curate, made: Path, toy_kitti: Path
) -> None:
    """Invalid content in it causes no error."""
    _, out, _ = curate("query", "SELECT frame FROM frame WHERE split = 'unlabeled'", "--json")
    for row in json.loads(out):
        path = toy_kitti / "training" / "label_2" / f"{row['frame']}.txt"
        path.unlink()
        path.mkdir()
    code, _, err = curate("run")
    assert (code, err) == (0, "")


def test_init_again_keeps_the_workspace_and_rejects_another_split(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """The same call is harmless; another share would mix the splits."""
    arguments = ("init", tmp_path / "w", "--root", toy_kitti, "--labeled")
    assert curate(*arguments, "0.25")[0] == 0
    assert curate(*arguments, "0.25")[0] == 0
    code, _, err = curate(*arguments, "0.5")
    assert code == WorkspaceError.exit_code
    assert "another split" in err


def test_a_category_without_ground_truth_uses_the_fallback_with_a_warning(
    curate: Curate, made: Path, toy_kitti: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The configured number of points replaces m_th."""
    for path in (toy_kitti / "training" / "label_2").glob("*.txt"):
        lines = [line for line in path.read_text().splitlines() if "Cyclist" not in line]
        path.write_text("\n".join(lines) + "\n")
    weights = tmp_path / "detector.txt"
    folder = tmp_path / "fewer"
    curate(
        "init", folder, "--root", toy_kitti, "--labeled", "0.25",
        "--detector", "support.toys:ToyDetector", "--detector-path", weights,
    )  # fmt: skip
    code, _, _ = curate("run", "-w", folder)
    assert code == 0
    assert "no ground truth of Cyclist" in caplog.text
    sql = "SELECT DISTINCT points_threshold FROM weighted_labels WHERE category = 'Cyclist'"
    _, out, _ = curate("query", sql, "--json", "-w", folder)
    assert json.loads(out) == [{"points_threshold": 5.0}]


@pytest.mark.parametrize(
    ("configured", "workers", "used"),
    [
        ("auto", 4, "process"),
        ("auto", "auto", "auto"),
        ("serial", 4, "process"),
        ("process", 1, "serial"),
        ("process", "auto", "auto"),
        ("ray", 4, "ray"),
        ("ray", 1, "ray"),
    ],
)
def test_workers_choose_an_executor_unless_a_cluster_is_configured(
    made: Path, configured: str, workers: int | str, used: str
) -> None:
    """On one machine, more than one worker are processes; a configured cluster is kept."""
    path = made / "curate.toml"
    path.write_text(path.read_text().replace('executor = "auto"', f'executor = "{configured}"'))
    run = open_workspace(made, workers=workers).config.run
    assert (run.executor, run.workers) == (used, workers)
