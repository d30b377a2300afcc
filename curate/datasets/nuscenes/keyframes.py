"""The key frames of nuScenes: one LiDAR sweep and one image each, with the poses of both sensors.

A LiDAR point is projected into the image through the map frame, because sweep and image are taken
at different times:

1. LiDAR to vehicle (calibrated_sensor),
2. vehicle to map (ego_pose at the time of the sweep),
3. map to vehicle (ego_pose at the time of the image),
4. vehicle to camera (calibrated_sensor).

nuScenes' LiDAR frame is x right, y forward, z up. Here its axes are permuted to x forward, y left,
z up.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curate.datasets.formats.images import MAX_PIXELS
from curate.datasets.nuscenes.tables import (
    Record,
    count,
    numbers,
    parse_record,
    pose,
    read_table,
    scan_table,
    text,
)
from curate.errors import ConfigError, DataError
from curate.frames import Calibration
from curate.geometry.poses import invert_pose

LIDAR = "LIDAR_TOP"
# Rotation from x forward, y left (ours) to x right, y forward (nuScenes).
TO_SENSOR_AXES = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])

_KEY = re.compile(rb'"is_key_frame"\s*:\s*true')
_TOKEN = re.compile(rb'"token"\s*:\s*"([^"]*)"')


@dataclass(frozen=True)
class Keyframe:
    """A sample with its sweep and image.

    Attributes:
        scene: name of the scene.
        points: path of the point file, relative to the root.
        image: path of the image, relative to the root.
        image_size: (width, height) in pixels.
        calibration: calibration of the camera, with the pose of the LiDAR in the map frame.
    """

    scene: str
    points: str
    image: str
    image_size: tuple[int, int]
    calibration: Calibration


@dataclass(frozen=True)
class _Sensor:
    """A mounted sensor: its channel, its (4, 4) transform to the vehicle frame, and its record."""

    channel: str
    to_vehicle: np.ndarray
    record: Record


def read_keyframes(tables: Path, camera: str) -> dict[str, Keyframe]:
    """Return the key frames with a sweep and an image of the camera, sorted by sample token.

    Args:
        tables: folder of the tables, such as v1.0-mini.
        camera: channel of the camera, such as CAM_FRONT.

    Raises:
        DataError: if a table is missing or damaged, or refers to a missing record.
        ConfigError: if there is no such camera.
    """
    sensors = _sensors(tables, camera)
    path = tables / "scene.json"
    scenes = {token: text(path, record, "name") for token, record in read_table(path).items()}
    path = tables / "sample.json"
    scene_of_sample = {
        token: text(path, record, "scene_token") for token, record in read_table(path).items()
    }
    path = tables / "sample_data.json"
    by_channel = _sensor_data(path, sensors)
    pairs = {token: pair for token, pair in sorted(by_channel.items()) if len(pair) == 2}
    needed = {
        text(path, record, "ego_pose_token") for pair in pairs.values() for record in pair.values()
    }
    vehicle = _vehicle_poses(tables / "ego_pose.json", needed)
    frames = {}
    for token, pair in pairs.items():
        scene = scenes.get(scene_of_sample.get(token, ""))
        if scene is None:
            raise DataError(
                f"{tables / 'sample.json'}: sample {token} is missing or has no valid scene"
            )
        frames[token] = _keyframe(tables, scene, pair[LIDAR], pair[camera], sensors, vehicle)
    return frames


def _sensors(tables: Path, camera: str) -> dict[str, _Sensor]:
    """Return the LiDARs and cameras of all vehicles, by token of calibrated_sensor."""
    path = tables / "sensor.json"
    channels = {token: text(path, record, "channel") for token, record in read_table(path).items()}
    cameras = sorted(name for name in channels.values() if name.startswith("CAM"))
    if camera not in cameras:
        raise ConfigError(f"dataset.options.camera '{camera}': use one of {', '.join(cameras)}")
    path = tables / "calibrated_sensor.json"
    sensors = {}
    for token, record in read_table(path).items():
        channel = channels.get(text(path, record, "sensor_token"), "")
        if channel in (LIDAR, camera):
            sensors[token] = _Sensor(channel, pose(path, record), record)
    return sensors


def _sensor_data(path: Path, sensors: Mapping[str, _Sensor]) -> dict[str, dict[str, Record]]:
    """Return the key frame records of these sensors, by sample token and channel."""
    by_sample: dict[str, dict[str, Record]] = {}
    for _, content in scan_table(path):
        if not _KEY.search(content):
            continue
        record = parse_record(path, content)
        sensor = sensors.get(text(path, record, "calibrated_sensor_token"))
        if sensor is not None:
            sample = text(path, record, "sample_token")
            by_sample.setdefault(sample, {})[sensor.channel] = record
    return by_sample


def _vehicle_poses(path: Path, needed: set[str]) -> dict[str, np.ndarray]:
    """Return the needed (4, 4) transforms from vehicle to map, by token of ego_pose."""
    poses = {}
    for _, content in scan_table(path):
        match = _TOKEN.search(content)
        token = match.group(1).decode(errors="replace") if match else ""
        if token in needed:
            poses[token] = pose(path, parse_record(path, content))
    missing = sorted(needed - set(poses))
    if missing:
        raise DataError(f"{path}: no record {missing[0]}, which sample_data.json refers to")
    return poses


def _keyframe(
    tables: Path,
    scene: str,
    sweep: Record,
    image: Record,
    sensors: Mapping[str, _Sensor],
    vehicle: Mapping[str, np.ndarray],
) -> Keyframe:
    lidar, camera = (sensors[record["calibrated_sensor_token"]] for record in (sweep, image))
    lidar_to_map = vehicle[sweep["ego_pose_token"]] @ lidar.to_vehicle @ TO_SENSOR_AXES
    camera_to_map = vehicle[image["ego_pose_token"]] @ camera.to_vehicle
    path = tables / "calibrated_sensor.json"
    intrinsic = numbers(path, camera.record, "camera_intrinsic", (3, 3))
    path = tables / "sample_data.json"
    return Keyframe(
        scene,
        text(path, sweep, "filename"),
        text(path, image, "filename"),
        _image_size(path, image),
        Calibration(
            projection=np.column_stack([intrinsic, np.zeros(3)]),
            lidar_to_camera=invert_pose(camera_to_map) @ lidar_to_map,
            lidar_to_map=lidar_to_map,
        ),
    )


def _image_size(path: Path, record: Record) -> tuple[int, int]:
    """Return (width, height) in pixels.

    Raises:
        DataError: if the size is missing, 0 or too large.
    """
    size = count(path, record, "width"), count(path, record, "height")
    if 0 in size or size[0] * size[1] > MAX_PIXELS:
        raise DataError(
            f"{path}: an image of {size[0]} x {size[1]} pixels, supported are 1 to {MAX_PIXELS}"
        )
    return size
