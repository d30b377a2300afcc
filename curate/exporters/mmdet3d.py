"""Labels as mmdetection3d infos of version 2, each instance with its weight.

Source: mmdetection3d's page on the KITTI data set (docs/en/advanced_guides/datasets/kitti.md).
DIRECTORY/kitti_infos_train.pkl, for `KittiDataset` and its `ann_file`, is a dict: `metainfo` with
`categories`, and `data_list` with a dict per frame of X_l and X_u. `bbox_3d` of an instance is x,
y, z of the bottom centre in the rectified camera frame, length, height, width, and the yaw about
the camera's y; `bbox_label_3d` is the category's number, -1 for a label of weight 0, which is
mmdetection3d's way to leave it out: to a trainer that reads no more, it is background. Three keys
are more than its own: `weight` (v; 1 for ground truth), `category`, and `ignored`, whether a label
of weight 0 is a region to ignore; otherwise it is background. `zero_weight` of `metainfo` says what
a weight of 0 means.

The numbers of KITTI's categories are those of `KittiDataset`; further categories follow.
R0_rect is the identity, Tr_velo_to_cam the whole way from the LiDAR to the rectified camera.
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
_LEFT_OUT = -1


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
    own = [name for name in about.categories if name not in _KITTI_ORDER]
    rest = sorted(categories_of(frames) - {*_KITTI_ORDER, *own})
    numbers = {name: number for number, name in enumerate((*_KITTI_ORDER, *own, *rest))}
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
    points, image = (PurePosixPath(file).name for file in objects.files)
    width, height = frame.image_size
    calibration = frame.calibration
    to_image = np.vstack([calibration.projection, [0, 0, 0, 1]])
    return {
        "sample_idx": index,
        "frame": objects.frame_id,
        "images": {
            "CAM2": {
                "img_path": image,
                "height": int(height),
                "width": int(width),
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
    image_size: tuple[int, int],
    numbers: Mapping[str, int],
) -> list[dict[str, Any]]:
    found = objects.detections
    shown = from_detections(found, calibration, image_size)
    centres, depths = project_points(found.boxes, calibration)
    levels = difficulties(shown.boxes_2d, objects.truncated, objects.occluded)
    lengths_first = shown.dimensions[:, [2, 0, 1]]
    instances = []
    for k in range(len(found)):
        category, weight = str(found.categories[k]), float(objects.weights[k])
        label = _LEFT_OUT if weight == 0 else numbers[category]
        box = (*shown.locations[k], *lengths_first[k], shown.rotations_y[k])
        instances.append(
            {
                "bbox": shown.boxes_2d[k].tolist(),
                "bbox_label": label,
                "bbox_3d": [float(number) for number in box],
                "bbox_label_3d": label,
                "depth": float(depths[k]),
                "center_2d": centres[k].tolist(),
                "num_lidar_pts": int(objects.points[k]),
                "difficulty": int(levels[k]),
                "truncated": float(objects.truncated[k]),
                "occluded": int(objects.occluded[k]),
                "alpha": float(shown.alpha[k]),
                "score": float(found.scores[k]),
                "index": k,
                "group_id": k,
                "weight": weight,
                "ignored": bool(objects.ignored[k]),
                "category": category,
            }
        )
    return instances
