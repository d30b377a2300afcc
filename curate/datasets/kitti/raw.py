"""Reader of KITTI's raw recordings, synced and rectified.

Source: Geiger et al., "Vision meets robotics: the KITTI dataset", IJRR 2013. A date folder contains
calib_velo_to_cam.txt, calib_cam_to_cam.txt, and drives with velodyne_points/data and image_02/data.
A frame id is the drive and the number: 2011_09_26_drive_0001_sync_0000000005. DRIVE/label_2 may
contain labels in the format of the KITTI object data set.
"""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import numpy as np

from curate.datasets.formats.containment import Boundary, check_frame_id
from curate.datasets.formats.images import read_sized_image
from curate.datasets.kitti.dataset import (
    parse_matrix,
    read_bytes,
    read_frame_lists,
    read_points,
    visible_files,
)
from curate.datasets.kitti.labels import read_annotations
from curate.detections import Annotations
from curate.errors import DataError
from curate.files.paths import StrPath
from curate.frames import Calibration, Frame, FrameFiles, RotationY
from curate.geometry.mounting import check_lidar_to_camera, check_rotation_y

_POINTS, _IMAGES = Path("velodyne_points/data"), Path("image_02/data")
_TO_CAMERA, _CAMERAS = "calib_velo_to_cam.txt", "calib_cam_to_cam.txt"
# The root is a date folder with drives, or a folder of date folders.
_DRIVES = ("*", "*/*")


class KittiRawDataset:
    """A `Dataset` of synced drives; frames without an image are skipped.

    Args:
        root: a date folder with drives, or a folder of date folders.
        follow_links: whether links may lead out of the root.
        rotation_y: who computed rotation_y of the labels; see `curate.frames.RotationY`.

    Raises:
        DataError: if there is no drive.
        ConfigError: if `rotation_y` is unknown.
    """

    name = "kitti-raw"

    def __init__(
        self,
        root: StrPath,
        *,
        follow_links: bool = False,
        rotation_y: RotationY = "calibration",
    ) -> None:
        check_rotation_y(rotation_y)
        self.root = Path(root)
        self._rotation_y = rotation_y
        self._boundary = Boundary(self.root, follow_links=follow_links)
        drives = (
            path.parent.parent
            for pattern in _DRIVES
            for path in self.root.glob(f"{pattern}/{_POINTS}")
        )
        self._drives = {path.name: path for path in sorted(drives)}
        if not self._drives:
            raise DataError(
                f"{self.root}: contains no DRIVE/{_POINTS}; set the root to the date folder, which "
                f"also contains {_TO_CAMERA}, or to the folder of all dates"
            )

    def frame_ids(self) -> tuple[str, ...]:
        """Return the ids of all frames with points and image, sorted."""
        return tuple(self._frames)

    @cached_property
    def _frames(self) -> Mapping[str, tuple[Path, str]]:
        """The folder of the drive and the number of each frame."""
        frames = {
            f"{drive}_{points.stem}": (folder, points.stem)
            for drive, folder in self._drives.items()
            for points in visible_files(folder / _POINTS, "*.bin")
            if (folder / _IMAGES / f"{points.stem}.png").exists()
        }
        return dict(sorted(frames.items()))

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the frame lists in ROOT/ImageSets by file name."""
        return read_frame_lists(self.root / "ImageSets", self._boundary)

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the drive of a frame, or None if there is no such frame."""
        return self._frames[frame_id][0].name if frame_id in self._frames else None

    def files(self, frame_id: str) -> FrameFiles:
        """Return the paths of the frame's files; all frames of a date share the calibration.

        Raises:
            DataError: if there is no such frame.
        """
        check_frame_id(frame_id)
        if frame_id not in self._frames:
            raise DataError(f"{self.root}: no frame {frame_id}; frame ids are DRIVE_NUMBER")
        drive, number = self._frames[frame_id]
        label = drive / "label_2" / f"{number}.txt"
        files = FrameFiles(
            points=drive / _POINTS / f"{number}.bin",
            image=drive / _IMAGES / f"{number}.png",
            calibration=drive.parent / _TO_CAMERA,
            label=label if label.exists() else None,
        )
        self._boundary.check(*files.paths(), drive.parent / _CAMERAS)
        return files

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """Read the frame's calibration and image size, and its points and image if requested.

        Raises:
            DataError: if a file is missing, damaged or malformed.
        """
        files = self.files(frame_id)
        sweep = read_points(files.points) if points else np.zeros((0, 4), dtype=np.float32)
        calibration = read_raw_calibration(files.calibration.parent, self._rotation_y)
        size, pixels = read_sized_image(files.image, pixels=image)
        return Frame(frame_id, sweep, calibration, size, pixels)

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth in the LiDAR frame.

        Raises:
            DataError: if there is no label file, or it is malformed.
        """
        files = self.files(frame_id)
        if files.label is None:
            drive, number = self._frames[frame_id]
            raise DataError(f"{drive / 'label_2' / number}.txt: no such label file")
        calibration = read_raw_calibration(files.calibration.parent, self._rotation_y)
        return read_annotations(files.label, calibration)


def read_raw_calibration(folder: Path, rotation_y: RotationY = "calibration") -> Calibration:
    """Return the calibration of the left colour camera (P_rect_02, R_rect_00, R and T).

    Args:
        folder: the date folder.
        rotation_y: the meaning of rotation_y in the label files of the data set.

    Raises:
        DataError: if a file or an entry is missing or malformed, or the transform from LiDAR to
            camera is not a rotation and a translation.
    """
    extrinsic, rectify = np.eye(4), np.eye(4)
    extrinsic[:3, :3] = _entry(folder / _TO_CAMERA, "R", (3, 3))
    extrinsic[:3, 3:] = _entry(folder / _TO_CAMERA, "T", (3, 1))
    rectify[:3, :3] = _entry(folder / _CAMERAS, "R_rect_00", (3, 3))
    check_lidar_to_camera(rectify @ extrinsic, str(folder / _TO_CAMERA))
    projection = _entry(folder / _CAMERAS, "P_rect_02", (3, 4))
    return Calibration(projection, rectify @ extrinsic, rotation_y=rotation_y)


def _entry(path: Path, key: str, shape: tuple[int, int]) -> np.ndarray:
    text = read_bytes(path, "calibration").decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        name, _, entries = line.partition(":")
        if name == key:
            return parse_matrix(entries, shape, f"{path}:{number}")
    raise DataError(f"{path}: no line {key}:")
