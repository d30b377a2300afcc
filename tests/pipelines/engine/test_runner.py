"""The runner: what is done once, what becomes stale, and what a failure costs."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from support import toys
from support.rounds import run, run_stage, run_workspace
from support.stored_rows import dump

from curate.errors import WorkspaceError
from curate.priors.points import PointPrior
from curate.priors.semantic import SemanticPrior
from pipelines.round import open_plan, round_graph
from pipelines.workspace.workspace import Workspace

ENGINES = ("sqlite", "postgresql")
NewWorkspace = Callable[[Path], Workspace]
FRAME_STAGES = ("predict", "repredict", "points", "semantic")


def count(workspace: Workspace, table: str) -> int:
    """Return the number of rows of a table."""
    with workspace.database.reading() as connection:
        return connection.exec_driver_sql(f"SELECT count(*) FROM {table}").scalar_one()


def with_setting(workspace: Workspace, section: str, **changes: object) -> Workspace:
    """Return the workspace after an edit of curate.toml."""
    return workspace.with_settings(section, **changes)


def test_a_run_fills_every_table(workspace: Workspace) -> None:
    """Three labels per unlabeled frame go through all stages."""
    assert run(workspace) == dict.fromkeys(FRAME_STAGES, 6) | {"solve": 1, "export": 1}
    for table in ("prediction", "consistency", "point_prior", "semantic_prior", "weight"):
        assert count(workspace, table) == 18
    assert count(workspace, "weighted_labels") == 18


def test_a_second_run_does_nothing(workspace: Workspace) -> None:
    run(workspace)
    before = dump(workspace)
    assert set(run(workspace).values()) == {0}
    assert dump(workspace) == before


@pytest.mark.parametrize(
    ("section", "changes", "redone"),
    [
        ("points", {"statistic": "mean"}, {"points", "solve", "export"}),
        ("semantic", {"mean": "product"}, {"semantic", "solve", "export"}),
        ("solve", {"scope": "frame"}, {"solve", "export"}),
        ("repredict", {"views": 2}, {"repredict", "solve", "export"}),
        ("detector", {"minimum_score": 0.5}, {*FRAME_STAGES, "solve", "export"}),
        ("run", {"workers": 2}, set()),
    ],
)
def test_a_changed_setting_reruns_its_stage_and_the_later_ones(
    workspace: Workspace, section: str, changes: dict, redone: set
) -> None:
    """Nothing else: a changed prior does not run the detector."""
    run(workspace)
    done = run(with_setting(workspace, section, **changes))
    assert {name for name, frames in done.items() if frames} == redone


def test_new_predictions_make_the_later_stages_stale(workspace: Workspace) -> None:
    """Predicting again deletes evidence and weights, and their tasks too."""
    run(workspace)
    before = dump(workspace)
    tried = with_setting(workspace, "detector", minimum_score=0.5)
    run_stage(tried, "predict", 1)
    assert count(workspace, "weight") == 0
    run(workspace)
    assert dump(workspace) == before


@pytest.mark.parametrize(
    ("section", "changes", "prior", "rates"),
    [
        ("semantic", {"mean": "product"}, "semantic", True),
        ("semantic", {"outside": "drop"}, "semantic", True),
        ("points", {"statistic": "fixed", "fixed": 31.0}, "points", True),
        ("segmenter", {"classes": "coco"}, "semantic", False),
    ],
)
def test_a_changed_formula_reuses_the_measurements(
    workspace: Workspace, another: NewWorkspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    section: str, changes: dict, prior: str, rates: bool,
) -> None:  # fmt: skip
    """No point or pixel is counted again, and the rows are those of a new run."""
    run(workspace)
    whole = another(tmp_path / "whole")
    run(with_setting(whole, section, **changes))
    measured: list[str] = []
    for kind in (PointPrior, SemanticPrior):
        monkeypatch.setattr(kind, "measure", counted(kind.measure, measured))
    monkeypatch.setattr(toys.ToySegmenter, "segment", counted(toys.ToySegmenter.segment, measured))
    assert run(with_setting(workspace, section, **changes))[prior] == 6
    assert bool(measured) is not rates
    assert dump(workspace) == dump(whole)


def counted(method, calls: list[str]):
    """Return the method, which also appends its name to a list."""

    def call(*arguments):
        calls.append(method.__qualname__)
        return method(*arguments)

    return call


def test_a_failed_frame_is_measured_even_if_only_the_formula_changed(
    workspace: Workspace, toy_kitti: Path
) -> None:
    """It has no stored measurements to reuse."""
    name = next(iter(workspace.frames("unlabeled")))
    path = toy_kitti / "training" / "image_2" / f"{name}.png"
    whole = path.read_bytes()
    run_stage(workspace, "predict")
    path.write_bytes(whole[:-30])
    assert run_stage(workspace, "semantic").failed == 1
    changed = with_setting(workspace, "semantic", mean="product")
    assert run_stage(changed, "semantic").failed == 1
    path.write_bytes(whole)
    assert run_stage(changed, "semantic").done == 1
    assert count(workspace, "semantic_prior") == 18


def test_another_detector_makes_everything_stale(workspace: Workspace, weights_file: Path) -> None:
    """The teacher's hash is part of every fingerprint."""
    run(workspace)
    weights_file.write_text("# another")
    assert all(run(workspace).values())


