"""Export weighted labels of a nuScenes data set as results of nuScenes' detection task.

Source: nuScenes' detection task (nuscenes.org). The file is a JSON object with `meta` and
`results`. The results are lists of boxes by sample token: in the map frame, size as width, length,
height, rotation as w, x, y, z. Each box has the additional keys `weight` (v), `k` and
`provenance` (detector, or human if a person decided).

Labels of weight 0 are not in `results` but, in the same form, in `ignored` or `background`, which
nuScenes' tools do not read. `zero_weight` in `meta` gives the meaning of weight 0. Velocities are
unknown and written as 0.
"""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from curate.datasets.nuscenes.names import detection_name
from curate.errors import ConfigError, error_prefix
from curate.exporters.base import DataToExport, LabelSet
from curate.exporters.json_parts import JsonParts
from curate.exporters.objects import FrameObjects, frame_objects, rows_as_dicts
from curate.exporters.place import check_place, has_description
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
        about, count = labels.description, 0
        meta = {
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
        }
        with JsonParts(path, ("results", "ignored", "background"), "objects") as parts:
            for objects in frame_objects(labels):
                if objects.labeled:
                    continue
                boxes = _boxes(objects, labels.read(objects.frame_id).calibration)
                masks = {
                    "results": objects.weights > 0,
                    "ignored": objects.ignored,
                    "background": objects.background,
                }
                for part, mask in masks.items():
                    chosen = [boxes[k] for k in np.flatnonzero(mask).tolist()]
                    parts.add(part, {objects.frame_id: chosen})
                count += len(boxes)
            parts.finish({"meta": meta})
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
    count = len(found)
    with error_prefix(f"frame {objects.frame_id}"):
        names = [_detection_name(category) for category in found.categories.tolist()]
    return rows_as_dicts(
        {
            "sample_token": [objects.frame_id] * count,
            "translation": centres,
            "size": found.boxes[:, [4, 3, 5]],
            "rotation": turns,
            "velocity": [[0.0, 0.0]] * count,
            "detection_name": names,
            "detection_score": found.scores,
            "attribute_name": [""] * count,
            "weight": objects.weights,
            "k": objects.numbers,
            "provenance": objects.provenance,
        }
    )


def _quaternions(pose: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Return (n, 4) rotations w, x, y, z in the map frame, from yaws in the LiDAR frame."""
    if len(yaw) == 0:
        return np.zeros((0, 4))
    turns = Rotation.from_matrix(pose[:3, :3]) * Rotation.from_euler("z", yaw[:, None])
    return np.asarray(np.atleast_2d(turns.as_quat())[:, [3, 0, 1, 2]])


def _detection_name(category: str) -> str:
    name = detection_name(category)
    if name is None:
        raise ConfigError(
            f"category {category!r} is not in nuScenes' detection task; use nuScenes' categories "
            "in dataset.categories"
        )
    return name
