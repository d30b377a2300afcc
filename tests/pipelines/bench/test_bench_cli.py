"""`curate bench`: a grid that is killed and resumed, and invalid input."""

import json
import os
import sqlite3
import subprocess
import sys
import time
from io import StringIO
from pathlib import Path

import pytest
from support.bench_results import make_bench, synthetic_result
from support.paths import ROOT
from support.pipelines_cli import Curate

from curate.errors import CellsFailed, ConfigError, DataError, WorkspaceError
from pipelines.bench.cell import run_job
from pipelines.bench.grid import Job, jobs
from pipelines.bench.metered import Metered
from pipelines.bench.results import JobResult, read_result, write_result
from pipelines.bench.settings import Bench, claim, read_bench
from pipelines.engine.plan import Plan
from pipelines.engine.stage import RoundContext, Teacher
from pipelines.round import graph_of
from pipelines.stages.methods import METHODS
from pipelines.workspace.setup import initialise

GIVE_UP_S = 3600
# Two rounds of few steps, snapshots for the kill, and a low score so that there are labels.
OPTIONS = (
    *("--methods", "baseline,pspsl", "--ratios", "0.25", "--seeds", "3"),
    *("--steps", "3", "--rounds", "2", "--workers", "1"),
    *("--set", "train.options.snapshot_seconds=0.01", "--set", "detector.minimum_score=0.02"),
)


def start(folder: Path, *options: object) -> subprocess.Popen:
    """Start `curate bench` as a new process."""
    command = [sys.executable, "-m", "pipelines", "bench", str(folder), *map(str, options)]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def wait_for(what, process: subprocess.Popen) -> None:
    """Wait until a condition holds; fail if the process ends before."""
    until = time.monotonic() + GIVE_UP_S
    while not what():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.005)


def figures(result: JobResult) -> dict:
    """Return all of a result but its times."""
    return result.model_dump(exclude={"seconds", "resumed", "timings"})


def weights(root: Path, job: Job) -> list[tuple]:
    """Return a cell's rows of `weight`."""
    with sqlite3.connect(job.folder(root) / "curate.db") as database:
        return database.execute("SELECT * FROM weight ORDER BY 1, 2, 3, 4").fetchall()


def first_round(root: Path, job: Job) -> list[tuple]:
    """Return the rows of the shared work in a cell, with the times of its tasks."""
    folder = job.folder(root)
    written = (folder / "checkpoints" / "round-00.safetensors").stat().st_mtime_ns
    query = (
        "SELECT stage, frame_id, fingerprint, seconds FROM task "
        "WHERE round < 2 AND stage NOT IN ('solve', 'export', 'train-round') ORDER BY 1, 2"
    )
    with sqlite3.connect(folder / "curate.db") as database:
        return [(written,), *database.execute(query)]


def test_a_killed_grid_resumes_and_ends_like_an_uninterrupted_one(
    toy_kitti: Path, tmp_path: Path
) -> None:
    """SIGKILL while a cell trains: its process ends too, and finished work is kept."""
    (toy_kitti / "simulation.json").write_text("{}")  # so that its labels are evaluated
    folder = tmp_path / "killed"
    process = start(folder, "--data", toy_kitti, *OPTIONS)
    wait_for(lambda: list(folder.glob("cells/*/checkpoints/.*.training")), process)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    tree = [int(child) for child in children.read_text().split()] if children.exists() else []
    process.kill()
    process.communicate()
    until = time.monotonic() + GIVE_UP_S
    while any(Path(f"/proc/{child}").exists() for child in tree):
        assert time.monotonic() < until
        time.sleep(0.01)
    shared = Job(0.25, 3)
    before = shared.result(folder).stat().st_mtime_ns

    ended = start(folder)  # the folder has stored its options
    out, err = ended.communicate(timeout=GIVE_UP_S)
    assert ended.returncode == 0, err.decode()
    assert shared.result(folder).stat().st_mtime_ns == before
    assert "teacher" in out.decode()
    assert (folder / "results.md").is_file()

    whole = run_serially(tmp_path / "whole", folder)
    for job in jobs(whole.axes):
        assert figures(read_result(folder, job)) == figures(read_result(whole.root, job))
    assert weights(folder, Job(0.25, 3, "pspsl")) == weights(whole.root, Job(0.25, 3, "pspsl"))
    assert any(read_result(folder, job).resumed for job in jobs(whole.axes))
    for method in whole.axes.methods:
        assert first_round(folder, Job(0.25, 3, method)) == first_round(folder, shared)
        labels = read_result(folder, Job(0.25, 3, method)).labels
        assert [each.round for each in labels] == [1, 2]
    looked = {method: later_frames(folder, Job(0.25, 3, method)) for method in whole.axes.methods}
    assert looked["baseline"] == 0 < looked["pspsl"]


def later_frames(root: Path, job: Job) -> int:
    """Return how many frames a cell has predicted in its own rounds."""
    with sqlite3.connect(job.folder(root) / "curate.db") as database:
        query = "SELECT count(*) FROM task WHERE stage = 'predict' AND round > 1"
        return database.execute(query).fetchone()[0]


def run_serially(root: Path, like: Path) -> Bench:
    """Run the same bench, job after job, in this process."""
    stored = read_bench(like)
    assert stored is not None
    bench = Bench(root, stored.settings, stored.axes)
    for job in jobs(bench.axes):
        run_job(bench, job, Metered(StringIO()))
    return bench


