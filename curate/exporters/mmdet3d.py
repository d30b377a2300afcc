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
False if it is background), `k` and `provenance` (detector, human if a person decided, or
ground_truth). `zero_weight` in `metainfo` gives the meaning of weight 0.

Without a camera, `images` has the transforms of the reference calibration only: no path, no size.

KITTI's categories have the numbers of `KittiDataset`; other categories follow. R0_rect is the
identity, and Tr_velo_to_cam is the complete transform from the LiDAR to the rectified camera.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np

from curate.datasets.kitti.labels import KittiObjects, from_detections
from curate.detections import Detections
from curate.exporters.base import LabelSet
from curate.exporters.folder import Streamed, write_folder, write_pickle
from curate.exporters.objects import (
    FrameObjects,
    difficulties,
    frame_batches,
    per_calibration,
    rows_as_dicts,
)
from curate.frames import Frame
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
    about = labels.description
    known = dict.fromkeys((*_KITTI_ORDER, *about.categories))
    rest = sorted(set(labels.truth()["category"]) - set(known))
    numbers = {name: number for number, name in enumerate((*known, *rest))}
    facts = {"zero_weight": about.zero_weight, "frames": 0, "labels": 0}
    metainfo = {
        "categories": numbers,
        "dataset": about.dataset,
        "zero_weight": about.zero_weight,
        "info_version": "1.1",
    }
    # A category that only labels have gets its number when the first of them is written.
    document = {"data_list": Streamed(_infos(labels, numbers, facts)), "metainfo": metainfo}
    write_pickle(folder / "kitti_infos_train.pkl", document)
    return facts


def _infos(
    labels: LabelSet, numbers: dict[str, int], facts: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """Yield the infos of all frames, and count frames and labels."""
    for batch in frame_batches(labels, lambda objects: labels.read(objects.frame_id)):
        found = [(objects.detections, frame) for objects, frame in batch]
        in_camera = per_calibration(found, _in_camera)
        projected = per_calibration(found, _projected)
        for (objects, frame), own, pixels in zip(batch, in_camera, projected, strict=True):
            name = objects.frame_id
            index = int(name) if name.isdecimal() else facts["frames"]
            facts["frames"] += 1
            facts["labels"] += 0 if objects.labeled else len(objects.weights)
            yield _info(index, objects, frame) | {
                "instances": _instances(objects, own, pixels, numbers)
            }


def _in_camera(found: Detections, frame: Frame) -> KittiObjects:
    return from_detections(found, frame.calibration, frame.image_size, "mmdetection3d")


def _projected(found: Detections, frame: Frame) -> np.ndarray:
    """Return (n, 3) pixel and depth of the centres."""
    return np.column_stack(project_points(found.boxes, frame.calibration))


def _info(index: int, objects: FrameObjects, frame: Frame) -> dict[str, Any]:
    """Return the info of a frame without its instances."""
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
    }


def _instances(
    objects: FrameObjects, in_camera: KittiObjects, projected: np.ndarray, numbers: dict[str, int]
) -> list[dict[str, Any]]:
    """Return the objects of a frame.

    Args:
        objects: the objects.
        in_camera: the same in the camera frame.
        projected: (n, 3) pixel and depth of the centres.
        numbers: number of each category; new categories are added.
    """
    found, count = objects.detections, len(objects.detections)
    categories = found.categories.tolist()
    learned = (objects.weights > 0).tolist()
    labels = [
        numbers.setdefault(name, len(numbers)) if kept else _SKIPPED_LABEL
        for name, kept in zip(categories, learned, strict=True)
    ]
    boxes = [in_camera.locations, in_camera.dimensions[:, [2, 0, 1]], in_camera.rotations_y]
    columns = {
        "bbox": in_camera.boxes_2d,
        "bbox_label": labels,
        "bbox_3d": np.column_stack(boxes),
        "bbox_label_3d": labels,
        "depth": projected[:, 2],
        "center_2d": projected[:, :2],
        "num_lidar_pts": objects.points,
        "difficulty": difficulties(in_camera.boxes_2d, objects.truncated, objects.occluded),
        "truncated": objects.truncated,
        "occluded": objects.occluded,
        "alpha": in_camera.alpha,
        "score": found.scores,
        "index": range(count),
        "group_id": range(count),
        "weight": objects.weights,
        "ignored": objects.ignored,
        "category": categories,
        "k": objects.numbers,
        "provenance": objects.provenance,
    }
    return rows_as_dicts(columns)
