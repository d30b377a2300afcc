"""The command that checks one frame."""

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.pipelines_cli import Curate
from support.rigs import TILTED
from support.toys import toy_calibration

from curate.datasets.kitti.dataset import KittiDataset, write_calibration
from curate.datasets.kitti.labels import from_annotations, write_objects
from curate.frames import Calibration


def write_results(path: Path, root: Path, change=None) -> Path:
    """Write OpenPCDet results equal to the ground truth, or a changed copy."""
    dataset = KittiDataset(root)
    entries = []
    for name in dataset.frame_ids():
        truth = dataset.annotations(name)
        boxes = truth.boxes if change is None else change(truth.boxes)
        entry = {"frame_id": name, "name": truth.categories, "boxes_lidar": boxes}
        entries.append({**entry, "score": np.full(len(boxes), 0.9)})
    path.write_bytes(pickle.dumps(entries))
    return path


def begin(curate: Curate, work: Path, root: Path, results: Path) -> None:
    """Create a workspace with recorded results."""
    code, _, err = curate(
        "init", work, "--root", root, "--labeled", "0.25",
        "--detector", "recorded", "--detector-path", results,
    )  # fmt: skip
    assert code == 0, err


def test_a_correct_chain_passes(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    """The only remark is the missing second pass."""
    begin(curate, tmp_path / "w", toy_kitti, write_results(tmp_path / "a.pkl", toy_kitti))
    code, out, err = curate("doctor", "-w", tmp_path / "w")
    assert code == 0, out + err
    assert "suspect  views" in out
    assert "ok       convention" in out


def test_a_wrong_convention_fails(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    """Boxes with their origin at the bottom, also as JSON; an unknown frame is an error."""
    results = write_results(
        tmp_path / "a.pkl", toy_kitti, lambda b: b - b[:, 5:6] * [0, 0, 0.5, 0, 0, 0, 0]
    )
    begin(curate, tmp_path / "w", toy_kitti, results)
    code, out, _ = curate("doctor", "000003", "-w", tmp_path / "w")
    assert (code, out.splitlines()[0]) == (1, "frame 000003")
    assert "z is the bottom of the box" in out
    code, out, _ = curate("doctor", "000003", "--json", "-w", tmp_path / "w")
    assert code == 1
    found = {one["check"]: one["state"] for one in json.loads(out)["findings"]}
    assert found["convention"] == "wrong"
    code, _, err = curate("doctor", "999999", "-w", tmp_path / "w")
    assert code == 2
    assert "frame 999999 is not in the workspace" in err


def change_labels(root: Path, change) -> None:
    """Apply a function to the fields of each line of the label files."""
    for path in sorted((root / "training" / "label_2").glob("*.txt")):
        lines = [change(line.split()) for line in path.read_text().splitlines()]
        path.write_text("".join(" ".join(map(str, fields)) + "\n" for fields in lines))


def moved(column: int, by) -> Callable[[list[str]], list[str]]:
    """Return a function that adds to a field, numbered from 0."""

    def change(fields: list[str]) -> list[str]:
        return [*fields[:column], str(float(fields[column]) + by(fields)), *fields[column + 1 :]]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: [*f[:9], f[10], f[9], *f[11:]], "length and width are swapped"),
        (moved(12, lambda f: -float(f[8]) / 2), "lowered by half their height"),
        (moved(12, lambda f: float(f[8]) / 2), "raised by half their height"),
        (moved(14, lambda _: np.pi / 2), "turned by 90 degrees"),
        (moved(14, lambda f: -2 * float(f[14]) - np.pi), "yaw is negated"),
        (moved(13, lambda _: 100.0), "15 of 15 labeled boxes contain no points"),
    ],
    ids=["swapped", "centre", "low", "turned", "negated", "far"],
)
@pytest.mark.parametrize("frame", ["000000", "labeled"])
def test_ground_truth_is_judged_like_detections(
    curate: Curate, tmp_path: Path, toy_kitti: Path, change, message: str, frame: str
) -> None:
    """The detections are right, the labels are not, whichever frame is checked."""
    results = write_results(tmp_path / "a.pkl", toy_kitti)
    change_labels(toy_kitti, change)
    begin(curate, tmp_path / "w", toy_kitti, results)
    if frame == "labeled":
        sql = "SELECT frame FROM frame WHERE split = 'labeled' LIMIT 1"
        frame = json.loads(curate("query", sql, "--json", "-w", tmp_path / "w")[1])[0]["frame"]
    code, out, _ = curate("doctor", frame, "--json", "-w", tmp_path / "w")
    assert code == 1
    found = {one["check"]: one for one in json.loads(out)["findings"]}
    wrong = found["labels" if "no points" in message else "label boxes"]
    assert wrong["state"] == "wrong"
    assert message in wrong["message"]
    assert {found[name]["state"] for name in ("boxes", "convention", "calibration")} == {"ok"}


