"""A tiny nuScenes dataset: all tables of its schema, rotated sensors, a moving vehicle.

Objects are placed in the LiDAR frame and transformed to the map by scipy's rotations. The reader
under test does the inverse with its own arithmetic, so an error in it shows.
"""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

CAMERAS = ("CAM_FRONT", "CAM_BACK")
IMAGE_SIZE = (160, 90)
INTRINSIC = [[80.0, 0, 80], [0, 80, 45], [0, 0, 1]]
# nuScenes' LiDAR has y forward and x right; its box yaw is ours plus a quarter turn.
QUARTER = Rotation.from_euler("z", 90, degrees=True)
OBJECTS = {
    "vehicle.car": (4.4, 1.9, 1.6),
    "human.pedestrian.adult": (0.7, 0.6, 1.8),
    "vehicle.bicycle": (1.8, 0.6, 1.4),
}


def token(*parts) -> str:
    """Return 32 hexadecimal digits, like nuScenes' tokens."""
    return hashlib.md5("/".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()


@dataclass(frozen=True)
class Mounted:
    """A sensor on the vehicle: channel, translation, rotation."""

    channel: str
    place: tuple[float, float, float]
    turn: Rotation

    def record(self, **more) -> dict:
        """Return its record of calibrated_sensor."""
        return {
            "token": token("mounted", self.channel),
            "sensor_token": token("sensor", self.channel),
            "translation": list(self.place),
            "rotation": scalar_first(self.turn),
            "camera_intrinsic": INTRINSIC if self.channel.startswith("CAM") else [],
        } | more


# x right, y forward, z up: the LiDAR's y is the vehicle's x; mounted slightly tilted.
LIDAR = Mounted(
    "LIDAR_TOP", (0.9, 0.1, 1.84), Rotation.from_euler("zyx", [-89.6, 0.9, -0.7], degrees=True)
)
# Camera frames have z forward, x right and y down.
FORWARD = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
MOUNTED = (
    LIDAR,
    Mounted("CAM_FRONT", (1.7, 0.0, 1.5), Rotation.from_euler("z", 1.5, degrees=True) * FORWARD),
    Mounted("CAM_BACK", (0.0, 0.1, 1.6), Rotation.from_euler("z", 179, degrees=True) * FORWARD),
)
# The angles of nuScenes' other cameras, to the left of the front.
SIDES = tuple(
    Mounted(
        f"CAM_{name}",
        (1.0, 0.0, 1.5),
        Rotation.from_euler("z", degrees, degrees=True) * FORWARD,
    )
    for name, degrees in (
        ("FRONT_LEFT", 55), ("FRONT_RIGHT", -55), ("BACK_LEFT", 110), ("BACK_RIGHT", -110),
    )
)  # fmt: skip


def scalar_first(turn: Rotation) -> list[float]:
    """Return w, x, y, z."""
    x, y, z, w = turn.as_quat().tolist()
    return [w, x, y, z]


@dataclass(frozen=True)
class Pose:
    """The pose of the vehicle in the map."""

    place: np.ndarray
    turn: Rotation


def vehicle_pose(scene: int, step: int, seconds: float = 0.0) -> Pose:
    """Return a pose on a curve, on a slightly tilted road, far from the map's origin."""
    along = 5.0 * (step * 0.5 + seconds)
    place = np.array([600.0 + 90 * scene + along, 1600.0 - 0.2 * along, 0.0])
    turn = Rotation.from_euler("zyx", [35.0 + 40 * scene + along, 1.2, -0.8], degrees=True)
    return Pose(place, turn)


def into_map(boxes: np.ndarray, pose: Pose, lidar: Mounted = LIDAR) -> list[dict]:
    """Return translation, size (width, length, height) and rotation of boxes in our LiDAR frame.

    Our LiDAR frame has x forward, a quarter turn from the sensor's own axes.
    """
    to_map = pose.turn * lidar.turn * QUARTER
    origin = pose.place + pose.turn.apply(lidar.place)
    return [
        {
            "translation": (origin + to_map.apply(box[:3])).tolist(),
            "size": [box[4], box[3], box[5]],
            "rotation": scalar_first(to_map * Rotation.from_euler("z", box[6])),
        }
        for box in np.asarray(boxes).tolist()
    ]


def into_camera(points: np.ndarray, scene: int, step: int, camera: Mounted) -> np.ndarray:
    """Return pixels and depth of points in our LiDAR frame, computed through the map."""
    sweep, shot = vehicle_pose(scene, step), vehicle_pose(scene, step, 0.05)
    to_map = sweep.turn * LIDAR.turn * QUARTER
    world = sweep.place + sweep.turn.apply(LIDAR.place) + to_map.apply(points)
    seen = camera.turn.inv().apply(shot.turn.inv().apply(world - shot.place) - camera.place)
    pixels = seen @ np.array(INTRINSIC).T
    return np.column_stack([pixels[:, :2] / pixels[:, 2:], pixels[:, 2]])


def drawn_boxes(scene: int, step: int) -> np.ndarray:
    """Return (4, 7) a car, a pedestrian and a bicycle ahead, a car behind, in our LiDAR frame."""
    rng = np.random.default_rng([scene, step])
    sizes = [OBJECTS["vehicle.car"], *list(OBJECTS.values())[1:], OBJECTS["vehicle.car"]]
    x = [14.0, 9.0, 11.0, -15.0]
    y = [-4.0, 0.5, 5.0, 2.0]
    return np.array([
        [x[i] + rng.uniform(-1, 1), y[i], -1.0, *sizes[i], rng.uniform(-3, 3)] for i in range(4)
    ])  # fmt: skip


NAMES = ("vehicle.car", "human.pedestrian.adult", "vehicle.bicycle", "vehicle.car")


def sweep_of(boxes: np.ndarray, seed: int) -> np.ndarray:
    """Return (n, 5) float32 as in a file: points in the boxes and on the ground, in sensor axes."""
    rng = np.random.default_rng(seed)
    clouds = [rng.uniform([-30, -30, -1.8], [30, 30, -1.8], (400, 3))]
    for box in boxes:
        inside = rng.uniform(-0.45, 0.45, (30, 3)) * box[3:6]
        clouds.append(Rotation.from_euler("z", box[6]).apply(inside) + box[:3])
    points = QUARTER.apply(np.concatenate(clouds))
    return np.column_stack([
        points, rng.integers(0, 256, len(points)), rng.integers(0, 32, len(points))
    ]).astype(np.float32)  # fmt: skip


def write_nuscenes(
    root: Path,
    scenes: tuple[str, ...] = ("scene-0061", "scene-0103"),
    steps: int = 2,
    version: str = "v1.0-mini",
    *,
    mounted: tuple[Mounted, ...] = MOUNTED,
) -> None:
    """Write two scenes of two key frames each, with sweeps between them, in nuScenes' layout."""
    tables: dict[str, list[dict]] = {
        "attribute": [{"token": token("moving"), "name": "vehicle.moving", "description": ""}],
        "calibrated_sensor": [each.record() for each in mounted],
        "category": [
            {"token": token("category", name), "name": name, "description": ""} for name in OBJECTS
        ],
        "ego_pose": [], "instance": [], "log": [], "map": [], "sample": [],
        "sample_annotation": [], "sample_data": [], "scene": [],
        "sensor": [
            {
                "token": token("sensor", each.channel),
                "channel": each.channel,
                "modality": "lidar" if each.channel == "LIDAR_TOP" else "camera",
            }
            for each in mounted
        ],
        "visibility": [
            {"token": str(i), "level": level, "description": ""}
            for i, level in enumerate(("v0-40", "v40-60", "v60-80", "v80-100"), start=1)
        ],
    }  # fmt: skip
    for number, name in enumerate(scenes):
        _add_scene(root, tables, number, name, steps, mounted)
    (root / version).mkdir(parents=True)
    for table, records in tables.items():
        (root / version / f"{table}.json").write_text(json.dumps(records, indent=0))


def sample_token(scene: str, step: int) -> str:
    """Return the token of a key frame."""
    return token("sample", scene, step)


def _add_scene(
    root: Path, tables: dict, number: int, name: str, steps: int, mounted: tuple[Mounted, ...]
) -> None:
    log = token("log", name)
    tables["log"].append(
        {"token": log, "logfile": name, "vehicle": "n008", "date_captured": "2018-08-01",
         "location": "boston-seaport"}
    )  # fmt: skip
    tables["map"].append(
        {"token": token("map", name), "log_tokens": [log], "category": "semantic_prior",
         "filename": "maps/none.png"}
    )  # fmt: skip
    samples = [sample_token(name, step) for step in range(steps)]
    tables["scene"].append(
        {"token": token("scene", name), "name": name, "description": "Turn {left}, wait",
         "log_token": log, "nbr_samples": steps, "first_sample_token": samples[0],
         "last_sample_token": samples[-1]}
    )  # fmt: skip
    for i, category in enumerate(NAMES):
        tables["instance"].append(
            {"token": token("instance", name, i), "category_token": token("category", category),
             "nbr_annotations": steps, "first_annotation_token": token("ann", samples[0], i),
             "last_annotation_token": token("ann", samples[-1], i)}
        )  # fmt: skip
    for step, sample in enumerate(samples):
        tables["sample"].append(
            {"token": sample, "timestamp": 10**15 + step * 500_000,
             "scene_token": token("scene", name), "prev": samples[step - 1] if step else "",
             "next": samples[step + 1] if step + 1 < steps else ""}
        )  # fmt: skip
        _add_sensor_data(root, tables, number, name, step, mounted)
        _add_annotations(tables, number, name, step, steps)


def _add_sensor_data(
    root: Path, tables: dict, number: int, name: str, step: int, mounted: tuple[Mounted, ...]
) -> None:
    sample = sample_token(name, step)
    for each in mounted:
        for key in (True, False):
            is_lidar = each.channel == "LIDAR_TOP"
            folder = f"{'samples' if key else 'sweeps'}/{each.channel}"
            file = f"{folder}/{name}__{each.channel}__{step}.{'pcd.bin' if is_lidar else 'jpg'}"
            seconds = (0.0 if is_lidar else 0.05) + (0.0 if key else 0.25)
            pose = vehicle_pose(number, step, seconds)
            own = token("data", file)
            tables["ego_pose"].append(
                {"token": token("pose", file), "translation": pose.place.tolist(),
                 "rotation": scalar_first(pose.turn), "timestamp": 10**15}
            )  # fmt: skip
            tables["sample_data"].append(
                {"token": own, "sample_token": sample, "ego_pose_token": token("pose", file),
                 "calibrated_sensor_token": token("mounted", each.channel),
                 "filename": file, "fileformat": "pcd" if is_lidar else "jpg",
                 "width": 0 if is_lidar else IMAGE_SIZE[0],
                 "height": 0 if is_lidar else IMAGE_SIZE[1],
                 "timestamp": 10**15, "is_key_frame": key, "prev": "", "next": ""}
            )  # fmt: skip
            if key:
                (root / folder).mkdir(parents=True, exist_ok=True)
                if is_lidar:
                    sweep_of(drawn_boxes(number, step), number * 100 + step).tofile(root / file)
                else:
                    pixels = np.full((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), 40 * step, np.uint8)
                    cv2.imwrite(str(root / file), pixels)


def _add_annotations(tables: dict, number: int, name: str, step: int, steps: int) -> None:
    sample = sample_token(name, step)
    boxes = into_map(drawn_boxes(number, step), vehicle_pose(number, step))
    for i, box in enumerate(boxes):
        tables["sample_annotation"].append(
            {"token": token("ann", sample, i), "sample_token": sample,
             "instance_token": token("instance", name, i), "visibility_token": str(i + 1),
             "attribute_tokens": [token("moving")], **box, "num_lidar_pts": 30 - i,
             "num_radar_pts": 0, "prev": "",
             "next": token("ann", sample_token(name, step + 1), i) if step + 1 < steps else ""}
        )  # fmt: skip
