"""Ground truth of nuScenes, brought from the map into the LiDAR's frame of reference.

Only the records of the frame that is asked for are decoded: those of other frames stay text.
"""

import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import numpy as np

from curate.datasets.nuscenes.names import category_of
from curate.datasets.nuscenes.tables import (
    Record,
    count,
    numbers,
    parse_record,
    quaternion,
    read_table,
    scan_table,
    text,
)
from curate.detections import Annotations, as_categories
from curate.errors import DataError
from curate.frames import Calibration
from curate.geometry.poses import boxes_in_frame
from curate.geometry.projection import image_rectangles
from curate.geometry.similarity import wrap_angle

# KITTI's occlusion by nuScenes' visibility in all cameras: up to 40, 60, 80, 100 percent.
_OCCLUDED = {"1": 2, "2": 1, "3": 1, "4": 0}
_UNKNOWN = 3
# Beyond so many widths and heights of the image, what is cut off does not count as more.
_AROUND = 10
_SAMPLE = re.compile(rb'"sample_token"\s*:\s*"([^"]*)"')


class AnnotationTable:
    """The table sample_annotation, from which single frames are read.

    Args:
        tables: its folder.
        rename: categories by name of the detection task's class.
        minimum_points: objects in which fewer LiDAR points were counted are left out.
    """

    def __init__(self, tables: Path, rename: Mapping[str, str], minimum_points: int) -> None:
        self.path = tables / "sample_annotation.json"
        self.tables = tables
        self.rename = rename
        self.minimum_points = minimum_points

    def read(
        self, token: str, calibration: Calibration, image_size: tuple[int, int]
    ) -> Annotations:
        """Return the objects of a frame that the camera sees, in the order of the table.

        Raises:
            DataError: if a table is missing or damaged, or a record cannot be.
        """
        records = [one for one in self._records(token) if self._counted(one)]
        boxes = self._boxes(records, calibration)
        categories = as_categories([self._category(one) for one in records])
        levels = [_OCCLUDED.get(str(one.get("visibility_token")), _UNKNOWN) for one in records]
        rectangles = image_rectangles(boxes, calibration, image_size)
        found = Annotations(
            boxes,
            categories,
            _truncation(boxes, rectangles, calibration, image_size),
            np.array(levels, dtype=np.int64),
            _observation_angles(boxes, calibration),
            rectangles,
        )
        return found.select(~np.isnan(rectangles).any(axis=1))

    def _records(self, token: str) -> list[Record]:
        with self.path.open("rb") as file:
            found = []
            for start, length in self._places.get(token, ()):
                file.seek(start)
                found.append(parse_record(self.path, file.read(length)))
        return found

    @cached_property
    def _places(self) -> Mapping[str, list[tuple[int, int]]]:
        """Where the records of each sample are in the file: first byte and length."""
        places: dict[str, list[tuple[int, int]]] = {}
        for start, content in scan_table(self.path):
            sample = _SAMPLE.search(content)
            if sample is None:
                raise DataError(f"{self.path}: the record at byte {start} has no sample_token")
            token = sample.group(1).decode(errors="replace")
            places.setdefault(token, []).append((start, len(content)))
        return places

    def _counted(self, record: Record) -> bool:
        return count(self.path, record, "num_lidar_pts") >= self.minimum_points

    def _boxes(self, records: list[Record], calibration: Calibration) -> np.ndarray:
        centres = [numbers(self.path, one, "translation", (3,)) for one in records]
        sizes = np.reshape([numbers(self.path, one, "size", (3,)) for one in records], (-1, 3))
        if (sizes <= 0).any():
            raise DataError(f"{self.path}: a size of {sizes.min():g} m; they are above 0")
        turns = [quaternion(self.path, one) for one in records]
        lengths_first = sizes[:, [1, 0, 2]]
        places = np.reshape(centres, (-1, 3)), lengths_first, np.reshape(turns, (-1, 4))
        return boxes_in_frame(*places, calibration.pose_in_map())

    def _category(self, record: Record) -> str:
        token = text(self.path, record, "instance_token")
        if token not in self._names:
            raise DataError(f"{self.tables / 'instance.json'}: no instance {token} with a category")
        return category_of(self._names[token], self.rename)

    @cached_property
    def _names(self) -> Mapping[str, str]:
        """General class of each instance."""
        path = self.tables / "category.json"
        names = {token: text(path, one, "name") for token, one in read_table(path).items()}
        path = self.tables / "instance.json"
        kinds = {
            token: text(path, one, "category_token") for token, one in read_table(path).items()
        }
        return {token: names[kind] for token, kind in kinds.items() if kind in names}


def _truncation(
    boxes: np.ndarray, rectangles: np.ndarray, calibration: Calibration, size: tuple[int, int]
) -> np.ndarray:
    """(n,) share of each projected box that lies outside the image; 1 where all of it does."""
    around = np.array(size) * _AROUND
    moved = np.eye(3)
    moved[:2, 2] = around
    wider = Calibration(moved @ calibration.projection, calibration.lidar_to_camera)
    width, height = (np.array(size) + 2 * around).tolist()
    whole = image_rectangles(boxes, wider, (width, height))
    share = _areas(rectangles) / np.maximum(_areas(whole), 1e-9)
    outside: np.ndarray = np.clip(1 - np.nan_to_num(share), 0, 1)
    return outside


def _areas(rectangles: np.ndarray) -> np.ndarray:
    """Return (n,) pixels."""
    areas: np.ndarray = np.prod(rectangles[:, 2:] - rectangles[:, :2], axis=1)
    return areas


def _observation_angles(boxes: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Return (n,) KITTI's alpha: the heading against the ray from the camera, radians."""
    to_camera = calibration.lidar_to_camera
    centres = boxes[:, :3] @ to_camera[:3, :3].T + to_camera[:3, 3]
    level = np.zeros(len(boxes))
    ahead = np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), level])
    ahead = ahead @ to_camera[:3, :3].T
    rotation_y = np.arctan2(-ahead[:, 2], ahead[:, 0])
    angles: np.ndarray = wrap_angle(rotation_y - np.arctan2(centres[:, 0], centres[:, 2]))
    return angles
