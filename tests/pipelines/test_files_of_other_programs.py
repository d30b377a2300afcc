"""Labels, lists, results and calibrations as other programs write them, from init to predict."""

import json
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.pipelines_cli import Curate

from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import ConfigError, DataError

CLASSES = ("Pedestrian", "Cyclist", "Car")


def labels(root: Path) -> list[Path]:
    """Return the label files of the toy data set."""
    return sorted((root / "training" / "label_2").glob("*.txt"))


def recorded(curate: Curate, work: Path, root: Path, path: Path, *more: str) -> tuple[int, str]:
    """Create a workspace over recorded results and predict; return exit code and messages."""
    code, _, err = curate(
        "init", work, "--root", root, "--labeled", "0.25", "--detector", "recorded",
        "--detector-path", path, "--set", "solve.self_paced=false",
        "--set", 'run.priors=["points"]', *more,
    )  # fmt: skip
    assert code == 0, err
    code, _, err = curate("predict", "-w", work)
    return code, err


def rows(curate: Curate, work: Path, sql: str) -> list[dict[str, Any]]:
    """Return the rows of a query."""
    found: list[dict[str, Any]] = json.loads(curate("query", sql, "--json", "-w", work)[1])
    return found


def result_files(root: Path, folder: Path, scores: tuple[float, ...] = (0.9, 0.8, 0.7)) -> Path:
    """Write the labels as results, each a centimetre off."""
    folder.mkdir()
    for path in labels(root):
        lines = path.read_text().splitlines()
        moved = []
        for line, score in zip(lines, scores, strict=False):
            fields = line.split()
            fields[11] = f"{float(fields[11]) + 0.01:.4f}"
            moved.append(f"{' '.join(fields)} {score}\n")
        (folder / path.name).write_text("".join(moved))
    return folder


def test_label_files_with_a_score_are_read(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    """By init and by evaluate."""
    results = result_files(toy_kitti, tmp_path / "results")
    plain = curate("evaluate", "--labels", labels(toy_kitti)[0].parent, "--results", results)
    for path in labels(toy_kitti):
        path.write_text(path.read_text().replace("\n", " 1\n"))
    code, _, err = curate("init", tmp_path / "w", "--root", toy_kitti, "--labeled", "0.25")
    assert code == 0, err
    scored = curate("evaluate", "--labels", labels(toy_kitti)[0].parent, "--results", results)
    assert scored == plain
    assert plain[0] == 0


@pytest.mark.parametrize("numbers", ["0 0 0 0 0 0 0", "-1 -1 -1 -1000 -1000 -1000 -10"])
def test_a_label_without_a_3d_box_is_rejected_at_init(
    curate: Curate, tmp_path: Path, toy_kitti: Path, numbers: str
) -> None:
    """As a region it is accepted."""
    path = labels(toy_kitti)[0]
    path.write_text(f"{path.read_text()}Car 0 0 0 10 10 60 30 {numbers}\n")
    (tmp_path / "list.txt").write_text(path.stem)
    init = ("init", tmp_path / "w", "--root", toy_kitti, "--labeled", tmp_path / "list.txt")
    code, _, err = curate(*init)
    assert code == DataError.exit_code
    assert f"{path}:{len(path.read_text().splitlines())}: no 3D box: height, width" in err
    assert "set its category to DontCare" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "w").exists()
    path.write_text(path.read_text().replace("Car 0 0 0 10", "DontCare 0 0 0 10"))
    assert curate(*init)[0] == 0


@pytest.mark.parametrize("suffix", ["", ".bin", " ", "\r"])
@pytest.mark.parametrize("form", ["{:06d}", "{}", "velodyne/{:06d}", "C:\\kitti\\velodyne\\{:06d}"])
def test_lists_take_every_spelling(
    curate: Curate, tmp_path: Path, toy_kitti: Path, form: str, suffix: str
) -> None:
    """With a byte order mark, which cannot be seen."""
    train = KittiDataset(toy_kitti).splits()["train"][:2]
    text = "\n".join(f"{form.format(int(name))}{suffix}" for name in train)
    (tmp_path / "list.txt").write_text(f"\ufeff{text}")
    code, _, err = curate(
        "init", tmp_path / "w", "--root", toy_kitti, "--labeled", tmp_path / "list.txt"
    )
    assert code == 0, err
    sql = "SELECT frame FROM frame WHERE split = 'labeled' ORDER BY frame"
    assert [row["frame"] for row in rows(curate, tmp_path / "w", sql)] == sorted(train)
    assert curate("check", "-w", tmp_path / "w")[0] == 0


