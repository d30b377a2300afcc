"""Export labels as mmdetection3d infos of version 2, each instance with its weight.

Source: mmdetection3d's page on the KITTI data set (docs/en/advanced_guides/datasets/kitti.md).
DIRECTORY/kitti_infos_train.pkl, to be used as `ann_file` of `KittiDataset`, is a dict: `metainfo`
with `categories`, and `data_list` with one dict per frame of X_l and X_u.

`bbox_3d` of an instance is x, y, z of the bottom centre in the rectified camera frame, length,
height, width, and rotation_y by mmdetection3d's formula, so that its own conversion gives the same
box in the LiDAR frame for every mounting of the camera. `bbox_label_3d` is the number of the
category. For a label of weight 0 it is -1: mmdetection3d skips such instances, so a trainer that
does not read the additional keys treats them as background. The additional keys are `weight` (v; 1
for ground truth), `category` and `ignored` (True if a label of weight 0 is a region to ignore,
False if it is background). `zero_weight` in `metainfo` gives the meaning of weight 0.

Without a camera, `images` has the transforms of the reference calibration only: no path, no size.

KITTI's categories have the numbers of `KittiDataset`; other categories follow. R0_rect is the
identity, and Tr_velo_to_cam is the complete transform from the LiDAR to the rectified camera.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np

from curate.datasets.kitti.labels import from_detections
from curate.exporters.base import LabelSet
from curate.exporters.folder import write_folder, write_pickle
from curate.exporters.objects import (
    FrameObjects,
    categories_of,
    count_labels,
    difficulties,
    frame_objects,
)
from curate.frames import Calibration, Frame
from curate.geometry.projection import project_points

_FORMAT = "curate weighted labels, mmdetection3d"
_KITTI_ORDER = (
    "Pedestrian", "Cyclist", "Car", "Van", "Truck", "Person_sitting", "Tram", "Misc",
)  # fmt: skip
_SKIPPED_LABEL = -1


class MMDet3DExporter:
    """An `Exporter` that writes mmdetection3d's infos."""

    name: ClassVar[str] = "mmdet3d"
    suffix: ClassVar[str] = ""

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`.

        Raises:
            DataError: if the calibration or the image of a frame cannot be read.
        """
        return int(write_folder(path, _FORMAT, partial(_fill, labels=labels))["labels"])


def _fill(folder: Path, labels: LabelSet) -> Mapping[str, Any]:
    about, frames = labels.description, list(frame_objects(labels))
    configured = [name for name in about.categories if name not in _KITTI_ORDER]
    rest = sorted(categories_of(frames) - {*_KITTI_ORDER, *configured})
    numbers = {name: number for number, name in enumerate((*_KITTI_ORDER, *configured, *rest))}
    infos = []
    for position, objects in enumerate(frames):
        name = objects.frame_id
        index = int(name) if name.isdecimal() else position
        infos.append(_info(index, objects, labels.read(name), numbers))
    metainfo = {
        "categories": numbers,
        "dataset": about.dataset,
        "zero_weight": about.zero_weight,
        "info_version": "1.1",
    }
    write_pickle(folder / "kitti_infos_train.pkl", {"metainfo": metainfo, "data_list": infos})
    return {
        "zero_weight": about.zero_weight,
        "frames": len(infos),
        "labels": count_labels(frames),
    }


def _info(
    index: int, objects: FrameObjects, frame: Frame, numbers: Mapping[str, int]
) -> dict[str, Any]:
    points, image, *_ = (*(PurePosixPath(file).name for file in objects.files), None)
    width, height = frame.image_size or (None, None)
    of_image = {"img_path": image, "height": height, "width": width}
    calibration = frame.calibration
    to_image = np.vstack([calibration.projection, [0, 0, 0, 1]])
    return {
        "sample_idx": index,
        "frame": objects.frame_id,
        "images": {
            "CAM2": {
                **{key: value for key, value in of_image.items() if value is not None},
                "cam2img": to_image.tolist(),
                "lidar2cam": calibration.lidar_to_camera.tolist(),
                "lidar2img": (to_image @ calibration.lidar_to_camera).tolist(),
            },
            "R0_rect": np.eye(4).tolist(),
        },
        "lidar_points": {
            "num_pts_feats": 4,
            "lidar_path": points,
            "Tr_velo_to_cam": calibration.lidar_to_camera.tolist(),
        },
        "instances": _instances(objects, calibration, frame.image_size, numbers),
    }


def _instances(
    objects: FrameObjects,
    calibration: Calibration,
    image_size: tuple[int, int] | None,
    numbers: Mapping[str, int],
) -> list[dict[str, Any]]:
    found = objects.detections
    in_camera = from_detections(found, calibration, image_size, "mmdetection3d")
    centres, depths = project_points(found.boxes, calibration)
    levels = difficulties(in_camera.boxes_2d, objects.truncated, objects.occluded)
    lengths_first = in_camera.dimensions[:, [2, 0, 1]]
    instances = []
    for k in range(len(found)):
        category, weight = str(found.categories[k]), float(objects.weights[k])
        label = _SKIPPED_LABEL if weight == 0 else numbers[category]
        box = (*in_camera.locations[k], *lengths_first[k], in_camera.rotations_y[k])
        instances.append(
            {
                "bbox": in_camera.boxes_2d[k].tolist(),
                "bbox_label": label,
                "bbox_3d": [float(number) for number in box],
                "bbox_label_3d": label,
                "depth": float(depths[k]),
                "center_2d": centres[k].tolist(),
                "num_lidar_pts": int(objects.points[k]),
                "difficulty": int(levels[k]),
                "truncated": float(objects.truncated[k]),
                "occluded": int(objects.occluded[k]),
                "alpha": float(in_camera.alpha[k]),
                "score": float(found.scores[k]),
                "index": k,
                "group_id": k,
                "weight": weight,
                "ignored": bool(objects.ignored[k]),
                "category": category,
            }
        )
    return instances
