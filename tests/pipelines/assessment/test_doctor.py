"""The command that checks one frame."""

import json
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from oracles.camera_boxes import in_camera, openpcdet_boxes
from support.pipelines_cli import Curate
from support.rigs import TILTED, Rig, assert_equal_boxes
from support.toys import toy_calibration

from curate.datasets.kitti.calibration import write_calibration
from curate.datasets.kitti.dataset import KittiDataset
from curate.detections import Annotations
from curate.exporters.base import BOX_COLUMNS
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


def test_exchanged_front_and_rear_are_found_in_labeled_frames(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """Points cannot show it; frames without a result, and spare ones, do not matter."""
    turned = [0.0, 0, 0, 0, 0, 0, np.pi]
    results = write_results(tmp_path / "a.pkl", toy_kitti, lambda b: b + turned)
    begin(curate, tmp_path / "w", toy_kitti, results)
    code, out, _ = curate("doctor", "-w", tmp_path / "w")
    assert code == 1
    assert "wrong    headings" in out
    assert "if their yaw is yaw + pi (the front is the rear)" in out
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
    assert "there is no frame '999999'; the nearest are '" in err
    _, out, _ = curate("doctor", "3", "-w", tmp_path / "w")
    assert out.splitlines()[0] == "frame 000003"


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


def test_init_warns_of_labels_in_a_wrong_convention(
    curate: Curate, tmp_path: Path, toy_kitti: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Before any work; right labels get no warning."""
    results = write_results(tmp_path / "a.pkl", toy_kitti)
    begin(curate, tmp_path / "right", toy_kitti, results)
    assert "curate doctor" not in caplog.text
    change_labels(toy_kitti, lambda f: [*f[:9], f[10], f[9], *f[11:]])
    begin(curate, tmp_path / "swapped", toy_kitti, results)
    assert "length and width are swapped" in caplog.text
    assert "see `curate doctor`" in caplog.text


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


# Detections are not exactly the labels: those of unlabeled frames must not reach a detector.
AHEAD = np.array([0.3, 0, 0, 0, 0, 0, 0])


def label_lines(found: Annotations, boxes: np.ndarray, rig: Rig) -> list[str]:
    """Return boxes as lines of a label file, computed with scipy."""
    bottoms, rotations_y = in_camera(
        boxes, rig.turn, np.array(rig.origin), rig.yaw, upside_down=rig.upside_down
    )
    numbers = np.column_stack([boxes[:, 5:2:-1], bottoms, rotations_y])
    return [
        f"{category} 0 0 0 0 0 100 39 " + " ".join(f"{number:.5f}" for number in row)
        for category, row in zip(found.categories, numbers, strict=True)
    ]


def write_seen_by(rig: Rig, root: Path, results: Path) -> dict[str, Annotations]:
    """Move the camera of a toy data set, rewrite its labels, and write results.

    Returns:
        The ground truth in the LiDAR frame, by frame.
    """
    dataset = KittiDataset(root)
    truth = {name: dataset.annotations(name) for name in dataset.frame_ids()}
    calibration = Calibration(toy_calibration().projection, rig.calibration.lidar_to_camera)
    results.mkdir()
    for name, found in truth.items():
        write_calibration(root / "training" / "calib" / f"{name}.txt", calibration)
        lines = label_lines(found, found.boxes, rig)
        label = root / "training" / "label_2" / f"{name}.txt"
        label.write_text("".join(f"{line}\n" for line in lines))
        lines = label_lines(found, found.boxes + AHEAD, rig)
        (results / f"{name}.txt").write_text("".join(f"{line} 0.9\n" for line in lines))
    return truth


@pytest.mark.parametrize("rig", [TILTED, Rig(yaw=-0.4, pitch=0.3, roll=0.1)])
def test_labels_results_and_exports_of_a_tilted_camera(
    curate: Curate, tmp_path: Path, toy_kitti: Path, rig: Rig
) -> None:
    """Nothing is moved on the way from the files to the database and to files again."""
    truth = write_seen_by(rig, toy_kitti, tmp_path / "res")
    work = tmp_path / "w"
    code, _, err = curate(
        "init", work, "--root", toy_kitti, "--labeled", "0.25", "--detector", "recorded",
        "--detector-path", tmp_path / "res", "--set", "solve.self_paced=false",
        "--set", 'run.priors=["points"]',
    )  # fmt: skip
    assert code == 0, err
    code, out, err = curate("doctor", "--json", "-w", work)
    assert code == 0, out + err
    found = {one["check"]: one for one in json.loads(out)["findings"]}
    angles = [f"{np.rad2deg(angle):.1f}" for angle in (rig.yaw, rig.pitch, rig.roll)]
    expected = "yaw {}, pitch {}, roll {} degrees against the LiDAR".format(*angles)
    assert found["camera"]["message"].startswith(expected)
    # The toy labels all have the same 2D box.
    unclear = {"image", "label image"}
    assert {name for name, one in found.items() if one["state"] != "ok"} <= unclear

    for command in ("predict", "repredict", "score", "solve"):
        code, _, err = curate(command, "-w", work)
        assert code == 0, err
    for table, shift in (("ground_truth", 0 * AHEAD), ("prediction", AHEAD)):
        columns = ", ".join(f"t.{name}" for name in BOX_COLUMNS)
        sql = (
            f"SELECT f.frame, t.category, {columns} FROM {table} t "
            "JOIN frame f ON f.id = t.frame_id ORDER BY f.frame, t.k"
        )
        rows = json.loads(curate("query", sql, "--json", "-w", work)[1])
        assert rows
        for row in rows:
            right = truth[row["frame"]]
            box = right.boxes[right.categories == row["category"]]
            stored = np.array([[row[name] for name in BOX_COLUMNS]])
            assert_equal_boxes(stored, box + shift, 1e-4)

    code, _, err = curate("export", "--format", "openpcdet", "-w", work)
    assert code == 0, err
    [path] = (work / "exports").rglob("kitti_infos_train.pkl")
    for info in pickle.loads(path.read_bytes()):
        annos, calib = info["annos"], info["calib"]
        matrix = calib["R0_rect"] @ calib["Tr_velo_to_cam"]
        shape = (annos["location"], annos["dimensions"], annos["rotation_y"])
        shift = 0 * AHEAD if (annos["score"] < 0).all() else AHEAD
        right = truth[info["point_cloud"]["lidar_idx"]].boxes + shift
        assert_equal_boxes(openpcdet_boxes(*shape, matrix), right, 1e-4)
    code, _, err = curate("export", "--format", "kitti", "-w", work)
    assert code == 0, err
    for path in (work / "exports").rglob("label_2/*.txt"):
        lines = path.read_text().splitlines()
        original = (tmp_path / "res" / path.name).read_text().splitlines()
        assert len(lines) == 3
        for line, other in zip(lines, original, strict=True):
            numbers = [[float(field) for field in one.split()[8:15]] for one in (line, other)]
            assert numbers[0][:6] == pytest.approx(numbers[1][:6], abs=2e-4)
            assert np.sin((numbers[0][6] - numbers[1][6]) / 2) == pytest.approx(0, abs=1e-4)


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
