"""export: which frames are exported, and in which formats."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import text
from support.pipelines_cli import Curate
from support.rounds import run_workspace

from curate.errors import ConfigError, DataError, FramesFailed, WorkspaceError
from curate.training.labels import WeightedLabels
from pipelines.workspace.workspace import Workspace


def run(workspace: Workspace) -> Path:
    """Run everything; return the exported file."""
    run_workspace(workspace)
    return workspace.root / "exports" / "labels.sqlite"


def first(workspace: Workspace, split: str) -> str:
    """Return the first frame of a split."""
    return next(iter(workspace.frames(split)))


def test_a_labeled_frame_without_objects_is_exported(workspace: Workspace) -> None:
    """It is certainly empty, so its background can be learned."""
    name = first(workspace, "labeled")
    key = workspace.frames("labeled")[name]
    with workspace.database.writing() as connection:
        connection.execute(text(f"DELETE FROM ground_truth WHERE frame_id = {key}"))
    samples = {sample.frame_id: sample for sample in WeightedLabels(run(workspace))}
    assert len(samples) == 8
    assert samples[name].labeled
    assert len(samples[name].boxes) == 0


def test_an_unlabeled_frame_without_predictions_is_left_out(
    workspace: Workspace, toy_kitti: Path
) -> None:
    """There is no weight for how likely the frame is empty."""
    name = first(workspace, "unlabeled")
    (toy_kitti / "training" / "velodyne" / f"{name}.bin").write_bytes(b"")
    labels = WeightedLabels(run(workspace))
    assert len(labels) == 7
    assert name not in labels.frame_ids


def test_an_unlabeled_frame_with_only_zero_weights_is_exported(
    workspace: Workspace,
) -> None:
    """Its labels are background or ignored, depending on the setting."""
    strict = workspace.with_settings("run", method="threshold")
    strict = strict.with_settings("solve", options={"threshold": {"threshold": 1.0}})
    samples = [sample for sample in WeightedLabels(run(strict)) if not sample.labeled]
    assert len(samples) == 6
    assert all(len(sample.boxes) == 3 for sample in samples)
    empty = [sample for sample in samples if (sample.weights == 0).all()]
    assert empty
    assert not any(sample.ignored.any() for sample in empty)
    doubting = strict.with_settings("train", zero_weight="ignore")
    samples = [sample for sample in WeightedLabels(run(doubting)) if not sample.labeled]
    assert any(sample.ignored.all() for sample in samples)


def test_formats_are_chosen_by_name(curate: Curate, workspace: Workspace, tmp_path: Path) -> None:
    """Into the workspace or another folder; the error for unknown formats lists the known ones."""
    run(workspace)
    folder, made = ("-w", workspace.root), workspace.root / "exports" / "round-01-pspsl-kitti"
    code, out, _ = curate("export", "--format", "kitti", *folder)
    assert (code, out) == (0, f"18 labels of round 1 in {made}\n")
    folders = [made / name for name in ("weight", "label_2")]
    listed, objects = (
        [line for path in folder.iterdir() for line in path.read_text().splitlines()]
        for folder in folders
    )
    assert len(listed) == 18
    assert len(objects) == sum(float(line.split()[1]) > 0 for line in listed) < 18
    copy = tmp_path / "copy.sqlite"
    code, out, _ = curate("export", "--output", copy, *folder)
    assert (code, out) == (0, f"18 labels of round 1 in {copy}\n")
    with closing(sqlite3.connect(copy)) as connection:
        assert connection.execute("SELECT count(*) FROM weighted_labels").fetchone() == (18,)
    code, _, err = curate("export", "--format", "yolo", *folder)
    assert code == ConfigError.exit_code
    assert "unknown exporter 'yolo': use one of coco, csv, kitti," in err


def test_a_file_that_is_not_an_export_is_not_overwritten(
    curate: Curate, workspace: Workspace, tmp_path: Path
) -> None:
    """A user's file at that path, or a policy that has no weights."""
    run(workspace)
    precious = tmp_path / "thesis.tex"
    precious.write_text("precious")
    code, _, err = curate("export", "--output", precious, "-w", workspace.root)
    assert code == ConfigError.exit_code
    assert "thesis.tex: exists and is not a previous export" in err
    assert precious.read_text() == "precious"
    code, _, err = curate("export", "--format", "kitti", "--policy", "spsl", "-w", workspace.root)
    assert code == WorkspaceError.exit_code
    assert "curate solve --policy spsl" in err


@pytest.mark.parametrize("leads", ["link", "nowhere", "thesis"])
def test_an_unknown_file_at_the_trainers_path_is_not_overwritten(
    workspace: Workspace, tmp_path: Path, leads: str
) -> None:
    """Neither a link, which an export would replace, nor a file of another kind."""
    former = run(workspace)
    target = tmp_path / "elsewhere.sqlite"
    if leads == "link":
        former.rename(target)
    former.unlink(missing_ok=True)
    if leads == "thesis":
        former.write_text("precious")
    else:
        former.symlink_to(target)
    with pytest.raises(
        ConfigError, match=r"labels.sqlite: (is a symbolic link|exists and is not a previous)"
    ):
        run(workspace.with_settings("solve", quantile=0.4))
    assert former.read_text() == "precious" if leads == "thesis" else former.is_symlink()
    assert target.exists() == (leads == "link")