def test_a_frame_on_which_the_model_raises_does_not_stop_the_others(
    workspace: Workspace, weights_file: Path
) -> None:
    """Its task has a one-line error; the next run tries it again."""
    poisoned = next(iter(workspace.frames("unlabeled")))
    weights_file.write_text(poisoned)
    reports = {report.stage: report for report in run_workspace(workspace)}
    assert reports["predict"].failed == 1
    assert reports["predict"].done == 5
    [(frame, error)] = reports["predict"].errors
    assert frame == poisoned
    assert error == (
        f"frame {poisoned}: RuntimeError: CUDA error: an illegal memory access was encountered"
    )
    assert count(workspace, "weight") == 15
    again = run_stage(workspace, "predict")
    assert (again.failed, again.kept) == (1, 5)


def test_a_fixed_frame_is_processed_in_the_next_run(workspace: Workspace, toy_kitti: Path) -> None:
    """A damaged file fails its frame; after the fix only that frame is processed."""
    name = next(iter(workspace.frames("unlabeled")))
    path = toy_kitti / "training" / "velodyne" / f"{name}.bin"
    whole = path.read_bytes()
    path.write_bytes(whole[:-3])
    reports = {report.stage: report for report in run_workspace(workspace)}
    assert "truncated" in reports["predict"].errors[0][1]
    path.write_bytes(whole)
    assert run(workspace) == dict.fromkeys(FRAME_STAGES, 1) | {"solve": 1, "export": 1}
    assert count(workspace, "weight") == 18


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda home, name: (home / "calib" / f"{name}.txt").unlink(), "calib"),
        (lambda home, name: (home / "image_2" / f"{name}.png").write_bytes(b"no png"), "image_2"),
        (lambda home, name: (home / "velodyne" / f"{name}.bin").write_bytes(b"\x00" * 17), "velo"),
        (
            lambda home, name: (home / "velodyne" / f"{name}.bin").write_bytes(
                b"\x00\x00\xc0\x7f" * 4
            ),
            "NaN",
        ),
    ],
)
def test_a_damaged_file_fails_its_frame_with_one_line(
    workspace: Workspace, toy_kitti: Path, damage, message: str
) -> None:
    """The line contains the file; the other frames are done."""
    name = next(iter(workspace.frames("unlabeled")))
    damage(toy_kitti / "training", name)
    reports = run_workspace(workspace)
    [error] = {error for report in reports for _, error in report.errors}
    assert message in error
    assert name in error
    assert "\n" not in error
    assert count(workspace, "weight") == 15


def test_an_empty_sweep_is_empty_in_every_stage(workspace: Workspace, toy_kitti: Path) -> None:
    """No points, no labels, no failure."""
    name = next(iter(workspace.frames("unlabeled")))
    (toy_kitti / "training" / "velodyne" / f"{name}.bin").write_bytes(b"")
    reports = {report.stage: report for report in run_workspace(workspace)}
    assert [reports[name].empty for name in FRAME_STAGES] == [1] * 4
    assert count(workspace, "weight") == 15


def test_solve_requires_all_earlier_stages(workspace: Workspace) -> None:
    """The error contains the missing command."""
    run_stage(workspace, "predict")
    with pytest.raises(WorkspaceError, match=r"repredict: 6 frames.*curate repredict"):
        run_stage(workspace, "solve", policy="pspsl")


def test_weights_of_two_policies_are_stored_together(workspace: Workspace) -> None:
    """Solving for another policy does not change those of the first."""
    run(workspace)
    before = [row for row in dump(workspace) if row[0] == "weight"]
    run_stage(workspace, "solve", policy="uniform")
    after = [row for row in dump(workspace) if row[0] == "weight"]
    assert set(before) < set(after)
    assert len(after) == 36


def test_every_stage_reads_only_earlier_outputs(workspace: Workspace) -> None:
    """Inputs are sources or the outputs of earlier stages."""
    available = {"frame", "ground_truth"}
    for each in round_graph().stages:
        assert set(each.reads) <= available
        available |= set(each.writes)


def test_fingerprints_do_not_depend_on_the_location_of_the_data(workspace: Workspace) -> None:
    """A moved dataset is not processed again."""
    plan = open_plan(workspace, 1)
    moved = replace(plan, workspace=with_setting(workspace, "dataset", root=Path("/elsewhere")))
    assert moved.fingerprints("pspsl") == plan.fingerprints("pspsl")
