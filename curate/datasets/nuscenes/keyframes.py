"""The key frames of nuScenes: one LiDAR sweep and one image each, with the poses of both sensors.

A point of the LiDAR comes into the image by way of the map: LiDAR to vehicle (calibrated_sensor),
vehicle to map (ego_pose at the time of the sweep), map to vehicle (ego_pose at the time of the
image), vehicle to camera. nuScenes' LiDAR looks along y (x right, y forward, z up); here its axes
are renamed to x forward, y left, z up.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curate.datasets.formats.images import MOST_PIXELS
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
# From x forward, y left to nuScenes' x right, y forward.
TO_SENSOR_AXES = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])

_KEY = re.compile(rb'"is_key_frame"\s*:\s*true')
_TOKEN = re.compile(rb'"token"\s*:\s*"([^"]*)"')


@dataclass(frozen=True)
class Keyframe:
    """A sample with its sweep and image.

    Attributes:
        scene: name of its scene.
        points: point file relative to the root.
        image: likewise.
        image_size: (width, height) in pixels.
        calibration: of the camera, with the pose of the LiDAR in the map.
    """

    scene: str
    points: str
    image: str
    image_size: tuple[int, int]
    calibration: Calibration


@dataclass(frozen=True)
class _Sensor:
    """A sensor as mounted: its channel, (4, 4) to the vehicle, and its record."""

    channel: str
    to_vehicle: np.ndarray
    record: Record


def read_keyframes(tables: Path, camera: str) -> dict[str, Keyframe]:
    """Return the key frames that have a sweep and an image of the camera, by sample token, sorted.

    Args:
        tables: folder of the tables, such as v1.0-mini.
        camera: channel, such as CAM_FRONT.

    Raises:
        DataError: if a table is missing or damaged, or refers to a record that is not there.
        ConfigError: if there is no such camera.
    """
    sensors = _sensors(tables, camera)
    path = tables / "scene.json"
    scenes = {token: text(path, one, "name") for token, one in read_table(path).items()}
    path = tables / "sample.json"
    of_sample = {token: text(path, one, "scene_token") for token, one in read_table(path).items()}
    pairs = _sensor_data(tables / "sample_data.json", sensors)
    both = {token: pair for token, pair in sorted(pairs.items()) if len(pair) == 2}
    path = tables / "sample_data.json"
    needed = {text(path, one, "ego_pose_token") for pair in both.values() for one in pair.values()}
    vehicle = _vehicle_poses(tables / "ego_pose.json", needed)
    frames = {}
    for token, pair in both.items():
        scene = scenes.get(of_sample.get(token, ""))
        if scene is None:
            raise DataError(f"{tables / 'sample.json'}: no sample {token}, or none with a scene")
        frames[token] = _keyframe(tables, scene, pair[LIDAR], pair[camera], sensors, vehicle)
    return frames


def _sensors(tables: Path, camera: str) -> dict[str, _Sensor]:
    """Return the LiDAR and the camera as mounted on each vehicle, by token of calibrated_sensor."""
    path = tables / "sensor.json"
    channels = {token: text(path, one, "channel") for token, one in read_table(path).items()}
    cameras = sorted(name for name in channels.values() if name.startswith("CAM"))
    if camera not in cameras:
        raise ConfigError(f"dataset.options.camera '{camera}': use one of {', '.join(cameras)}")
    path = tables / "calibrated_sensor.json"
    found = {}
    for token, record in read_table(path).items():
        channel = channels.get(text(path, record, "sensor_token"), "")
        if channel in (LIDAR, camera):
            found[token] = _Sensor(channel, pose(path, record), record)
    return found


def _sensor_data(path: Path, sensors: Mapping[str, _Sensor]) -> dict[str, dict[str, Record]]:
    """Return the records of key frames of these sensors, by sample token and channel."""
    found: dict[str, dict[str, Record]] = {}
    for _, content in scan_table(path):
        if not _KEY.search(content):
            continue
        record = parse_record(path, content)
        sensor = sensors.get(text(path, record, "calibrated_sensor_token"))
        if sensor is not None:
            sample = text(path, record, "sample_token")
            found.setdefault(sample, {})[sensor.channel] = record
    return found


def _vehicle_poses(path: Path, needed: set[str]) -> dict[str, np.ndarray]:
    """Return (4, 4) vehicle to map, by token of ego_pose."""
    found = {}
    for _, content in scan_table(path):
        match = _TOKEN.search(content)
        token = match.group(1).decode(errors="replace") if match else ""
        if token in needed:
            found[token] = pose(path, parse_record(path, content))
    missing = sorted(needed - set(found))
    if missing:
        raise DataError(f"{path}: no record {missing[0]}, which sample_data.json refers to")
    return found


def _keyframe(
    tables: Path,
    scene: str,
    sweep: Record,
    image: Record,
    sensors: Mapping[str, _Sensor],
    vehicle: Mapping[str, np.ndarray],
) -> Keyframe:
    lidar, camera = (sensors[one["calibrated_sensor_token"]] for one in (sweep, image))
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
    """Return (width, height) in pixels; DataError for none."""
    size = count(path, record, "width"), count(path, record, "height")
    if 0 in size or size[0] * size[1] > MOST_PIXELS:
        raise DataError(f"{path}: an image of {size[0]} x {size[1]} pixels")
    return size
