"""Invalid input on the command line: each case gives one clear line, or just works."""

import os
import pickle
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fatal_files import write_aborting_parquet
from support.pipelines_cli import Curate
from support.rounds import run_workspace

from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import ConfigError, CurateError, DataError
from pipelines.assembly import SHIPPED_SEGMENTER
from pipelines.workspace.workspace import Workspace

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def write_results(path: Path, root: Path, **changes) -> Path:
    """Write OpenPCDet results equal to the ground truth, or with changed keys."""
    dataset, entries = KittiDataset(root), []
    for name in dataset.frame_ids():
        truth = dataset.annotations(name)
        entry = {
            "frame_id": name,
            "name": truth.categories,
            "boxes_lidar": truth.boxes,
            "score": np.full(len(truth.boxes), 0.9),
        }
        entries.append(entry | {key: change(entry[key]) for key, change in changes.items()})
    path.write_bytes(pickle.dumps(entries))
    return path


def begin(curate: Curate, work: Path, root: Path, results: Path) -> tuple[int, str, str]:
    """Create a workspace with recorded results, and predict."""
    code, _, err = curate(
        "init", work, "--root", root, "--labeled", "0.25",
        "--detector", "recorded", "--detector-path", results,
    )  # fmt: skip
    assert code == 0, err
    return curate("predict", "-w", work)


