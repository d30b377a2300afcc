"""The key frames of nuScenes: a LiDAR sweep and an image per camera, with the sensors' poses.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curate.datasets.formats.images import MAX_PIXELS
from curate.datasets.nuscenes.tables import (
    Record,
    count,
    microseconds,
    numbers,
    parse_record,
    pose,
    read_table,
    scan_table,
    text,
)
from curate.errors import ConfigError, DataError
from curate.frames import Calibration, Camera
from curate.geometry.poses import invert_pose

LIDAR, FRONT_CAMERA = "LIDAR_TOP", "CAM_FRONT"
# Rotation from x forward, y left (ours) to x right, y forward (nuScenes).
TO_SENSOR_AXES = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])

_KEY = re.compile(rb'"is_key_frame"\s*:\s*true')
_TOKEN = re.compile(rb'"token"\s*:\s*"([^"]*)"')


@dataclass(frozen=True)
class Keyframe:
    """A sample with its sweep and the images of its cameras.

    Attributes:
        scene: name of the scene.
        time_s: time of the sample in seconds.
        points: path of the point file, relative to the root.
        images: paths of the images, relative to the root.
        cameras: the cameras in the same order, without images; the calibrations contain the pose of
            the LiDAR in the map frame.
    """

    scene: str
    time_s: float
    points: str
    images: tuple[str, ...]
    cameras: tuple[Camera, ...]


@dataclass(frozen=True)
class _Sensor:
    """A mounted sensor: its channel, its (4, 4) transform to the vehicle frame, and its record."""

    channel: str
    to_vehicle: np.ndarray
    record: Record


def read_keyframes(tables: Path, cameras: Sequence[str]) -> dict[str, Keyframe]:
    """Return the key frames with a sweep and an image of each camera, sorted by sample token.

    Args:
        tables: folder of the tables, such as v1.0-mini.
        cameras: channels of the cameras, such as CAM_FRONT.

    Raises:
        DataError: if a table is missing or damaged, or refers to a missing record.
    """
    sensors = _sensors(tables, cameras)
    path = tables / "scene.json"
    scenes = {token: text(path, record, "name") for token, record in read_table(path).items()}
    path = tables / "sample.json"
    samples = read_table(path)
    scene_of_sample = {
        token: text(path, record, "scene_token") for token, record in samples.items()
    }
    times = {token: microseconds(path, record) / 1e6 for token, record in samples.items()}
    path = tables / "sample_data.json"
    by_channel = _sensor_data(path, sensors)
    complete = {
        token: records
        for token, records in sorted(by_channel.items())
        if len(records) == 1 + len(cameras)
    }
    needed = {
        text(path, record, "ego_pose_token")
        for records in complete.values()
        for record in records.values()
    }
    vehicle = _vehicle_poses(tables / "ego_pose.json", needed)
    frames = {}
    for token, records in complete.items():
        scene = scenes.get(scene_of_sample.get(token, ""))
        if scene is None:
            raise DataError(
                f"{tables / 'sample.json'}: sample {token} is missing or has no valid scene"
            )
        images = [records[camera] for camera in cameras]
        frames[token] = _keyframe(
            tables, scene, times[token], records[LIDAR], images, sensors, vehicle
        )
    return frames


def choose_cameras(tables: Path, option: str, requested: str | Sequence[str]) -> tuple[str, ...]:
    """Return the channels of the requested cameras.

    Args:
        tables: folder of the tables.
        option: name of the option, for messages.
        requested: a channel, several channels, or "all", with the front camera first.

    Raises:
        DataError: if the table of sensors is missing or damaged.
        ConfigError: if there is no such camera, or one is listed twice.
    """
    path = tables / "sensor.json"
    channels = {text(path, record, "channel") for record in read_table(path).values()}
    known = sorted(name for name in channels if name.startswith("CAM"))
    known.sort(key=lambda name: name != FRONT_CAMERA)
    if requested == "all" and option == "cameras":
        return tuple(known)
    names = [requested] if isinstance(requested, str) else list(requested)
    for name in names or [""]:
        if name not in known:
            others = ', or "all"' if option == "cameras" else ""
            shown = ", ".join(sorted(known))
            raise ConfigError(f"dataset.options.{option} {name!r}: use one of {shown}{others}")
        if names.count(name) > 1:
            raise ConfigError(f"dataset.options.{option}: '{name}' is listed twice")
    return tuple(names)


def _sensors(tables: Path, cameras: Sequence[str]) -> dict[str, _Sensor]:
    """Return the LiDARs and cameras of all vehicles, by token of calibrated_sensor."""
    path = tables / "sensor.json"
    channels = {token: text(path, record, "channel") for token, record in read_table(path).items()}
    path = tables / "calibrated_sensor.json"
    sensors = {}
    for token, record in read_table(path).items():
        channel = channels.get(text(path, record, "sensor_token"), "")
        if channel in (LIDAR, *cameras):
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
    time_s: float,
    sweep: Record,
    images: Sequence[Record],
    sensors: Mapping[str, _Sensor],
    vehicle: Mapping[str, np.ndarray],
) -> Keyframe:
    lidar = sensors[sweep["calibrated_sensor_token"]]
    lidar_to_map = vehicle[sweep["ego_pose_token"]] @ lidar.to_vehicle @ TO_SENSOR_AXES
    path = tables / "sample_data.json"
    return Keyframe(
        scene,
        time_s,
        text(path, sweep, "filename"),
        tuple(text(path, image, "filename") for image in images),
        tuple(_camera(tables, image, lidar_to_map, sensors, vehicle) for image in images),
    )


def _camera(
    tables: Path,
    image: Record,
    lidar_to_map: np.ndarray,
    sensors: Mapping[str, _Sensor],
    vehicle: Mapping[str, np.ndarray],
) -> Camera:
    """Return the camera of an image, without its pixels."""
    camera = sensors[image["calibrated_sensor_token"]]
    camera_to_map = vehicle[image["ego_pose_token"]] @ camera.to_vehicle
    path = tables / "calibrated_sensor.json"
    intrinsic = numbers(path, camera.record, "camera_intrinsic", (3, 3))
    return Camera(
        camera.channel,
        Calibration(
            projection=np.column_stack([intrinsic, np.zeros(3)]),
            lidar_to_camera=invert_pose(camera_to_map) @ lidar_to_map,
            lidar_to_map=lidar_to_map,
        ),
        _image_size(tables / "sample_data.json", image),
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