def test_methods_share_the_teacher_and_its_evidence(toy_kitti: Path, tmp_path: Path) -> None:
    """No method's settings make the shared work stale."""
    bench = make_bench(tmp_path, toy_kitti)
    workspace = initialise(tmp_path / "work", bench.config(0), "0.25", "")
    teacher = Teacher(workspace.root / "curate.toml", "0" * 64)
    context, graph = RoundContext(1, 2, 0, teacher), graph_of(workspace)
    stages = ("predict", "repredict", "points")
    prints = {}
    for method in METHODS:
        config = bench.config(0, method)
        under = type(workspace)(workspace.root, config, workspace.database)
        found = Plan(under, context, graph).fingerprints(METHODS[method].policy)
        prints[method] = [found[stage] for stage in stages]
    assert len({tuple(each) for each in prints.values()}) == 1, prints


def test_a_report_of_finished_jobs_runs_nothing(
    curate: Curate, toy_kitti: Path, tmp_path: Path
) -> None:
    """Tables on the terminal, the same as JSON; a folder without a bench is rejected."""
    code, _, err = curate("bench", tmp_path / "none", "--report")
    assert (code, err.count("\n")) == (WorkspaceError.exit_code, 1)
    bench = make_bench(tmp_path, toy_kitti)
    code, out, err = curate("bench", tmp_path, "--report")
    assert (code, out, err) == (0, "", "no cell is finished yet\n")
    for method, car in (("baseline", 40.0), ("pspsl", 58.0)):
        write_result(bench.root, synthetic_result(Job(0.25, 0, method), car))
    code, out, _ = curate("bench", tmp_path, "--report")
    assert code == 0
    assert "+6.0" in out
    assert "IoU 0.5/0.25/0.25" not in out
    _, out, _ = curate("bench", tmp_path, "--report", "--overlaps", "loose")
    assert "IoU 0.5/0.25/0.25" in out
    _, out, _ = curate("bench", tmp_path, "--report", "--json")
    assert len(json.loads(out)["jobs"]) == 2
    assert not (tmp_path / "shared").exists()


def test_changed_settings_are_rejected_in_one_line(
    curate: Curate, toy_kitti: Path, tmp_path: Path
) -> None:
    """The folder is not changed."""
    make_bench(tmp_path / "bench", toy_kitti)
    before = (tmp_path / "bench" / "bench.json").read_bytes()
    for options in (("--steps", 5), ("--set", "train.batch_size=4"), ("--rounds", 2)):
        code, _, err = curate("bench", tmp_path / "bench", *options)
        assert code == WorkspaceError.exit_code
        assert "contains a bench with" in err
        assert err.count("\n") == 1
    assert (tmp_path / "bench" / "bench.json").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--methods", "all"), "--methods all"),
        (("--ratios", "few"), "--ratios few"),
        (("--set", "train.nothing=1"), "train.nothing"),
        (("--data", "nowhere"), "no such folder"),
        (("--frames", "10"), "--frames: only for simulated data"),
        (("--overlaps", "strict"), "--overlaps strict"),
    ],
)
def test_wrong_options_are_rejected_before_the_bench_is_created(
    curate: Curate, toy_kitti: Path, tmp_path: Path, options: tuple, message: str
) -> None:
    code, out, err = curate("bench", tmp_path / "bench", "--data", toy_kitti, *options)
    assert code == ConfigError.exit_code
    assert message in err
    assert (out, err.count("\n")) == ("", 1)
    assert not (tmp_path / "bench").exists()


def test_a_folder_without_val_frames_is_rejected(
    curate: Curate, toy_kitti: Path, tmp_path: Path
) -> None:
    """Before any cell starts."""
    (toy_kitti / "ImageSets" / "val.txt").write_text("")
    code, _, err = curate("bench", tmp_path / "bench", "--data", toy_kitti)
    assert code == DataError.exit_code
    assert "ImageSets/val.txt is missing or empty" in err


def test_a_failed_cell_has_its_own_exit_code(
    curate: Curate, toy_kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other cells are still reported."""
    from support.bench_results import ToyJobs

    def jobs_of(root: Path) -> ToyJobs:
        return ToyJobs(root, lambda job: "no memory" if job.method == "pspsl" else None)

    monkeypatch.setattr("pipelines.bench.processes.JobProcesses", jobs_of)
    code, out, err = curate("bench", tmp_path / "bench", "--data", toy_kitti, *OPTIONS)
    assert code == CellsFailed.exit_code
    assert "pspsl: failed: no memory" in out
    assert "minutes per cell" in out
    assert "1 of 2 cells failed" in err


def test_the_command_of_a_single_cell_is_hidden(curate: Curate) -> None:
    """Only the grid uses it."""
    code, out, _ = curate("--help")
    assert code == 0
    assert " bench " in out
    assert "bench-cell" not in out


def test_a_preset_is_a_detector_of_a_bench(
    toy_kitti: Path, tmp_path: Path, curate: Curate, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wrong name is rejected before anything is simulated."""
    code, _, err = curate("bench", tmp_path / "wrong", "--detector", "voxel-rcn")
    assert code == 2
    assert "unknown detector 'voxel-rcn'" in err
    assert not (tmp_path / "wrong").exists()
    monkeypatch.setattr("pipelines.commands.bench._run", lambda bench, *_, **__: claim(bench))
    options = (
        "--data",
        toy_kitti,
        "--detector",
        "voxel-rcnn-small",
        "--set",
        "detector.minimum_score=0.02",
    )
    code, _, err = curate("bench", tmp_path / "bench", *options)
    assert code == 0, err
    bench = read_bench(tmp_path / "bench")
    assert bench is not None
    config = bench.config(0)
    assert (config.detector.name, config.train.preset) == ("openpcdet", "voxel-rcnn-small")
    assert config.detector.minimum_score == 0.02
