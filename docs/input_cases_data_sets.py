"""Data sets, tracking labels, tracklets and calibrations with variations; see `input_cases`."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curate.datasets.folder import FolderDataset
from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.raw import KittiRawDataset
from curate.datasets.kitti.tracking import KittiTrackingDataset
from curate.datasets.nuscenes.dataset import NuScenesDataset
from curate.frames import Frame
from docs.input_cases_clouds import PIXELS, POINTS, encoded
from docs.input_reader import Case, Content, Reader, text_cases

Files = Sequence[tuple[str, Content]]

CAR = "Car 0.00 0 1.55 614.24 181.78 727.31 284.77 1.57 1.73 4.15 1.00 1.75 13.22 1.62"
WALKER = "Pedestrian 0.10 1 -0.20 712.40 143.00 810.73 307.92 1.89 0.48 1.20 1.84 1.47 8.41 0.01"
CALIBRATION = """\
P2: 700 0 600 40 0 700 180 0.2 0 0 1 0.003
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3
"""
VELODYNE = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.1 -0.3\n"
CAMERAS = "R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: 700 0 600 40 0 700 180 0 0 0 1 0\n"
FOLDER = """\
points = "lidar"
images = "camera"
[calibration]
projection = [[700.0, 0, 60, 0], [0, 700, 20, 0], [0, 0, 1, 0]]
lidar_to_camera = [[0.0, -1, 0, 0], [0, 0, -1, -0.1], [1, 0, 0, -0.3]]
"""
_SWEEP, _IMAGE = POINTS.tobytes(), encoded(PIXELS)
_DRIVE = "2011_09_26/2011_09_26_drive_0001_sync"
_TRACKS = f"0 1 {CAR}\n0 -1 DontCare -1 -1 -10 503 169 590 190 -1 -1 -1 -1000 -1000 -1000 -10\n"


def _content(frame: Frame) -> Any:
    return frame.frame_id, frame.points, frame.calibration, frame.image_size, frame.image


def _kitti(path: Path, **options: Any) -> Any:
    dataset = KittiDataset(path.parents[2], **options)
    return [(_content(dataset.read(name, image=True)), dataset.annotations(name))
            for name in dataset.frame_ids()]  # fmt: skip


def _tracking(path: Path) -> Any:
    dataset = KittiTrackingDataset(path.parents[1])
    return [dataset.annotations(name) for name in dataset.frame_ids()]


def _tracking_frames(path: Path) -> Any:
    dataset = KittiTrackingDataset(path.parents[2])
    return [_content(dataset.read(name, image=True)) for name in dataset.frame_ids()]


def _raw(path: Path) -> Any:
    """Return the frames of a drive, and the labels if it has tracklets."""
    drive = next(parent for parent in path.parents if parent.name.startswith("2011_09_26_drive"))
    dataset = KittiRawDataset(drive.parents[1])
    names = dataset.frame_ids()
    truth = [dataset.annotations(name) for name in names] if path.suffix == ".xml" else []
    return [_content(dataset.read(name, image=True)) for name in names], truth


def read_folder(path: Path) -> Any:
    """Return the frames of the folder with a dataset.toml."""
    dataset = FolderDataset(path.parent)
    return [dataset.read(name) for name in dataset.frame_ids()]


def _pair_cases(points: str, image: str) -> Iterable[Case]:
    """Return variations of the files of one frame, whose paths have no suffix."""
    jpeg = encoded(PIXELS, ".jpg")
    return [
        Case("the suffix .BIN", _SWEEP, name=f"{points}.BIN"),
        Case("two point files of one frame", _SWEEP, beside=[(f"{points}.npy", b"")]),
        Case("two images of one frame", _SWEEP, beside=[(f"{image}.jpg", jpeg)]),
    ]


_KITTI_FILES: Files = (
    ("training/image_2/000001.png", _IMAGE),
    ("training/calib/000001.txt", CALIBRATION),
    ("training/label_2/000001.txt", f"{CAR}\n"),
)
_TRACKING_FILES: Files = (
    ("training/image_02/0000/000000.png", _IMAGE), ("training/calib/0000.txt", CALIBRATION),
    ("training/velodyne/0000/000000.bin", _SWEEP), ("training/label_02/0000.txt", _TRACKS),
)  # fmt: skip
_RAW_FILES: Files = (
    ("2011_09_26/calib_velo_to_cam.txt", VELODYNE), ("2011_09_26/calib_cam_to_cam.txt", CAMERAS),
    (f"{_DRIVE}/image_02/data/0000000000.png", _IMAGE),
    (f"{_DRIVE}/velodyne_points/data/0000000000.bin", _SWEEP),
)  # fmt: skip
_POSE = "".join(
    f"<{name}>{value}</{name}>" for name, value in (
        ("tx", 20), ("ty", 1), ("tz", -1.7), ("rx", 0), ("ry", 0), ("rz", 0.1), ("state", 2),
        ("occlusion", 0), ("occlusion_kf", 0), ("truncation", 0),
    )
)  # fmt: skip
_TRACKLETS = f"""<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<boost_serialization signature="serialization::archive" version="9">
<tracklets><count>1</count><item_version>1</item_version><item>
<objectType>Car</objectType><h>1.5</h><w>1.6</w><l>4.0</l><first_frame>0</first_frame>
<poses><count>1</count><item_version>2</item_version><item>{_POSE}</item></poses>
<finished>1</finished>
</item></tracklets>
</boost_serialization>
"""
_WAYMO = """\
P0: 700 0 600 0 0 700 180 0 0 0 1 0
P2: 700 0 600 0 0 700 180 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam_0: 0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3
Tr_velo_to_cam_2: 0.6 -0.8 0 0 0 0 -1 -0.1 0.8 0.6 0 -0.3
"""
_ODOMETRY = """\
P0: 700 0 600 0 0 700 180 0 0 0 1 0
P2: 700 0 600 40 0 700 180 0.2 0 0 1 0.003
Tr: 0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3
"""
_TURN = {"rotation": [1.0, 0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]}
_NUSCENES = {
    "attribute": [], "log": [], "map": [], "visibility": [{"token": "4", "level": "v80-100"}],
    "calibrated_sensor": [
        {"token": "m1", "sensor_token": "s1", "camera_intrinsic": [], **_TURN},
        {"token": "m2", "sensor_token": "s2", "translation": [0.0, 0.0, 0.0],
         "rotation": [0.5, -0.5, 0.5, -0.5],
         "camera_intrinsic": [[60.0, 0, 60], [0, 60, 20], [0, 0, 1]]},
    ],
    "category": [{"token": "c1", "name": "vehicle.car", "description": ""}],
    "ego_pose": [{"token": "e1", "timestamp": 1, **_TURN}],
    "instance": [{"token": "i1", "category_token": "c1"}],
    "sample": [{"token": "f1", "timestamp": 1, "scene_token": "n1", "prev": "", "next": ""}],
    "sample_annotation": [
        {"token": "a1", "sample_token": "f1", "instance_token": "i1", "visibility_token": "4",
         "attribute_tokens": [], "translation": [20.0, 1.0, -1.0], "size": [1.8, 4.0, 1.6],
         "rotation": [1.0, 0.0, 0.0, 0.0], "num_lidar_pts": 9, "num_radar_pts": 0,
         "prev": "", "next": ""},
    ],
    "sample_data": [
        {"token": f"d{number}", "sample_token": "f1", "ego_pose_token": "e1",
         "calibrated_sensor_token": f"m{number}", "filename": file, "fileformat": kind,
         "width": width, "height": height, "timestamp": 1, "is_key_frame": True, "prev": "",
         "next": ""}
        for number, file, kind, width, height in (
            (1, "samples/LIDAR_TOP/a.pcd.bin", "pcd", 0, 0),
            (2, "samples/CAM_FRONT/a.jpg", "jpg", 120, 40),
        )
    ],
    "scene": [{"token": "n1", "name": "scene-0001", "log_token": "l1", "nbr_samples": 1,
               "first_sample_token": "f1", "last_sample_token": "f1"}],
    "sensor": [{"token": "s1", "channel": "LIDAR_TOP", "modality": "lidar"},
               {"token": "s2", "channel": "CAM_FRONT", "modality": "camera"}],
}  # fmt: skip
_RINGS = np.column_stack([POINTS[:, :3], POINTS[:, 3:] * 255, np.zeros((3, 1))]).astype("<f4")
_NUSCENES_FILES: Files = (
    ("samples/LIDAR_TOP/a.pcd.bin", _RINGS.tobytes()),
    ("samples/CAM_FRONT/a.jpg", encoded(PIXELS, ".jpg")),
    *((f"v1.0-mini/{name}.json", json.dumps(table)) for name, table in _NUSCENES.items()),
)
_ANNOTATIONS = json.dumps(_NUSCENES["sample_annotation"])


def _nuscenes(path: Path) -> Any:
    dataset = NuScenesDataset(path.parents[1])
    return [(_content(dataset.read(name, image=True)), dataset.annotations(name))
            for name in dataset.frame_ids()]  # fmt: skip


DATA_SETS = (
    Reader(
        "Data set kitti", "The files of a frame in KITTI's layout.",
        "training/velodyne/000001.bin", _kitti, _SWEEP,
        [
            *_pair_cases("training/velodyne/000001", "training/image_2/000001"),
            Case("a frame without an image", _SWEEP, beside=[
                ("training/velodyne/000002.bin", _SWEEP),
                ("training/calib/000002.txt", CALIBRATION)]),
            Case("frames not numbered with six digits", _SWEEP, other=True,
                 name="training/velodyne/1.bin", beside=[
                     ("training/image_2/1.png", _IMAGE), ("training/calib/1.txt", CALIBRATION),
                     ("training/label_2/1.txt", CAR)]),
            Case("image_size for a data set with images", _SWEEP,
                 options={"image_size": (120, 40)}),
            Case("no calibration", _SWEEP, beside=[
                ("training/velodyne/000003.bin", _SWEEP),
                ("training/image_2/000003.png", _IMAGE)]),
        ],
        _KITTI_FILES,
    ),
    Reader(
        "Data set kitti without images", "Only points, calibration and labels.",
        "training/velodyne/000001.bin", _kitti, _SWEEP,
        [
            Case("with `image_size`: the camera is used without pixels", _SWEEP, other=True,
                 options={"image_size": (120, 40)}),
            Case("an empty folder image_2", _SWEEP, beside=[("training/image_2/.keep", b"")]),
            Case("an image_size that is not [width, height]", _SWEEP,
                 options={"image_size": (0, 40)}),
            Case("a camera without a folder of images", _SWEEP, options={"camera": 3}),
        ],
        _KITTI_FILES[1:],
    ),
    Reader(
        "Data set kitti-tracking", "The files of a frame in the layout of KITTI tracking.",
        "training/velodyne/0000/000000.bin", _tracking_frames, _SWEEP,
        _pair_cases("training/velodyne/0000/000000", "training/image_02/0000/000000"),
        [file for file in _TRACKING_FILES if not file[0].endswith(".bin")],
    ),
    Reader(
        "KITTI tracking labels",
        "`label_02/SEQUENCE.txt`: the numbers of frame and track, then the fields of a label.",
        "label_02/0000.txt", _tracking, _TRACKS,
        [
            *text_cases(_TRACKS),
            Case("18 fields, the last is a score", _TRACKS.replace("\n", " 0.5\n")),
            Case("15 fields: no frame and no track", f"{CAR}\n"),
            Case("a frame that is not a number", _TRACKS.replace("0 1 Car", "zero 1 Car")),
            Case("a line of a frame without points is left out", f"{_TRACKS}7 1 {CAR}\n"),
            Case("lines in another order", f"7 1 {CAR}\n{_TRACKS}"),
        ],
        [(name.removeprefix("training/"), content) for name, content in _TRACKING_FILES[:3]],
    ),
    Reader(
        "Data set kitti-raw", "The files of a frame in the layout of KITTI raw.",
        f"{_DRIVE}/velodyne_points/data/0000000000.bin", _raw, _SWEEP,
        _pair_cases(f"{_DRIVE}/velodyne_points/data/0000000000",
                    f"{_DRIVE}/image_02/data/0000000000"),
        _RAW_FILES[:3],
    ),
    Reader(
        "tracklet_labels.xml", "The labels of a drive of KITTI raw.",
        f"{_DRIVE}/tracklet_labels.xml", _raw, _TRACKLETS,
        [
            *text_cases(_TRACKLETS),
            Case("no DOCTYPE", _TRACKLETS.replace("<!DOCTYPE boost_serialization>\n", "")),
            Case("entities are declared", _TRACKLETS.replace(
                "boost_serialization>", 'boost_serialization [<!ENTITY a "b">]>', 1)),
            Case("a size is missing", _TRACKLETS.replace("<h>1.5</h>", "")),
            Case("a word in place of a number", _TRACKLETS.replace("1.5", "high")),
            Case("a side of length 0", _TRACKLETS.replace("4.0", "0")),
            Case("turned about x", _TRACKLETS.replace("<rx>0<", "<rx>0.5<")),
            Case("no objects", "".join(
                _TRACKLETS.partition("<item>")[::2]).partition("<objectType>")[0]
                + "</tracklets></boost_serialization>", other=True),
            Case("the file ends early", _TRACKLETS[:-60]),
        ],
        _RAW_FILES,
    ),
    Reader(
        "Calibration of Waymo conversions",
        "`calib/FRAME.txt` with a `Tr_velo_to_cam_N` for each camera; here camera 2.",
        "calib/0000001.txt", lambda path: read_calibration(path, 2), _WAYMO,
        [
            Case("a matrix of another camera besides", f"{_WAYMO}P4: 1 0 0 0 0 1 0 0 0 0 1 0\n"),
            Case("no projection of the camera", _WAYMO.replace("P2", "P3")),
            Case("only the extrinsic of another camera", _WAYMO.replace("cam_2", "cam_3")),
        ],
    ),
    Reader(
        "Calibration of KITTI odometry", "`calib.txt` with `Tr` into the rectified camera.",
        "calib.txt", read_calibration, _ODOMETRY,
        [
            Case("4 x 4 numbers", _ODOMETRY.replace("-0.3\n", "-0.3 0 0 0 1\n")),
            Case("names without colon", _ODOMETRY.replace(":", "")),
            Case("no Tr", _ODOMETRY.replace("Tr:", "Tx:")),
            Case("two names with different numbers", _ODOMETRY + "P_rect_02: 1" + " 0" * 11 + "\n"),
        ],
    ),
    Reader(
        "Data set folder", "The files of a frame of a folder with dataset.toml.",
        "lidar/000001.bin", lambda path: read_folder(path.parents[1] / "dataset.toml"), _SWEEP,
        [
            *_pair_cases("lidar/000001", "camera/000001"),
            Case("no file of points", b"", name="lidar/readme.md"),
        ],
        [("dataset.toml", FOLDER), ("camera/000001.png", _IMAGE)],
    ),
    Reader(
        "nuScenes", "The tables; here sample_annotation.json.",
        "v1.0-mini/sample_annotation.json", _nuscenes, _ANNOTATIONS,
        [
            Case("without spaces", _ANNOTATIONS.replace(" ", "")),
            Case("no annotations", "[]", other=True),
            Case("a size of 0", _ANNOTATIONS.replace("[1.8,", "[0,")),
            Case("a rotation that is not a rotation", _ANNOTATIONS.replace(
                "[1.0, 0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0]")),
            Case("a key is missing", _ANNOTATIONS.replace("translation", "location")),
            Case("an instance that does not exist", _ANNOTATIONS.replace('"i1"', '"i2"')),
            Case("the file ends early", _ANNOTATIONS[:-40]),
            Case("two versions of the tables", _ANNOTATIONS, beside=[
                ("v1.0-trainval/scene.json", "[]")]),
        ],
        _NUSCENES_FILES,
    ),
)  # fmt: skip
