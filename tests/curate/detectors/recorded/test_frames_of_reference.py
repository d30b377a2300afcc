"""One property for every recorded format: boxes written in it are read back unchanged.

The writers here do not use curate's conversions: they transform with scipy's rotations.
"""

import csv
import json
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from oracles.camera_boxes import in_camera, mmdetection3d_boxes, openpcdet_boxes
from scipy.spatial.transform import Rotation
from support.rigs import NAMES, Rig, assert_equal_boxes, detections, rigs
from support.strategies import similarities

from curate.detections import Detections, as_categories
from curate.detectors.recorded import RecordedDetector
from curate.detectors.recorded.formats import KINDS
from curate.errors import ConfigError, DataError
from curate.geometry.similarity import Similarity

FRAME = "000001"


def write_csv(path: Path, found: Detections, _rig: Rig) -> tuple[Path, dict]:
    """Write curate's own CSV."""
    header = "frame,category,score,x,y,z,length,width,height,yaw,view,flip_y,rotation_rad,scale"
    with path.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header.split(","))
        for box, score, name in rows_of(found):
            writer.writerow([FRAME, name, score, *box, 0, 0, 0, 1])
    return path.with_suffix(".csv"), {}


def write_parquet(path: Path, found: Detections, _rig: Rig) -> tuple[Path, dict]:
    """Write curate's own Parquet, with yaws outside (-pi, pi]."""
    arrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    order = ("x", "y", "z", "length", "width", "height", "yaw")
    columns = dict(zip(order, found.boxes.T, strict=True))
    columns["yaw"] = columns["yaw"] + 4 * np.pi
    names = {"frame": [FRAME] * len(found), "category": found.categories.tolist()}
    table = arrow.table(names | columns | {"score": found.scores})
    parquet.write_table(table, path.with_suffix(".parquet"))
    return path.with_suffix(".parquet"), {}


def write_kitti(path: Path, found: Detections, rig: Rig) -> tuple[Path, dict]:
    """Write camera frame, bottom centre, height width length, rotation_y by the calibration."""
    bottoms, rotations_y = in_camera(
        found.boxes, rig.turn, np.array(rig.origin), rig.yaw, upside_down=rig.upside_down
    )
    write_result_file(path, found, bottoms, rotations_y)
    return path, {}


def write_result_file(
    path: Path, found: Detections, bottoms: np.ndarray, rotations_y: np.ndarray
) -> None:
    """Write the result file of a frame."""
    lines = []
    for k, (box, score, name) in enumerate(rows_of(found)):
        numbers = (*box[5:2:-1], *bottoms[k], rotations_y[k], score)
        lines.append(f"{name} -1 -1 0 0 0 1 1 {' '.join(f'{number:.12f}' for number in numbers)}\n")
    path.mkdir()
    (path / f"{FRAME}.txt").write_text("".join(lines))


def write_openpcdet(path: Path, found: Detections, _rig: Rig) -> tuple[Path, dict]:
    """Write LiDAR boxes with velocities."""
    boxes = np.column_stack([found.boxes, np.ones((len(found), 2))])
    entry = {"frame_id": FRAME, "name": found.categories, "score": found.scores}
    path.with_suffix(".pkl").write_bytes(pickle.dumps([entry | {"boxes_lidar": boxes}]))
    return path.with_suffix(".pkl"), {}


def write_mmdetection3d(path: Path, found: Detections, _rig: Rig) -> tuple[Path, dict]:
    """Write bottom centres, and class numbers."""
    boxes = [[*box[:2], box[2] - box[5] / 2, *box[3:]] for box in found.boxes.tolist()]
    entry = {
        "frame_id": FRAME,
        "bboxes_3d": boxes,
        "scores_3d": found.scores.tolist(),
        "labels_3d": [NAMES.index(name) for name in found.categories],
    }
    path.with_suffix(".json").write_text(json.dumps([entry]))
    return path.with_suffix(".json"), {"classes": NAMES}


def write_nuscenes(path: Path, found: Detections, rig: Rig) -> tuple[Path, dict]:
    """Write map coordinates, width before length, a quaternion with w first."""
    turn, origin = rig.to_map
    results = []
    for box, score, name in rows_of(found):
        x, y, z, w = (turn * Rotation.from_euler("z", box[6])).as_quat().tolist()
        results.append({
            "translation": (turn.apply(box[:3]) + origin).tolist(),
            "size": [box[4], box[3], box[5]],
            "rotation": [w, x, y, z],
            "detection_name": {"Car": "car", "Pedestrian": "pedestrian"}.get(name, "bicycle"),
            "detection_score": score,
        })  # fmt: skip
    document = {"meta": {}, "results": {FRAME: results}}
    path.with_suffix(".json").write_text(json.dumps(document))
    return path.with_suffix(".json"), {}


WRITERS: dict[str, Callable[[Path, Detections, Rig], tuple[Path, dict]]] = {
    "csv": write_csv,
    "parquet": write_parquet,
    "kitti": write_kitti,
    "openpcdet": write_openpcdet,
    "mmdetection3d": write_mmdetection3d,
    "nuscenes": write_nuscenes,
}


def rows_of(found: Detections):
    """Return box, score and name of each detection."""
    return zip(found.boxes.tolist(), found.scores.tolist(), found.categories.tolist(), strict=True)


def assert_equal(one: Detections, other: Detections) -> None:
    """Check equality to a micrometre; yaw is compared as a direction."""
    assert_equal_boxes(one.boxes, other.boxes)
    assert ((one.boxes[:, 6] > -np.pi) & (one.boxes[:, 6] <= np.pi)).all()
    np.testing.assert_allclose(one.scores, other.scores, atol=1e-9)
    assert one.categories.tolist() == other.categories.tolist()


