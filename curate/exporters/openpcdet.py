"""Export labels as OpenPCDet's KITTI infos and object database, each object with its weight.

Source: OpenPCDet's KITTI data set (github.com/open-mmlab/OpenPCDet). DIRECTORY contains

    kitti_infos_train.pkl    a list with one dict per frame of X_l and X_u: point_cloud, image,
                             calib, annos
    kitti_dbinfos_train.pkl  the objects of X_l by category, for OpenPCDet's GT sampling
    gt_database/*.bin        the points of these objects, relative to the box centre

`annos` has additional arrays: `weight` (v; 1 for ground truth), `category`, `k`, `provenance`
(detector, human if a person decided, or ground_truth), and `ignored` (True for labels of weight 0
that are regions to ignore, False for those that are background). The `name` of
a label of weight 0 is DontCare, which OpenPCDet skips: a trainer that does not read the weights
treats all these labels as background, never as objects. `zero_weight` of export.json gives the
meaning of weight 0.

Annos are in the rectified camera frame (`location` is the bottom centre, `dimensions` are length,
height, width; `rotation_y` by OpenPCDet's formula, so that its own conversion gives the same boxes
in the LiDAR frame for every mounting of the camera). `gt_boxes_lidar` is (n, 7) at the box centre
in the LiDAR frame. R0_rect is the identity, and Tr_velo_to_cam is the complete transform from the
LiDAR to the rectified camera.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from curate.datasets.kitti.labels import DONT_CARE, KittiObjects, from_detections
from curate.detections import Detections
from curate.errors import ConfigError
from curate.exporters.base import DataToExport, LabelSet
from curate.exporters.folder import Streamed, write_folder, write_pickle
from curate.exporters.objects import (
    UNKNOWN,
    FrameObjects,
    difficulties,
    frame_batches,
    per_calibration,
)
from curate.frames import Frame
from curate.geometry.points_in_boxes import points_in_box_mask

_FORMAT = "curate weighted labels, OpenPCDet"
_DATABASE = "gt_database"
Info = dict[str, Any]


class OpenPCDetExporter:
    """An `Exporter` that writes OpenPCDet's infos and dbinfos."""

    name: ClassVar[str] = "openpcdet"
    suffix: ClassVar[str] = ""

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`.

        Raises:
            ConfigError: if the frames have no image size, which OpenPCDet's readers need.
            DataError: if the calibration, the image or the points of a frame cannot be read.
        """
        return int(write_folder(path, _FORMAT, partial(_fill, labels=labels))["labels"])

    def check_data(self, data: DataToExport) -> None:
        """See `curate.exporters.base.Selective`.

        Raises:
            ConfigError: if the frame has no image size.
        """
        _image_size(data.frame)


def _fill(folder: Path, labels: LabelSet) -> Mapping[str, Any]:
    (folder / _DATABASE).mkdir()
    database: dict[str, list[Info]] = {}
    facts = {"zero_weight": labels.description.zero_weight, "frames": 0, "labels": 0}
    infos = Streamed(_infos(folder, labels, database, facts))
    write_pickle(folder / "kitti_infos_train.pkl", infos)
    write_pickle(folder / "kitti_dbinfos_train.pkl", database)
    return facts


def _infos(
    folder: Path, labels: LabelSet, database: dict[str, list[Info]], facts: dict[str, Any]
) -> Iterator[Info]:
    """Yield the infos of all frames; cut out the objects of X_l, and count frames and labels."""

    def read(objects: FrameObjects) -> Frame:
        frame = (labels.read_points if objects.labeled else labels.read)(objects.frame_id)
        _image_size(frame)
        return frame

    for batch in frame_batches(labels, read):
        found = [(objects.detections, frame) for objects, frame in batch]
        in_camera = per_calibration(found, _in_camera)
        for (objects, frame), own in zip(batch, in_camera, strict=True):
            info = _info(objects, frame, own)
            if objects.labeled:
                _cut_out(folder, frame, info["annos"], database)
            facts["frames"] += 1
            facts["labels"] += 0 if objects.labeled else len(objects.weights)
            yield info


def _in_camera(found: Detections, frame: Frame) -> KittiObjects:
    return from_detections(found, frame.calibration, frame.image_size, "openpcdet")


def _image_size(frame: Frame) -> tuple[int, int]:
    if frame.image_size is None:
        raise ConfigError(
            f"frame {frame.frame_id}: OpenPCDet's infos need the size of the camera's image, and "
            "the data set has no camera; declare its image_size (docs/datasets.md), or export "
            "kitti, mmdet3d or csv"
        )
    return frame.image_size


def _info(objects: FrameObjects, frame: Frame, in_camera: KittiObjects) -> Info:
    width, height = _image_size(frame)
    last_row = np.array([[0.0, 0, 0, 1]])
    return {
        "point_cloud": {"num_features": 4, "lidar_idx": objects.frame_id},
        "image": {
            "image_idx": objects.frame_id,
            "image_shape": np.array([height, width], dtype=np.int32),
        },
        "calib": {
            "P2": np.concatenate([frame.calibration.projection, last_row]),
            "R0_rect": np.eye(4),
            "Tr_velo_to_cam": np.asarray(frame.calibration.lidar_to_camera),
        },
        "annos": _annos(objects, in_camera),
    }


def _annos(objects: FrameObjects, in_camera: KittiObjects) -> Info:
    """Return the arrays of a frame's objects, all of the same length."""
    found, count = objects.detections, len(objects.detections)
    names = np.where(objects.weights == 0, DONT_CARE, found.categories)
    return {
        "name": names,
        "category": found.categories,
        "k": objects.numbers,
        "provenance": objects.provenance,
        "weight": objects.weights,
        "ignored": objects.ignored,
        "truncated": objects.truncated,
        "occluded": objects.occluded,
        "alpha": in_camera.alpha,
        "bbox": in_camera.boxes_2d,
        "dimensions": in_camera.dimensions[:, [2, 0, 1]],
        "location": in_camera.locations,
        "rotation_y": in_camera.rotations_y,
        "score": np.full(count, float(UNKNOWN)) if objects.labeled else found.scores,
        "difficulty": difficulties(in_camera.boxes_2d, objects.truncated, objects.occluded),
        "index": np.arange(count, dtype=np.int32),
        "gt_boxes_lidar": found.boxes,
        "num_points_in_gt": objects.points.astype(np.int32),
    }


def _cut_out(folder: Path, frame: Frame, annos: Info, database: dict[str, list[Info]]) -> None:
    """Write the points of a labeled frame's objects and store their number in `annos`."""
    for k, box in enumerate(annos["gt_boxes_lidar"]):
        points = frame.points[points_in_box_mask(frame.points, box)].astype(np.float32)
        points[:, :3] -= box[:3].astype(np.float32)
        annos["num_points_in_gt"][k] = len(points)
        category = str(annos["category"][k])
        path = f"{_DATABASE}/{frame.frame_id}_{category}_{k}.bin"
        points.tofile(folder / path)
        entry = {
            "name": category,
            "path": path,
            "image_idx": frame.frame_id,
            "gt_idx": k,
            "box3d_lidar": box,
            "num_points_in_gt": len(points),
            "difficulty": int(annos["difficulty"][k]),
            "bbox": annos["bbox"][k],
            "score": float(annos["score"][k]),
            "weight": float(annos["weight"][k]),
        }
        database.setdefault(category, []).append(entry)
