"""Ground truth of nuScenes, transformed from the map frame to the LiDAR frame.

Only the records of the requested frame are parsed as JSON; the table is indexed by byte offsets.
"""

import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from curate.datasets.image_truth import seen_objects
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
from curate.frames import Calibration, Camera
from curate.geometry.poses import boxes_in_frame

# KITTI's occlusion level for nuScenes' visibility token (up to 40, 60, 80, 100 percent visible).
_OCCLUSION = {"1": 2, "2": 1, "3": 1, "4": 0}
_UNKNOWN = 3
_SAMPLE = re.compile(rb'"sample_token"\s*:\s*"([^"]*)"')


class AnnotationTable:
    """Reads the objects of single frames from the table sample_annotation.

    Args:
        tables: folder of the tables.
        rename: the category for each class of the detection task.
        minimum_points: objects with fewer LiDAR points (num_lidar_pts) are dropped.
    """

    def __init__(self, tables: Path, rename: Mapping[str, str], minimum_points: int) -> None:
        self.path = tables / "sample_annotation.json"
        self.tables = tables
        self.rename = rename
        self.minimum_points = minimum_points

    def read(self, token: str, cameras: Sequence[Camera]) -> Annotations:
        """Return the objects of a frame that any of its cameras sees, in the order of the table.

        An object's truncation, alpha and 2D box are those in the camera that shows most of it.

        Args:
            token: sample token of the frame.
            cameras: cameras of the frame; their calibrations contain the pose of the LiDAR.

        Raises:
            DataError: if a table is missing or damaged, or a record is invalid.
        """
        records = [record for record in self._records(token) if self._has_enough_points(record)]
        boxes = self._boxes(records, cameras[0].calibration)
        categories = as_categories([self._category(record) for record in records])
        visibilities = [str(record.get("visibility_token")) for record in records]
        levels = [_OCCLUSION.get(visibility, _UNKNOWN) for visibility in visibilities]
        return seen_objects(boxes, categories, np.array(levels, dtype=np.int64), cameras)

    def _records(self, token: str) -> list[Record]:
        with self.path.open("rb") as file:
            records = []
            for start, length in self._index.get(token, ()):
                file.seek(start)
                records.append(parse_record(self.path, file.read(length)))
        return records

    @cached_property
    def _index(self) -> Mapping[str, list[tuple[int, int]]]:
        """The byte offset and length of each record in the file, by sample token."""
        index: dict[str, list[tuple[int, int]]] = {}
        for start, content in scan_table(self.path):
            sample = _SAMPLE.search(content)
            if sample is None:
                raise DataError(f"{self.path}: the record at byte {start} has no sample_token")
            token = sample.group(1).decode(errors="replace")
            index.setdefault(token, []).append((start, len(content)))
        return index

    def _has_enough_points(self, record: Record) -> bool:
        return count(self.path, record, "num_lidar_pts") >= self.minimum_points

    def _boxes(self, records: list[Record], calibration: Calibration) -> np.ndarray:
        centres = [numbers(self.path, record, "translation", (3,)) for record in records]
        sizes = [numbers(self.path, record, "size", (3,)) for record in records]
        widths_first = np.reshape(sizes, (-1, 3))
        if (widths_first <= 0).any():
            raise DataError(f"{self.path}: a size of {widths_first.min():g} m; it must be above 0")
        rotations = [quaternion(self.path, record) for record in records]
        return boxes_in_frame(
            np.reshape(centres, (-1, 3)),
            widths_first[:, [1, 0, 2]],
            np.reshape(rotations, (-1, 4)),
            calibration.pose_in_map(),
        )

    def _category(self, record: Record) -> str:
        token = text(self.path, record, "instance_token")
        if token not in self._names:
            raise DataError(f"{self.tables / 'instance.json'}: no instance {token} with a category")
        return category_of(self._names[token], self.rename)

    @cached_property
    def _names(self) -> Mapping[str, str]:
        """The general class of each instance, such as vehicle.car."""
        path = self.tables / "category.json"
        names = {token: text(path, record, "name") for token, record in read_table(path).items()}
        path = self.tables / "instance.json"
        categories = {
            token: text(path, record, "category_token")
            for token, record in read_table(path).items()
        }
        return {token: names[of] for token, of in categories.items() if of in names}
