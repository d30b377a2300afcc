"""`--dry-run`: what would be done, why, at what cost; nothing is changed."""

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from support.pipelines_cli import Curate, with_option

from curate.errors import WorkspaceError
from pipelines.engine.rounds import find_teacher
from pipelines.workspace.workspace import Workspace

STAGES = ("predict", "repredict", "points", "semantic", "solve", "export")


@pytest.fixture
def made(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a toy workspace; it is the current folder."""
    monkeypatch.chdir(workspace.root)
    return workspace.root


@pytest.fixture
def dry(curate: Curate) -> Callable[..., dict[str, dict]]:
    """Return a function that returns what would be done, by stage."""

    def run(*arguments: object) -> dict[str, dict]:
        code, out, err = curate(*arguments, "--dry-run", "--json")
        assert (code, err) == (0, "")
        return {each["stage"]: each for each in json.loads(out)["stages"]}

    return run


def change(root: Path, former: str, later: str) -> None:
    """Change a setting."""
    path = root / "curate.toml"
    assert former in path.read_text()
    path.write_text(path.read_text().replace(former, later))


def contents(root: Path) -> tuple[list[str], dict[Path, bytes]]:
    """Return all rows of the database, and all other files."""
    with closing(sqlite3.connect(root / "curate.db")) as connection:
        rows = list(connection.iterdump())
    files = (path for path in root.rglob("*") if path.is_file() and "curate.db" not in path.name)
    return rows, {path: path.read_bytes() for path in files}


def test_every_stage_command_has_the_option() -> None:
    """Every stage is listed."""
    stages = {
        "pretrain", "segment", "predict", "repredict", "score", "calibrate", "solve", "export",
        "train-round", "run",
    }  # fmt: skip
    assert with_option("--dry-run") == stages | {"augment", "review import"}


def test_a_new_workspace_would_run_everything(made: Path, dry: Callable) -> None:
    """On all unlabeled frames; the first ones are listed, the cost is unknown."""
    found = dry("run")
    assert tuple(found) == STAGES
    for stage in STAGES[:4]:
        assert found[stage]["frames"] == 6
        assert len(found[stage]["first_frames"]) == 5
        assert found[stage]["first_frames"] == sorted(found[stage]["first_frames"])
    assert {tuple(each["reasons"]) for each in found.values()} == {("never ran",)}
    assert {each["seconds"] for each in found.values()} == {None}


@pytest.mark.parametrize(
    ("changes", "stages"),
    [
        ((), STAGES),
        ((("support.toys:ToySegmenter", "support.toys:ToyImageSegmenter"),), ("segment", *STAGES)),
        (
            (
                ("support.toys:ToySegmenter", "support.toys:ToyImageSegmenter"),
                ('priors = ["points", "semantic"]', 'priors = ["points"]'),
            ),
            tuple(stage for stage in STAGES if stage != "semantic"),
        ),
        (
            (
                ("support.toys:ToyDetector", "pillars"),
                ("\npath = ", "\n# path = "),
                ('priors = ["points", "semantic"]', 'priors = ["points"]'),
            ),
            ("pretrain", *STAGES[:3], *STAGES[4:], "train-round"),
        ),
    ],
)
def test_the_graph_has_the_stages_of_a_run(
    curate: Curate, made: Path, dry: Callable, changes: tuple, stages: tuple[str, ...]
) -> None:
    """Of the workspace, in its order; outside of one, all stages are shown."""
    for former, later in changes:
        change(made, former, later)
    shown = json.loads(curate("graph", "--json", "-w", made)[1])
    assert tuple(each["name"] for each in shown) == stages
    assert tuple(dry("run", "--rounds", 1)) == stages


def test_outside_a_workspace_the_graph_has_all_stages(
    curate: Curate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder that is named must be a workspace."""
    monkeypatch.chdir(tmp_path)
    shown = json.loads(curate("graph", "--json")[1])
    before_solve = STAGES.index("solve")
    stages = (*STAGES[:before_solve], "calibrate", *STAGES[before_solve:])
    assert tuple(each["name"] for each in shown) == ("pretrain", "segment", *stages, "train-round")
    code, _, err = curate("graph", "-w", tmp_path)
    assert code == WorkspaceError.exit_code
    assert "no workspace here" in err


@pytest.mark.parametrize("command", ["run", "predict", "pretrain", "repredict", "score"])
def test_nothing_is_written(curate: Curate, made: Path, command: str) -> None:
    """Neither rows, such as the round or the detector, nor files; whatever the output."""
    before = contents(made)
    curate(command, "--dry-run")
    assert contents(made) == before


@pytest.mark.parametrize(
    "command",
    [
        ("run",),
        ("solve", "--policy", "spsl"),
        ("export",),
        ("export", "--format", "kitti"),
        ("train-round", "--command", "true"),
    ],
)
def test_nothing_is_written_after_a_run(
    curate: Curate, made: Path, command: tuple[str, ...]
) -> None:
    """Even if there is something to do."""
    assert curate("run")[0] == 0
    change(made, 'scope = "round"', 'scope = "frame"')
    curate("solve")
    curate("export")
    before = contents(made)
    code, out, err = curate(*command, "--dry-run")
    assert (code, err) == (0, "")
    assert out
    assert contents(made) == before


def test_a_changed_setting_is_reported_and_later_stages_are_due(
    curate: Curate, made: Path, dry: Callable
) -> None:
    """The stage itself with its setting, later ones with their input; the others are up to date."""
    assert curate("run")[0] == 0
    assert all(not each["reasons"] for each in dry("run").values())
    assert "Everything is up to date" in curate("run", "--dry-run")[1]
    change(made, "minimum_iou = 0.1", "minimum_iou = 0.2")
    found = dry("run")
    assert {stage: each["reasons"] for stage, each in found.items()} == {
        "predict": [],
        "repredict": ["changed settings: repredict.minimum_iou"],
        "points": [],
        "semantic": [],
        "solve": ["its input changes: repredict"],
        "export": ["its input changes: solve"],
    }
    assert found["repredict"]["frames"] == 6
    reports = json.loads(curate("run", "--json")[1])
    done = {each["stage"]: each["done"] for each in reports}
    assert {stage for stage, count in done.items() if count} == {"repredict", "solve", "export"}


def test_another_teacher_is_reported(
    curate: Curate, made: Path, dry: Callable, weights_file: Path
) -> None:
    """An external detector with another file; the new file is not recorded."""
    assert curate("run")[0] == 0
    weights_file.write_text("other")
    assert dry("run")["predict"]["reasons"] == ["its teacher changed"]
    assert find_teacher(Workspace.open(made), 1)[0] is None


def test_only_a_failed_frame_is_due_again(
    curate: Curate, made: Path, toy_kitti: Path, workspace: Workspace, dry: Callable
) -> None:
    name = min(workspace.frames("unlabeled"))
    path = toy_kitti / "training" / "calib" / f"{name}.txt"
    content = path.read_bytes()
    path.unlink()
    curate("run")
    path.write_bytes(content)
    found = dry("predict")["predict"]
    assert (found["frames"], found["first_frames"]) == (1, [name])
    assert found["reasons"] == ["failed before"]
    assert dry("repredict")["repredict"]["frames"] == 0
    assert dry("run")["repredict"]["frames"] == 1


def test_a_changed_formula_costs_no_measurement(curate: Curate, made: Path, dry: Callable) -> None:
    """Frames with stored measurements are due, at no cost."""
    assert curate("run")[0] == 0
    change(made, "[semantic]", "[semantic]\n# a changed formula")
    change(made, 'mean = "geometric"', 'mean = "arithmetic"')
    found = dry("score", "--prior", "semantic")["semantic"]
    assert (found["frames"], found["seconds"]) == (6, 0.0)
    assert found["reasons"] == ["changed settings: semantic.mean"]


def test_the_cost_is_estimated_from_earlier_frames(
    curate: Curate, made: Path, dry: Callable
) -> None:
    """By the median, which a slow first frame does not change; several workers share it."""
    assert curate("run")[0] == 0
    with closing(sqlite3.connect(made / "curate.db")) as connection, connection:
        connection.execute("UPDATE task SET seconds = 2.0 WHERE stage = 'predict'")
        first = "SELECT min(id) FROM task WHERE stage = 'predict'"
        connection.execute(f"UPDATE task SET seconds = 60.0 WHERE id = ({first})")
        connection.execute("UPDATE task SET seconds = 7.0 WHERE stage = 'solve'")
    change(made, "minimum_score = 0.1", "minimum_score = 0.2")
    change(made, 'workers = "auto"', "workers = 1")
    assert dry("run")["predict"]["seconds"] == pytest.approx(12.0)
    assert dry("run")["solve"]["seconds"] == pytest.approx(7.0)
    assert dry("run", "--workers", 2)["predict"]["seconds"] == pytest.approx(6.0)
    out = curate("predict", "--dry-run")[1]
    assert "would work on 6 frames (" in out
    assert "changed settings: detector.minimum_score; about 12 s" in out


def test_a_stage_that_cannot_run_is_reported(curate: Curate, made: Path) -> None:
    """With the message of the command itself."""
    code, out, err = curate("solve", "--dry-run")
    assert (code, out) == (WorkspaceError.exit_code, "")
    assert "run `curate predict`" in err


def test_every_round_is_due_if_the_teacher_is_not_trained(
    curate: Curate, tmp_path: Path, toy_kitti: Path, dry: Callable
) -> None:
    """All frames of all rounds."""
    detector = "support.trainable_toy:GridDetector"
    curate(
        "init", tmp_path / "w", "--root", toy_kitti, "--labeled", 0.25, "--detector", detector,
        "--set", "run.rounds=2",
    )  # fmt: skip
    code, out, _ = curate("run", "--dry-run", "--json", "-w", tmp_path / "w")
    assert code == 0
    stages = json.loads(out)["stages"]
    assert [each["round"] for each in stages if each["stage"] == "predict"] == [1, 2]
    assert stages[0]["stage"] == "pretrain"
    assert stages[0]["reasons"] == ["never ran"]
    assert {each["frames"] for each in stages} == {None, 6}
    assert {tuple(each["reasons"]) for each in stages[1:]} == {
        ("its teacher is still to be trained",)
    }