def test_every_format_has_a_writer() -> None:
    assert set(WRITERS) == set(KINDS)


@pytest.mark.parametrize("kind", WRITERS)
@settings(max_examples=15, deadline=None)
@given(found=detections, rig=rigs)
def test_boxes_are_read_back_unchanged(kind: str, found: Detections, rig: Rig) -> None:
    """Whatever frame of reference, origin, order of sizes and angle the format has."""
    with tempfile.TemporaryDirectory() as folder:
        path, options = WRITERS[kind](Path(folder) / "results", found, rig)
        record = RecordedDetector(path, **options)
        assert_equal(record.predict(rig.frame(FRAME)), found)


@pytest.mark.parametrize("kind", [kind for kind in WRITERS if kind not in ("csv", "parquet")])
@settings(max_examples=8, deadline=None)
@given(found=detections, rig=rigs, similarity=similarities.filter(lambda a: a != Similarity()))
def test_boxes_of_an_augmented_copy_are_read_back(
    kind: str, found: Detections, rig: Rig, similarity: Similarity
) -> None:
    """A second pass is written with the same sensors, and inverted afterwards."""
    # Scales from 0.1 to 10 move boxes beyond the accepted range.
    similarity = Similarity(similarity.flip_y, similarity.rotation_rad, 1.0)
    if similarity == Similarity():
        similarity = Similarity(flip_y=True)
    moved = Detections(similarity.apply_to_boxes(found.boxes), found.scores, found.categories)
    with tempfile.TemporaryDirectory() as folder:
        path, options = WRITERS[kind](Path(folder) / "results", found, rig)
        second, _ = WRITERS[kind](Path(folder) / "second", moved, rig)
        one = {"path": second.name, "flip_y": similarity.flip_y}
        one["rotation_rad"] = similarity.rotation_rad
        record = RecordedDetector(
            path, passes=[one], calibration=lambda _: rig.calibration, **options
        )
        [(told, seen)] = record.views(FRAME)
        back = Detections(told.invert_boxes(seen.boxes), seen.scores, seen.categories)
        assert_equal(back, found)


@pytest.mark.parametrize("kind", ["csv", "openpcdet", "mmdetection3d"])
def test_boxes_in_the_axes_of_nuscenes_sensor_are_read_back(kind: str, tmp_path: Path) -> None:
    """There x is to the right and y forward; camera and map coordinates do not change."""
    boxes = np.array([[12.0, 3.0, -0.8, 4.0, 1.8, 1.5, 0.3], [9.0, -4.0, 0.1, 1.0, 0.8, 1.7, 3.1]])
    found = Detections(boxes, np.array([0.9, 0.5]), as_categories(["Car", "Pedestrian"]))
    quarter = Rotation.from_euler("z", 90, degrees=True)
    there = np.column_stack([quarter.apply(boxes[:, :3]), boxes[:, 3:6], boxes[:, 6] + np.pi / 2])
    rig = Rig()
    written = Detections(there, found.scores, found.categories)
    path, options = WRITERS[kind](tmp_path / "results", written, rig)
    record = RecordedDetector(path, axes="right-forward", **options)
    assert_equal(record.predict(rig.frame(FRAME)), found)
    with pytest.raises(ConfigError, match="axes 'up': use one of forward-left, right-forward"):
        RecordedDetector(path, axes="up", **options)


@pytest.mark.parametrize("writer", ["openpcdet", "mmdetection3d", "view-of-delft"])
@settings(max_examples=15)
@given(found=detections, rig=rigs)
def test_results_by_the_formula_of_other_frameworks_are_read_back(
    writer: str, found: Detections, rig: Rig
) -> None:
    """They write rotation_y = -yaw - pi/2 whatever the calibration says, and declare it."""
    bottoms, _ = in_camera(found.boxes, rig.turn, np.array(rig.origin), 0, upside_down=False)
    rotations_y = -found.boxes[:, 6] - np.pi / 2
    # The formulas, to be sure that these files are those of the frameworks.
    lengths_first = found.boxes[:, [3, 5, 4]]
    matrix = rig.calibration.lidar_to_camera
    assert_equal_boxes(openpcdet_boxes(bottoms, lengths_first, rotations_y, matrix), found.boxes)
    standing = found.boxes - np.outer(found.boxes[:, 5] / 2, [0, 0, 1, 0, 0, 0, 0])
    camera_boxes = np.column_stack([bottoms, lengths_first, rotations_y])
    assert_equal_boxes(mmdetection3d_boxes(camera_boxes, matrix), standing)
    with tempfile.TemporaryDirectory() as folder:
        write_result_file(Path(folder) / "results", found, bottoms, rotations_y)
        record = RecordedDetector(Path(folder) / "results", rotation_y=writer)
        assert_equal(record.predict(rig.frame(FRAME)), found)


def test_an_unknown_meaning_of_rotation_y_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"use one of calibration, .*; did you mean 'openpcdet'"):
        RecordedDetector(tmp_path, rotation_y="OpenPCDet ")


def test_results_of_a_camera_on_its_side_are_rejected(tmp_path: Path) -> None:
    """Its rotation_y is not a heading; the message contains file and frame."""
    rig = Rig(roll=np.pi / 2)
    found = Detections(np.ones((1, 7)), np.ones(1), as_categories(["Car"]))
    path, _ = write_kitti(tmp_path / "results", found, rig)
    with pytest.raises(DataError, match=r"results: frame 000001: the camera's y axis is 0\.0 deg"):
        RecordedDetector(path).predict(rig.frame(FRAME))
