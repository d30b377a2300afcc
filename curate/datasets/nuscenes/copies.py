"""Copies of nuScenes' key frames, as they are or as A(x), in nuScenes' own layout.

The sweep keeps its mounting and its pose, so the map of a copy is A(x) carried there. Each camera
gets a mounting of its own in every sample, since each sample has its own A. Samples do not follow
each other in the vehicle's motion any more: records of sensor data have no `prev` and no `next`.
The tables of annotations are empty.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from curate.datasets.base import Dataset
from curate.datasets.formats.moved_clouds import move_cloud
from curate.datasets.formats.point_layout import PointLayout
from curate.datasets.nuscenes.keyframes import LIDAR, TO_SENSOR_AXES
from curate.datasets.nuscenes.tables import (
    Record,
    numbers,
    parse_record,
    pose,
    read_table,
    scan_table,
    text,
)
from curate.files.atomic import replace_file
from curate.files.links import is_linked, link_file
from curate.frames import Calibration
from curate.geometry.augmented_views import augmented_calibration
from curate.geometry.poses import invert_pose
from curate.geometry.projection import in_camera_view
from curate.geometry.similarity import Similarity

# Tables that copies share with the data set, and those that would contain ground truth.
_SHARED = ("attribute", "category", "visibility", "sensor", "log", "map")
_EMPTY = ("instance", "sample_annotation")


class _Source(Dataset, Protocol):
    """The data set of the key frames."""

    root: Path
    layout: PointLayout

    def check_path(self, name: str) -> None:
        """Raise DataError if the path of a file in the tables leads out of the data set."""
        ...


class NuScenesCopies:
    """Writes copies of key frames; see `curate.datasets.copies.CopyWriter`.

    All cameras in the tables are copied, not only those that the data set reads: tools need them.

    Args:
        dataset: the data set.
        tables: its folder of tables.
        folder: root of the copies.
        copies: A of each frame, None for a frame that is copied as it is.
        camera_view: whether only the points that a camera of the data set sees are written.
    """

    kind = "nuscenes"
    clouds = "samples/LIDAR_TOP"

    def __init__(
        self,
        dataset: _Source,
        tables: Path,
        folder: Path,
        copies: Mapping[str, Similarity | None],
        *,
        camera_view: bool,
    ) -> None:
        self._dataset = dataset
        self._tables = tables
        self._folder = folder
        self._copies = copies
        self._camera_view = camera_view
        self.frame_ids = tuple(sorted(copies))

    def prepare(self) -> None:
        """Write the tables."""
        home = self._folder / self._tables.name
        home.mkdir(parents=True, exist_ok=True)
        for name in _SHARED:
            if (self._tables / f"{name}.json").exists():
                link_file(self._tables / f"{name}.json", home / f"{name}.json")
        maps = self._tables / "map.json"
        for record in read_table(maps).values() if maps.exists() else ():
            name = text(maps, record, "filename")
            self._dataset.check_path(name)
            if (self._dataset.root / name).is_file():  # nuScenes' development kit opens them
                link_file(self._dataset.root / name, self._folder / name)
        scenes, samples = self._chains()
        data, mounted, used = self._sensor_data()
        poses = [record for record in self._vehicles.values() if record["token"] in used]
        tables: dict[str, Sequence[Record]] = {
            **dict.fromkeys(_EMPTY, ()),
            "scene": scenes, "sample": samples, "sample_data": data, "calibrated_sensor": mounted,
            "ego_pose": poses,
        }  # fmt: skip
        for name, records in tables.items():
            rows = ",\n".join(json.dumps(record) for record in records)
            replace_file(home / f"{name}.json", f"[\n{rows}\n]".encode() if rows else b"[]")

    def is_written(self, frame_id: str) -> bool:
        """Return whether the copy has a sweep, which is its last file, and its images."""
        return (self._folder / self._sweep(frame_id)).exists() and all(
            is_linked(source, self._folder / name) for name, source in self._images(frame_id)
        )

    def write(self, frame_id: str) -> None:
        """Link the images and write the sweep of a copy."""
        frame = self._dataset.read(frame_id)  # checks its files
        for name, source in self._images(frame_id):
            link_file(source, self._folder / name)
        source = self._dataset.files(frame_id).points
        target = self._folder / self._sweep(frame_id)
        similarity = self._copies[frame_id]
        if similarity is None and not self._camera_view:
            link_file(source, target)
            return
        move = (similarity or Similarity()).apply_to_points
        # nuScenes' axes are x right, y forward.
        turn = TO_SENSOR_AXES[:3, :3].astype(np.float32)
        move_cloud(
            source,
            target,
            self._dataset.layout,
            lambda points: move(points @ turn) @ turn.T,
            (lambda points: in_camera_view(frame.with_points(points @ turn)))
            if self._camera_view
            else None,
        )

    def _images(self, frame_id: str) -> Iterator[tuple[str, Path]]:
        """Yield the path of each image of a frame within the data set, and the file."""
        for record in self._records[frame_id].values():
            source = self._dataset.root / record["filename"]
            if record["filename"] != self._sweep(frame_id) and source.exists():
                yield record["filename"], source

    def _sweep(self, frame_id: str) -> str:
        """Return the path of a frame's sweep within the data set."""
        points = self._dataset.files(frame_id).points
        return points.relative_to(self._dataset.root).as_posix()

    @cached_property
    def _channels(self) -> Mapping[str, str]:
        """The channel of each record of calibrated_sensor."""
        path = self._tables / "sensor.json"
        names = {token: text(path, record, "channel") for token, record in read_table(path).items()}
        path = self._tables / "calibrated_sensor.json"
        return {
            token: names.get(text(path, record, "sensor_token"), "")
            for token, record in self._mounted.items()
        }

    @cached_property
    def _mounted(self) -> Mapping[str, Record]:
        return read_table(self._tables / "calibrated_sensor.json")

    @cached_property
    def _records(self) -> Mapping[str, Mapping[str, Record]]:
        """The key frame records of the LiDAR and the cameras, by sample and channel."""
        path = self._tables / "sample_data.json"
        found: dict[str, dict[str, Record]] = {frame: {} for frame in self.frame_ids}
        for _, content in scan_table(path):
            if b'"is_key_frame"' not in content or b"true" not in content:
                continue
            record = parse_record(path, content)
            sample = text(path, record, "sample_token")
            channel = self._channels.get(text(path, record, "calibrated_sensor_token"), "")
            wanted = channel == LIDAR or channel.startswith("CAM")
            if sample in found and wanted and record.get("is_key_frame") is True:
                # Paths of the tables are checked: a record must not lead out of the folder.
                self._dataset.check_path(text(path, record, "filename"))
                found[sample][channel] = record
        return found

    @cached_property
    def _vehicles(self) -> Mapping[str, Record]:
        """The poses of the vehicle that the copied records refer to."""
        path = self._tables / "sample_data.json"
        needed = {
            text(path, record, "ego_pose_token")
            for records in self._records.values()
            for record in records.values()
        }
        path = self._tables / "ego_pose.json"
        found = {}
        for _, content in scan_table(path):
            token = content.partition(b'"token"')[2].split(b'"', 2)[1:2]
            if token and token[0].decode(errors="replace") in needed:
                record = parse_record(path, content)
                found[text(path, record, "token")] = record
        return found

    def _chains(self) -> tuple[list[Record], list[Record]]:
        """Return the scenes and the samples of the copies; samples follow each other in time."""
        path = self._tables / "sample.json"
        by_scene: dict[str, list[dict[str, Any]]] = {}
        for token, record in read_table(path).items():
            if token in self._copies:
                by_scene.setdefault(text(path, record, "scene_token"), []).append(dict(record))
        scenes: list[Record] = []
        for token, scene in read_table(self._tables / "scene.json").items():
            members = sorted(by_scene.get(token, ()), key=lambda each: each.get("timestamp", 0))
            if not members:
                continue
            tokens = ["", *(each["token"] for each in members), ""]
            for number, member in enumerate(members):
                member |= {"prev": tokens[number], "next": tokens[number + 2]}
            ends = {"first_sample_token": tokens[1], "last_sample_token": tokens[-2]}
            scenes.append({**scene, "nbr_samples": len(members), **ends})
        return scenes, [record for members in by_scene.values() for record in members]

    def _sensor_data(self) -> tuple[list[Record], list[Record], set[str]]:
        """Return the records of sample_data and calibrated_sensor, and the used poses."""
        data: list[Record] = []
        mounted = {
            token: record
            for token, record in self._mounted.items()
            if self._channels[token] == LIDAR
        }
        used: set[str] = set()
        for frame_id in self.frame_ids:
            records = self._records[frame_id]
            for channel, record in records.items():
                changed = {**record, "prev": "", "next": ""}
                if channel != LIDAR:
                    changed |= {"ego_pose_token": records[LIDAR]["ego_pose_token"]}
                    changed |= {"calibrated_sensor_token": f"{frame_id}{channel}"}
                    own = self._mounting(records[LIDAR], record, self._copies[frame_id])
                    mounted[f"{frame_id}{channel}"] = own | {"token": f"{frame_id}{channel}"}
                data.append(changed)
                used.add(changed["ego_pose_token"])
        return data, list(mounted.values()), used

    def _mounting(
        self, sweep: Record, image: Record, similarity: Similarity | None
    ) -> dict[str, Any]:
        """Return the record of a camera in a copy, on the vehicle at the time of the sweep."""
        from scipy.spatial.transform import Rotation

        path = self._tables / "calibrated_sensor.json"
        vehicles = self._tables / "ego_pose.json"
        lidar, camera = (self._mounted[each["calibrated_sensor_token"]] for each in (sweep, image))
        to_vehicle = pose(path, lidar) @ TO_SENSOR_AXES
        lidar_to_map, camera_to_map = (
            pose(vehicles, self._vehicles[record["ego_pose_token"]]) @ transform
            for record, transform in ((sweep, to_vehicle), (image, pose(path, camera)))
        )
        intrinsic = numbers(path, camera, "camera_intrinsic", (3, 3))
        copied = augmented_calibration(
            Calibration(
                np.column_stack([intrinsic, np.zeros(3)]),
                invert_pose(camera_to_map) @ lidar_to_map,
            ),
            similarity or Similarity(),
        )
        mounting = to_vehicle @ invert_pose(copied.lidar_to_camera)
        x, y, z, w = Rotation.from_matrix(mounting[:3, :3]).as_quat().tolist()
        return {
            **camera,
            "translation": mounting[:3, 3].tolist(),
            "rotation": [w, x, y, z],
            "camera_intrinsic": copied.projection[:, :3].tolist(),
        }
