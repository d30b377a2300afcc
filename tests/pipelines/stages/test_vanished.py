"""Labels that vanish: the former exports stay, and the command fails."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.pipelines_cli import Curate

from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import FramesFailed, LabelsVanished
from pipelines.workspace.workspace import Workspace

HEADER = "frame,view,flip_y,rotation_rad,scale,category,score,x,y,z,length,width,height,yaw"
Record = Callable[..., None]


@pytest.fixture
def record(tmp_path: Path, toy_kitti: Path) -> Record:
    """Return a function that writes recorded results of some categories with a score."""
    dataset = KittiDataset(toy_kitti)

    def write(*categories: str, score: float = 0.9) -> None:
        rows = [HEADER]
        for name in dataset.frame_ids():
            truth = dataset.annotations(name)
            for category, box in zip(truth.categories.tolist(), truth.boxes, strict=True):
                numbers = ",".join(f"{each:.6f}" for each in np.add(box, [0.01, *[0] * 6]))
                if category in categories:
                    rows += [f"{name},{view},0,0,{1 + view / 50},{category},{score},{numbers}"
                             for view in (0, 1)]  # fmt: skip
        (tmp_path / "results.csv").write_text("\n".join(rows) + "\n")

    return write


@pytest.fixture
def work(curate: Curate, tmp_path: Path, toy_kitti: Path, record: Record) -> Path:
    """Return a workspace after a good run with all three categories, weighted by the points."""
    record("Car", "Pedestrian", "Cyclist")
    code, _, err = curate(
        "init", tmp_path / "w", "--root", toy_kitti, "--labeled", "0.25",
        "--detector", "recorded", "--detector-path", tmp_path / "results.csv",
        "--set", "solve.self_paced=false",
    )  # fmt: skip
    assert code == 0, err
    code, out, err = curate("run", "-w", tmp_path / "w")
    assert code == 0, err
    assert "18 labels, 18 with weight > 0" in out
    return tmp_path / "w"


def exports(work: Path) -> dict[str, bytes]:
    """Return the content of every exported file."""
    return {
        str(path): path.read_bytes() for path in (work / "exports").rglob("*") if path.is_file()
    }


def test_a_category_that_vanishes_keeps_the_export(
    curate: Curate, work: Path, record: Record
) -> None:
    """`run` and `export` fail with what was there and what is; --allow-empty replaces the files."""
    before = exports(work)
    record("Car", "Pedestrian")
    for command in ("run", "export"):
        code, _, err = curate(command, "-w", work)
        assert code == LabelsVanished.exit_code
        assert "exports/round-01-pspsl.sqlite has weighted labels of Cyclist 6, now there " in err
        assert "now there are Car 6, Pedestrian 6" in err
        assert "--allow-empty" in err
        assert exports(work) == before
    code, out, err = curate("run", "--allow-empty", "-w", work)
    assert code == 0, err
    assert "12 labels in exports/round-01-pspsl.sqlite" in out
    assert "WARNING" not in err or "Cyclist" in err
    assert exports(work) != before
    record("Car", "Pedestrian", "Cyclist")
    assert curate("run", "-w", work)[0] == 0


def test_a_run_without_any_label_fails(curate: Curate, work: Path, record: Record) -> None:
    """All boxes are below the minimum score: every frame is empty."""
    before = exports(work)
    record("Car", "Pedestrian", "Cyclist", score=0.05)
    code, _, err = curate("run", "-w", work)
    assert code == LabelsVanished.exit_code
    assert "round 1 has no label for policy pspsl; of 6 unlabeled frames, none failed" in err
    assert "6 have no box of dataset.categories above detector.minimum_score" in err
    assert exports(work) == before
    code, _, err = curate("run", "--allow-empty", "-w", work)
    assert code == 0, err
    assert exports(work) != before


def test_the_first_run_without_any_label_writes_no_export(
    curate: Curate, tmp_path: Path, toy_kitti: Path, record: Record
) -> None:
    """There is no former export; an empty one is an error all the same."""
    record("Car", score=0.05)
    results = ("--detector", "recorded", "--detector-path", tmp_path / "results.csv")
    assert (
        curate("init", tmp_path / "w", "--root", toy_kitti, "--labeled", "0.25", *results)[0] == 0
    )
    assert curate("run", "-w", tmp_path / "w")[0] == LabelsVanished.exit_code
    assert exports(tmp_path / "w") == {}


def test_a_run_in_which_every_frame_fails(
    curate: Curate, workspace: Workspace, weights_file: Path
) -> None:
    """The toy detector raises; with --allow-empty, the failed frames remain an error."""
    assert curate("run", "-w", workspace.root)[0] == 0
    before = exports(workspace.root)
    weights_file.write_text(" ".join(workspace.frames("unlabeled")))
    code, _, err = curate("run", "-w", workspace.root)
    assert code == LabelsVanished.exit_code
    assert "of 6 unlabeled frames, 6 failed in predict (`curate status --failed`)" in err
    assert exports(workspace.root) == before
    code, _, err = curate("run", "--allow-empty", "-w", workspace.root)
    assert code == FramesFailed.exit_code
    assert exports(workspace.root) != before


@pytest.mark.parametrize("file_format", ["kitti", "csv", "coco", "openpcdet"])
def test_other_formats_are_kept_too(
    curate: Curate, work: Path, record: Record, tmp_path: Path, file_format: str
) -> None:
    """Files of a trainer, also outside of the workspace; without the SQLite file of the round."""
    target = tmp_path / "elsewhere" / file_format
    target.parent.mkdir()
    command = ("export", "--format", file_format, "--output", target, "-w", work)
    assert curate(*command)[0] == 0
    before = target.stat().st_mtime_ns, target.read_bytes() if target.is_file() else None
    record("Car", "Pedestrian")
    for stage in ("predict", "repredict", "score", "solve"):
        assert curate(stage, "-w", work)[0] == 0
    code, _, err = curate(*command)
    assert code == LabelsVanished.exit_code
    assert f"{target} has weighted labels of Cyclist 6" in err
    assert (target.stat().st_mtime_ns, target.read_bytes() if target.is_file() else None) == before
    assert curate(*command, "--allow-empty")[0] == 0
    assert curate(*command)[0] == 0  # the new export is now the former one


def test_another_policy_is_not_compared(curate: Curate, work: Path, record: Record) -> None:
    """Its weights may be 0 where those of the former policy were not."""
    assert curate("run", "--method", "spsl", "-w", work)[0] == 0
    record("Car")
    code, _, err = curate("run", "--method", "threshold", "-w", work)
    assert code == 0, err


def test_a_category_that_never_had_labels_is_only_a_warning(
    curate: Curate, tmp_path: Path, toy_kitti: Path, record: Record, caplog
) -> None:
    """From the first run on."""
    record("Car", "Pedestrian")
    results = ("--detector", "recorded", "--detector-path", tmp_path / "results.csv")
    work = tmp_path / "w"
    assert curate("init", work, "--root", toy_kitti, "--labeled", "0.25", *results)[0] == 0
    assert curate("run", "-w", work)[0] == 0
    assert curate("run", "-w", work)[0] == 0
    assert f"the results {tmp_path}/results.csv have no Cyclist, only Car, Ped" in caplog.text


def test_a_student_is_not_trained_on_no_labels(
    curate: Curate, work: Path, record: Record, caplog
) -> None:
    """Not by the user's command either, unless it is allowed."""
    record("Car", score=0.05)
    assert curate("run", "--allow-empty", "-w", work)[0] == 0
    trainer = "sh -c 'echo trained > \"$1\"' sh {output}"
    command = ("train-round", "--command", trainer, "-w", work)
    code, _, err = curate(*command)
    assert code == LabelsVanished.exit_code
    assert "round 1 has no label for policy pspsl" in err
    assert not list((work / "checkpoints").rglob("*.csv"))
    caplog.clear()
    code, _, err = curate(*command, "--allow-empty")
    assert code == 0, err
    assert "round 1 has no label for policy pspsl" in caplog.text


def test_a_damaged_record_of_exports_is_no_obstacle(curate: Curate, work: Path) -> None:
    """Then nothing is known of former exports, and it is written anew."""
    path = work / ".exports.json"
    path.write_text("[1")
    (work / "exports" / "round-01-pspsl.sqlite").unlink()
    assert curate("run", "-w", work)[0] == 0
    assert json.loads(path.read_text())["exports/labels.sqlite"]["labels"]["Car"] == 6