def test_a_student_of_labeled_frames_gets_no_unlabeled_frames(
    workspace: Workspace,
) -> None:
    """Not even as background."""
    own = workspace.with_settings("run", method="baseline")
    assert WeightedLabels(run(own)).labeled.all()


@pytest.mark.parametrize("weight", ["1.5", "-0.1", "'NaN'", "9e999"])
def test_a_manually_changed_weight_is_reported_and_not_exported(
    curate: Curate, workspace: Workspace, tmp_path: Path, weight: str
) -> None:
    """By every command that exports weights, even if the export is up to date."""
    exported = run(workspace).read_bytes()
    with workspace.database.writing() as connection:
        chosen = "round = 1 AND policy = 'pspsl' AND k = 0"
        connection.execute(text(f"UPDATE weight SET v = {weight} WHERE {chosen}"))
    frame = first(workspace, "unlabeled")
    for command in (
        ("export",),
        ("export", "--output", tmp_path / "labels.sqlite"),
        ("export", "--format", "csv", "--output", tmp_path / "labels.csv"),
        ("train-round",),
        ("report",),
        ("view", frame),
        ("explain", frame, "0"),
    ):
        code, _, err = curate(*command, "-w", workspace.root)
        assert code == DataError.exit_code, command
        assert f"frame {frame}: label 0 has weight" in err
        assert len(err.splitlines()) == 1
    assert (workspace.root / "exports" / "labels.sqlite").read_bytes() == exported
    assert not list(tmp_path.glob("labels.*"))


def test_an_export_of_one_policy_never_replaces_that_of_another(
    curate: Curate, workspace: Workspace
) -> None:
    """By default every file has its round and policy in its name, in every format."""
    run(workspace)
    folder = workspace.root / "exports"
    before = {path.name: path.read_bytes() for path in folder.glob("*.sqlite")}
    assert {"labels.sqlite", "round-01-pspsl.sqlite"} <= set(before)
    assert curate("solve", "--policy", "spsl", "-w", workspace.root)[0] == 0
    ends = {
        "sqlite": ".sqlite", "csv": ".csv", "parquet": ".parquet", "kitti": "-kitti",
        "openpcdet": "-openpcdet", "mmdet3d": "-mmdet3d", "coco": "-coco.json", "st3d": "-st3d",
    }  # fmt: skip
    for name, end in ends.items():
        for policy in ("pspsl", "spsl"):
            code, _, err = curate(
                "export", "--format", name, "--policy", policy, "-w", workspace.root
            )
            assert code == 0, err
            assert (folder / f"round-01-{policy}{end}").exists()
    made = {f"round-01-{policy}{end}" for policy in ("pspsl", "spsl") for end in ends.values()}
    assert {each.name for each in folder.iterdir()} == {*before, *made}
    assert {path: (folder / path).read_bytes() for path in before} == before
    for path in ("pspsl", "spsl"):
        with closing(sqlite3.connect(folder / f"round-01-{path}.sqlite")) as connection:
            query = "SELECT DISTINCT policy FROM weighted_labels"
            assert connection.execute(query).fetchall() == [(path,)]


@pytest.fixture
def with_failed(curate: Curate, workspace: Workspace, toy_kitti: Path) -> tuple[Workspace, str]:
    """Return a workspace with weights, and the name of a frame that failed."""
    name = first(workspace, "unlabeled")
    (toy_kitti / "training" / "velodyne" / f"{name}.bin").write_bytes(b"damaged")
    for command in ("predict", "repredict", "score", "solve"):
        curate(command, "-w", workspace.root)
    return workspace, name


@pytest.mark.parametrize("file_format", ["sqlite", "csv", "kitti"])
def test_a_failed_frame_is_reported_by_the_export(
    curate: Curate, with_failed: tuple[Workspace, str], file_format: str
) -> None:
    """In one line, in JSON, and again by an export that is up to date."""
    workspace, name = with_failed
    command = ("export", "--format", file_format, "-w", workspace.root)
    for _ in range(2):
        code, out, _ = curate(*command)
        assert code == 0
        assert (
            f"failed frames that are missing from the export: 1 ({name}); "
            "see `curate status --failed`\n"
        ) in out
    code, out, _ = curate(*command, "--json")
    assert code == 0
    assert json.loads(out)[0]["missing"] == [name]


@pytest.mark.parametrize("file_format", ["sqlite", "csv", "kitti"])
def test_strict_makes_a_missing_frame_an_error(
    curate: Curate, with_failed: tuple[Workspace, str], file_format: str
) -> None:
    """Nothing is written."""
    workspace, name = with_failed
    code, _, err = curate("export", "--format", file_format, "--strict", "-w", workspace.root)
    assert code == FramesFailed.exit_code
    assert err.startswith(
        f"error: --strict: failed frames of round 1 that would be missing: 1 ({name}); see"
    )
    assert not list((workspace.root / "exports").glob("round-*"))


def test_strict_exports_complete_labels(curate: Curate, workspace: Workspace) -> None:
    """It changes nothing if no frame failed; frames of another policy's round do not count."""
    run(workspace)
    code, out, _ = curate("export", "--format", "csv", "--strict", "--json", "-w", workspace.root)
    assert code == 0
    assert json.loads(out)[0]["missing"] == []