def test_an_unknown_name_in_a_list_is_rejected_with_the_nearest(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    (tmp_path / "list.txt").write_text("000001\n000123\n")
    init = ("init", tmp_path / "w", "--root", toy_kitti, "--labeled", tmp_path / "list.txt")
    code, _, err = curate(*init)
    assert code == ConfigError.exit_code
    message = r"--labeled .*list\.txt:2: there is no frame '000123'; the nearest are '0000\d\d' and"
    assert re.search(message, err)


def test_lists_and_results_of_evaluate_take_every_spelling(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """The id of a frame is the name of its label file."""
    results = result_files(toy_kitti, tmp_path / "results")
    both = ("--labels", labels(toy_kitti)[0].parent, "--results", results, "--json")
    expected = curate("evaluate", *both)
    names = [path.stem for path in labels(toy_kitti)]
    for name in names:
        (results / f"{name}.txt").rename(results / f"{int(name)}.txt")
    text = "".join(f"label_2/{int(name)}.txt\r\n" for name in names)
    (tmp_path / "list.txt").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert curate("evaluate", *both, "--frames", tmp_path / "list.txt") == expected
    assert curate("evaluate", *both) == expected
    (results / f"{names[0]}.txt").write_text("")
    code, _, err = curate("evaluate", *both)
    assert code == DataError.exit_code
    assert f"are both frame {names[0]}; remove one" in err


def test_scores_before_the_sigmoid_are_rejected_or_declared(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    results = result_files(toy_kitti, tmp_path / "results", (6.5, 2.1, -0.4))
    code, err = recorded(curate, tmp_path / "a", toy_kitti, results)
    assert code == DataError.exit_code
    assert "scores from -0.4 to 6.5 are not in [0, 1]; set detector.options.sigmoid = true" in err
    declared = ("--set", "detector.options.sigmoid=true")
    code, err = recorded(curate, tmp_path / "b", toy_kitti, results, *declared)
    assert code == 0, err
    sql = "SELECT DISTINCT round(score, 4) AS score FROM prediction ORDER BY score DESC"
    assert [row["score"] for row in rows(curate, tmp_path / "b", sql)] == [0.9985, 0.8909, 0.4013]


@pytest.mark.parametrize("kind", ["openpcdet", "mmdetection3d"])
def test_results_that_number_frames_are_matched(
    curate: Curate, tmp_path: Path, toy_kitti: Path, kind: str
) -> None:
    """OpenPCDet's frame_id and mmdetection3d's sample_idx as whole numbers."""
    dataset = KittiDataset(toy_kitti)
    entries = []
    for name in dataset.frame_ids():
        truth = dataset.annotations(name)
        boxes = np.add(truth.boxes, [0.01, 0, 0, 0, 0, 0, 0])
        scores = np.full(len(boxes), 0.9)
        if kind == "openpcdet":
            entry = {"frame_id": int(name), "boxes_lidar": boxes, "score": scores}
            entries.append(entry | {"name": truth.categories})
        else:
            numbers = np.array([CLASSES.index(each) for each in truth.categories], dtype=int)
            entry = {"sample_idx": int(name), "bboxes_3d": boxes, "scores_3d": scores}
            entries.append(entry | {"labels_3d": numbers})
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(entries))
    option = f"detector.options.classes={json.dumps(CLASSES)}"
    more = ("--set", option) if kind == "mmdetection3d" else ()
    code, err = recorded(curate, tmp_path / "w", toy_kitti, tmp_path / "a.pkl", *more)
    assert code == 0, err
    assert "do not exist" not in err
    sql = "SELECT count(*) AS n, count(DISTINCT frame_id) AS frames FROM prediction"
    [counts] = rows(curate, tmp_path / "w", sql)
    unlabeled = rows(curate, tmp_path / "w", "SELECT 1 FROM frame WHERE split = 'unlabeled'")
    assert counts == {"n": 3 * len(unlabeled), "frames": len(unlabeled)}


def test_calibrations_of_the_tracking_benchmark_and_of_windows_are_read(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """Other names without colons; a byte order mark before P2."""
    for number, path in enumerate(sorted((toy_kitti / "training" / "calib").glob("*.txt"))):
        lines = (
            path.read_text().replace("R0_rect:", "R_rect").replace("Tr_velo_to_cam:", "Tr_velo_cam")
        )
        start = "\ufeff" if number % 2 else ""
        path.write_text(start + "".join(sorted(lines.splitlines(keepends=True), reverse=True)))
    code, _, err = curate("init", tmp_path / "w", "--root", toy_kitti, "--labeled", "0.25")
    assert code == 0, err