def test_a_reduced_image_fails(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    """The images have half the size, the calibration is that of the large ones."""
    import cv2

    results = write_results(tmp_path / "a.pkl", toy_kitti)
    for path in (toy_kitti / "training" / "image_2").glob("*.png"):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (60, 20)))
    begin(curate, tmp_path / "w", toy_kitti, results)
    code, out, _ = curate("doctor", "-w", tmp_path / "w")
    assert code == 1
    assert "wrong    scale" in out
    assert "was the image resized, but not the calibration's projection?" in out.replace(
        "\n" + " " * 22, " "
    )


def test_labels_of_a_tilted_camera_pass(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    """Labels and results written for a camera that looks 12 degrees down; nothing is moved."""
    dataset = KittiDataset(toy_kitti)
    truth = {name: dataset.annotations(name) for name in dataset.frame_ids()}
    tilted = Calibration(toy_calibration().projection, TILTED.calibration.lidar_to_camera)
    (tmp_path / "res").mkdir()
    for name, annotations in truth.items():
        write_calibration(toy_kitti / "training" / "calib" / f"{name}.txt", tilted)
        objects = from_annotations(annotations, tilted)
        write_objects(toy_kitti / "training" / "label_2" / f"{name}.txt", objects)
        scored = replace(objects, scores=np.full(len(objects), 0.9))
        write_objects(tmp_path / "res" / f"{name}.txt", scored)
    begin(curate, tmp_path / "w", toy_kitti, tmp_path / "res")
    code, out, err = curate("doctor", "--json", "-w", tmp_path / "w")
    assert code == 0, out + err
    found = {one["check"]: one for one in json.loads(out)["findings"]}
    assert found["camera"]["message"].startswith("yaw 0.0, pitch 12.0, roll 0.0 degrees")
    assert {name for name, one in found.items() if one["state"] != "ok"} == {"views"}
    code, _, err = curate("predict", "-w", tmp_path / "w")
    assert code == 0, err
    for table in ("ground_truth", "prediction"):
        sql = (
            f"SELECT f.frame, t.category, t.x, t.y, t.z, t.yaw FROM {table} t "
            "JOIN frame f ON f.id = t.frame_id ORDER BY f.frame, t.k"
        )
        rows = json.loads(curate("query", sql, "--json", "-w", tmp_path / "w")[1])
        assert rows
        for row in rows:
            right = truth[row["frame"]]
            box = right.boxes[right.categories == row["category"]][0]
            assert [row["x"], row["y"], row["z"]] == pytest.approx(box[:3], abs=1e-3)
            assert np.sin((row["yaw"] - box[6]) / 2) == pytest.approx(0, abs=1e-4)


def test_a_file_that_cannot_be_opened_is_a_finding(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """A pickle that would run code, or a damaged frame."""
    results = write_results(tmp_path / "a.pkl", toy_kitti)
    begin(curate, tmp_path / "w", toy_kitti, results)
    results.write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    code, out, _ = curate("doctor", "-w", tmp_path / "w")
    assert code == 1
    assert "rejected: the pickle imports os.system" in out
