"""Writers of every recorded format, without curate's conversions: scipy's rotations transform."""

import csv
import json
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from oracles.camera_boxes import in_camera
from scipy.spatial.transform import Rotation

from curate.detections import Detections
from support.rigs import NAMES, Rig, assert_equal_boxes

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


def write_argoverse2(path: Path, found: Detections, _rig: Rig) -> tuple[Path, dict]:
    """Write Feather in the frame of the points, with quaternions and two record batches."""
    arrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    feather = pytest.importorskip("pyarrow.feather", reason="pyarrow is not installed")
    x, y, z, w = Rotation.from_euler("z", found.boxes[:, 6:]).as_quat().T
    names = ("tx_m", "ty_m", "tz_m", "length_m", "width_m", "height_m")
    table = arrow.table({
        **dict(zip(names, found.boxes.T, strict=False)),
        "qw": w, "qx": x, "qy": y, "qz": z, "score": found.scores,
        "log_id": ["0a8a4cfa"] * len(found),
        "timestamp_ns": np.full(len(found), int(FRAME)),
        "category": found.categories.tolist(),
    })  # fmt: skip
    feather.write_feather(table, path.with_suffix(".feather"), chunksize=2)
    return path.with_suffix(".feather"), {"frame_name": "{timestamp_ns:0>6}"}


def write_st3d(path: Path, found: Detections, _rig: Rig) -> tuple[Path, dict]:
    """Write class numbers from 1 and scores behind the box, 1.6 m higher, as with SHIFT_COOR."""
    numbers = [NAMES.index(name) + 1 for name in found.categories]
    boxes = np.column_stack([np.add(found.boxes, [0, 0, 1.6, 0, 0, 0, 0]), numbers, found.scores])
    entry = {"gt_boxes": boxes, "cls_scores": None, "iou_scores": None}
    entry["memory_counter"] = np.zeros(len(found))
    path.with_suffix(".pkl").write_bytes(pickle.dumps({FRAME: entry}))
    return path.with_suffix(".pkl"), {"classes": NAMES, "shift": [0.0, 0.0, 1.6]}


def write_old_mmdetection3d(path: Path, found: Detections, _rig: Rig) -> tuple[Path, dict]:
    """Write width before length, and a yaw that is 0 along -y and -pi/2 along x."""
    boxes = [
        [*box[:2], box[2] - box[5] / 2, box[4], box[3], box[5], -box[6] - np.pi / 2]
        for box in found.boxes.tolist()
    ]
    labels = np.array([NAMES.index(name) for name in found.categories])
    entry = {"boxes_3d": np.array(boxes), "scores_3d": found.scores, "labels_3d": labels}
    path.with_suffix(".pkl").write_bytes(pickle.dumps([{"pts_bbox": entry, "frame_id": FRAME}]))
    return path.with_suffix(".pkl"), {"classes": NAMES, "version": "0.x"}


WRITERS: dict[str, Callable[[Path, Detections, Rig], tuple[Path, dict]]] = {
    "csv": write_csv,
    "parquet": write_parquet,
    "kitti": write_kitti,
    "openpcdet": write_openpcdet,
    "mmdetection3d": write_mmdetection3d,
    "nuscenes": write_nuscenes,
    "argoverse2": write_argoverse2,
    "st3d": write_st3d,
    "mmdetection3d 0.x": write_old_mmdetection3d,
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
