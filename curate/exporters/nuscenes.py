"""Export weighted labels of a nuScenes data set as results of nuScenes' detection task.

Source: nuScenes' detection task (nuscenes.org). The file is a JSON object with `meta` and
`results`. The results are lists of boxes by sample token: in the map frame, size as width, length,
height, rotation as w, x, y, z. Each box has the additional keys `weight` (v), `k` and
`provenance` (detector, or human if a person decided).

Labels of weight 0 are not in `results` but, in the same form, in `ignored` or `background`, which
nuScenes' tools do not read. `zero_weight` in `meta` gives the meaning of weight 0. Velocities are
unknown and written as 0.
"""

import json
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from curate.datasets.nuscenes.names import detection_name
from curate.errors import ConfigError, error_prefix
from curate.exporters.base import DataToExport, LabelSet
from curate.exporters.objects import FrameObjects, frame_objects
from curate.exporters.place import check_place, has_description
from curate.files.atomic import replace_file
from curate.frames import Calibration

_FORMAT = "curate weighted labels, nuScenes"


class NuScenesExporter:
    """An `Exporter` that writes the weighted labels of X_u as nuScenes results."""

    name: ClassVar[str] = "nuscenes"
    suffix: ClassVar[str] = ".json"

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`.

        Raises:
            ConfigError: if the data set has no poses, or a category does not exist in nuScenes.
            DataError: if the calibration of a frame cannot be read.
        """
        check_place(path, has_description("meta", _FORMAT))
        parts: dict[str, dict[str, list[dict[str, Any]]]] = {
            "results": {}, "ignored": {}, "background": {},
        }  # fmt: skip
        count = 0
        for objects in frame_objects(labels):
            if objects.labeled:
                continue
            boxes = _boxes(objects, labels.read(objects.frame_id).calibration)
            masks = (objects.weights > 0, objects.ignored, objects.background)
            for part, mask in zip(parts.values(), masks, strict=True):
                part[objects.frame_id] = [boxes[k] for k in np.flatnonzero(mask)]
            count += len(boxes)
        about = labels.description
        document = {
            "meta": {
                "use_camera": True,
                "use_lidar": True,
                "use_radar": False,
                "use_map": False,
                "use_external": False,
                "description": _FORMAT,
                "round": about.round,
                "policy": about.policy,
                "zero_weight": about.zero_weight,
                "version": about.code_version,
            },
            **parts,
        }
        replace_file(path, json.dumps(document, allow_nan=False).encode())
        return count

    def check_data(self, data: DataToExport) -> None:
        """See `curate.exporters.base.Selective`.

        Raises:
            ConfigError: if the data set has no poses, or a category does not exist in nuScenes.
        """
        data.frame.calibration.pose_in_map()
        for category in data.categories:
            _detection_name(category)


def _boxes(objects: FrameObjects, calibration: Calibration) -> list[dict[str, Any]]:
    """Return the labels of a frame as boxes in the map frame."""
    pose = calibration.pose_in_map()
    found = objects.detections
    centres = found.boxes[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    turns = _quaternions(pose, found.boxes[:, 6])
    return [
        {
            "sample_token": objects.frame_id,
            "translation": centres[k].tolist(),
            "size": found.boxes[k, [4, 3, 5]].tolist(),
            "rotation": turns[k].tolist(),
            "velocity": [0.0, 0.0],
            "detection_name": _name(objects, k),
            "detection_score": float(found.scores[k]),
            "attribute_name": "",
            "weight": float(objects.weights[k]),
            "k": int(objects.numbers[k]),
            "provenance": str(objects.provenance[k]),
        }
        for k in range(len(found))
    ]


def _quaternions(pose: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Return (n, 4) rotations w, x, y, z in the map frame, from yaws in the LiDAR frame."""
    if len(yaw) == 0:
        return np.zeros((0, 4))
    turns = Rotation.from_matrix(pose[:3, :3]) * Rotation.from_euler("z", yaw[:, None])
    return np.asarray(np.atleast_2d(turns.as_quat())[:, [3, 0, 1, 2]])


def _name(objects: FrameObjects, k: int) -> str:
    with error_prefix(f"frame {objects.frame_id}"):
        return _detection_name(str(objects.detections.categories[k]))


def _detection_name(category: str) -> str:
    name = detection_name(category)
    if name is None:
        raise ConfigError(
            f"category {category!r} is not in nuScenes' detection task; use nuScenes' categories "
            "in dataset.categories"
        )
    return name