def test_class_names_in_lower_case_stop_predict_with_a_fix(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """There would be no label at all; the older place of the setting works too."""
    results = write_results(tmp_path / "a.pkl", toy_kitti)
    work = tmp_path / "w"
    assert begin(curate, work, toy_kitti, results)[0] == 0
    write_results(results, toy_kitti, name=np.char.lower)
    code, _, err = curate("predict", "-w", work)
    assert code == ConfigError.exit_code
    assert "have car, cyclist, pedestrian, but dataset.categories are Car, Ped" in err
    assert re.search(r"detector\.(rename=)\{", err) is not None
    toml = work / "curate.toml"
    table = 'options = {rename = {car = "Car", pedestrian = "Pedestrian", cyclist = "Cyclist"}}'
    head, section, rest = toml.read_text().partition("[detector]")
    toml.write_text(head + section + rest.replace("options = {}", table, 1))
    code, out, err = curate("predict", "-w", work)
    assert code == 0, err
    assert "18 rows" in out


def test_unknown_names_are_dropped_and_reported_once(
    curate: Curate, tmp_path: Path, toy_kitti: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """By init and by predict; the other boxes stay."""
    # A name that no other test of this process has used.
    results = write_results(
        tmp_path / "a.pkl", toy_kitti, name=lambda names: np.char.replace(names, "Cyclist", "Moped")
    )
    code, out, _ = begin(curate, tmp_path / "w", toy_kitti, results)
    assert code == 0
    assert "12 rows" in out
    warned = [message for message in caplog.messages if "have Moped, which" in message]
    assert len(warned) == 2
    assert "dataset.categories" in warned[0]


def test_results_for_other_frames_end_the_command(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """No recorded frame exists: the error shows how the dataset names its frames."""
    results = write_results(tmp_path / "a.pkl", toy_kitti, frame_id=lambda name: f"drive_{name}")
    code, _, err = begin(curate, tmp_path / "w", toy_kitti, results)
    assert code == DataError.exit_code
    assert "results for frames that do not exist (drive_000000" in err
    assert "the nearest are '000000' and" in err
    assert "Traceback" not in err


def test_camera_boxes_read_as_lidar_boxes_are_detected(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """Axes right, down, forward: no box contains points, and doctor fails."""
    results = write_results(
        tmp_path / "a.pkl",
        toy_kitti,
        boxes_lidar=lambda boxes: np.column_stack([-boxes[:, 1], -boxes[:, 2], boxes[:, 0],
                                                   boxes[:, 3:]]),
    )  # fmt: skip
    begin(curate, tmp_path / "w", toy_kitti, results)
    code, out, _ = curate("doctor", "-w", tmp_path / "w")
    assert code == 1
    assert re.search(r"^wrong +boxes", out, re.MULTILINE)


def test_a_pickle_with_code_does_not_run_it(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """The pickle is armed: with pickle.load it creates the folder."""
    results, pwned = tmp_path / "a.pkl", tmp_path / "pwned"
    results.write_bytes(b"cos\nmkdir\n(V" + str(pwned).encode() + b"\ntR.")
    code, _, err = begin(curate, tmp_path / "w", toy_kitti, results)
    assert code == DataError.exit_code
    assert "rejected: the pickle imports os.mkdir" in err
    assert not pwned.exists()
    pickle.loads(results.read_bytes())
    assert pwned.exists()


@pytest.mark.parametrize("executor", ["serial", "process"])
def test_a_record_that_makes_pyarrow_abort_ends_the_command_in_one_line(
    curate: Curate, tmp_path: Path, toy_kitti: Path, executor: str
) -> None:
    """Case 24: the process ended with SIGABRT. The exit code is that of a data error."""
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    record = tmp_path / "damaged.parquet"
    write_aborting_parquet(record)
    arguments = ("--root", toy_kitti, "--detector", "recorded", "--detector-path", record)
    code, _, err = curate("init", tmp_path / "w", *arguments, "--set", f"run.executor={executor}")
    if code == 0:  # init need not open the record
        code, _, err = curate("predict", "-w", tmp_path / "w")
    assert code == DataError.exit_code
    [line] = err.strip().splitlines()[-1:]
    assert f"{record}: damaged: pyarrow ends the process (SIGABRT" in line


def test_a_record_is_read_by_the_workers_of_a_read_only_folder(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """A valid Parquet record, several processes, nothing written beside it."""
    arrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    dataset, rows = KittiDataset(toy_kitti), []
    for name in dataset.frame_ids():
        truth = dataset.annotations(name)
        rows += [
            (name, category, 0.9, *box)
            for category, box in zip(truth.categories.tolist(), truth.boxes.tolist(), strict=True)
        ]
    names = ("frame", "category", "score", "x", "y", "z", "length", "width", "height", "yaw")
    folder = tmp_path / "results"
    folder.mkdir()
    table = arrow.table(dict(zip(names, map(list, zip(*rows, strict=True)), strict=True)))
    parquet.write_table(table, folder / "a.parquet")
    folder.chmod(0o500)
    code, _, err = curate(
        "init", tmp_path / "w", "--root", toy_kitti, "--labeled", "0.25", "--detector", "recorded",
        "--detector-path", folder / "a.parquet",
        "--set", "run.executor=process", "--set", "run.workers=2",
    )  # fmt: skip
    assert code == 0, err
    code, _, err = curate("predict", "-w", tmp_path / "w")
    assert code == 0, err
    assert [path.name for path in folder.iterdir()] == ["a.parquet"]
    folder.chmod(0o700)


def test_sql_that_writes_does_not_change_the_database(curate: Curate, workspace: Workspace) -> None:
    """Compared byte by byte, for several statements."""
    assert curate("predict", "-w", workspace.root)[0] == 0
    path = workspace.root / "curate.db"
    before = path.read_bytes()
    for sql in (
        "DELETE FROM prediction",
        "WITH x AS (SELECT 1) UPDATE frame SET split = 'val'",
        "PRAGMA journal_mode = DELETE",
        f"VACUUM INTO '{workspace.root / 'copy.db'}'",
        f"ATTACH '{workspace.root / 'other.db'}' AS other",
    ):
        code, _, err = curate("query", sql, "-w", workspace.root)
        assert code == ConfigError.exit_code, sql
        assert err.count("\n") == 1
    assert path.read_bytes() == before
    assert not list(workspace.root.glob("*o*.db"))


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_a_report_needs_no_network(curate: Curate, workspace: Workspace, tmp_path: Path) -> None:
    """In a browser without any connection, all images are shown and nothing was requested."""
    for command in ("predict", "repredict", "score", "solve"):
        assert curate(command, "-w", workspace.root)[0] == 0
    _, out, _ = curate("report", "-w", workspace.root)
    text = Path(out.removeprefix("report: ").strip()).read_text()
    # The page runs no script; the copy gets one that stores the rendered state.
    page = tmp_path / "report.html"
    page.write_text(
        text + "<script>addEventListener('load', () => {"
        "const shown = [...document.images].filter(i => i.complete && i.naturalWidth > 0);"
        "const asked = performance.getEntriesByType('resource').map(e => e.name)"
        ".filter(name => !name.startsWith('data:'));"
        "document.title = `shown ${shown.length}/${document.images.length} asked ${asked.length}`"
        "})</script>"
    )
    ended = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--proxy-server=127.0.0.1:9",
         f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=10000",
         "--dump-dom", page.as_uri()],
        capture_output=True, text=True, check=False, timeout=300,
        env=os.environ | {"HOME": str(tmp_path)},
    )  # fmt: skip
    title = re.search(r"<title>shown (\d+)/(\d+) asked (\d+)</title>", ended.stdout)
    assert title is not None, ended.stderr
    shown, images, requested = map(int, title.groups())
    assert shown == images > 0
    assert requested == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"name": "onnx", "path": None}, "segmenter 'onnx' needs a path"),
        ({"name": "none"}, "segmenter.name is 'none', and the semantic prior needs"),
        (
            {"name": "onnx", "path": "gone.onnx", "classes": "voc"},
            r"^segmenter\.path: .*gone\.onnx",
        ),
        (
            {"name": "onnx", "path": SHIPPED_SEGMENTER, "classes": None},
            "class ids is not configured",
        ),
        (
            {"name": "saved", "path": "gone", "classes": "voc"},
            r"^segmenter\.path: .*no such folder of semantic maps",
        ),
    ],
)
def test_a_wrong_segmenter_is_reported_before_any_work(
    workspace: Workspace, settings: dict[str, Any], message: str
) -> None:
    """Not after hours of predictions; without the semantic prior it is not needed."""
    wrong = workspace.with_settings("segmenter", **settings)
    with pytest.raises(CurateError, match=message):
        run_workspace(wrong, 1)
    points_alone = wrong.with_settings("run", priors=("points",))
    assert run_workspace(points_alone, 1)[0].done
