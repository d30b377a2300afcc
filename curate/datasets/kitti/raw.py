"""KITTI's raw recordings, synced and rectified.

Source: Geiger et al., "Vision meets robotics: the KITTI dataset", IJRR 2013. A date folder holds
calib_velo_to_cam.txt, calib_cam_to_cam.txt and drives with velodyne_points/data and image_02/data.
A frame is named by its drive and number, 2011_09_26_drive_0001_sync_0000000005. Labels in the
format of KITTI object may lie in DRIVE/label_2.
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
from curate.datasets.kitti.labels import read_objects, to_annotations
from curate.detections import Annotations
from curate.errors import DataError
from curate.files.paths import StrPath
from curate.frames import Calibration, Frame, FrameFiles

_POINTS, _IMAGES = Path("velodyne_points/data"), Path("image_02/data")
_TO_CAMERA, _CAMERAS = "calib_velo_to_cam.txt", "calib_cam_to_cam.txt"
# Drives lie in the date folder, or dates below the root.
_DRIVES = ("*", "*/*")


class KittiRawDataset:
    """A `Dataset` of synced drives; frames without an image are left out.

    Args:
        root: a date folder with drives, or a folder of dates.
        follow_links: whether links may lead out of it.

    Raises:
        DataError: there is no drive.
    """

    name = "kitti-raw"

    def __init__(self, root: StrPath, *, follow_links: bool = False) -> None:
        self.root = Path(root)
        self._boundary = Boundary(self.root, follow_links=follow_links)
        found = (path.parent.parent for at in _DRIVES for path in self.root.glob(f"{at}/{_POINTS}"))
        self._drives = {path.name: path for path in sorted(found)}
        if not self._drives:
            raise DataError(
                f"{self.root}: holds no DRIVE/{_POINTS}; name the date folder, which also holds "
                f"{_TO_CAMERA}, or the folder of all dates"
            )

    def frame_ids(self) -> tuple[str, ...]:
        """Return all frames with points and image, in sorted order."""
        return tuple(self._homes)

    @cached_property
    def _homes(self) -> Mapping[str, tuple[Path, str]]:
        """Drive and number of each frame."""
        found = {
            f"{drive}_{points.stem}": (home, points.stem)
            for drive, home in self._drives.items()
            for points in visible_files(home / _POINTS, "*.bin")
            if (home / _IMAGES / f"{points.stem}.png").exists()
        }
        return dict(sorted(found.items()))

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the lists of ROOT/ImageSets, by file name."""
        return read_frame_lists(self.root / "ImageSets", self._boundary)

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the drive of a frame."""
        return self._homes[frame_id][0].name if frame_id in self._homes else None

    def files(self, frame_id: str) -> FrameFiles:
        """Where the frame's files lie; the calibration is the drive's.

        Raises:
            DataError: if there is no such frame.
        """
        check_frame_id(frame_id)
        if frame_id not in self._homes:
            raise DataError(f"{self.root}: no frame {frame_id}; frames are named DRIVE_NUMBER")
        home, number = self._homes[frame_id]
        label = home / "label_2" / f"{number}.txt"
        found = FrameFiles(
            points=home / _POINTS / f"{number}.bin",
            image=home / _IMAGES / f"{number}.png",
            calibration=home.parent / _TO_CAMERA,
            label=label if label.exists() else None,
        )
        self._boundary.check(*found.paths(), home.parent / _CAMERAS)
        return found

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """The frame's calibration, its points unless unwanted, and its image where asked for.

        Raises:
            DataError: if a file is missing, damaged or malformed.
        """
        files = self.files(frame_id)
        sweep = read_points(files.points) if points else np.zeros((0, 4), dtype=np.float32)
        calibration = read_raw_calibration(files.calibration.parent)
        size, pixels = read_sized_image(files.image, pixels=image)
        return Frame(frame_id, sweep, calibration, size, pixels)

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth in the LiDAR frame.

        Raises:
            DataError: if there is no label file, or it is malformed.
        """
        files = self.files(frame_id)
        if files.label is None:
            home, number = self._homes[frame_id]
            raise DataError(f"{home / 'label_2' / number}.txt: no such label file")
        calibration = read_raw_calibration(files.calibration.parent)
        return to_annotations(read_objects(files.label), calibration)


def read_raw_calibration(folder: Path) -> Calibration:
    """The calibration of the left colour camera (P_rect_02, R_rect_00, R and T of the LiDAR).

    Raises:
        DataError: if a file or an entry is missing or malformed.
    """
    extrinsic, rectify = np.eye(4), np.eye(4)
    extrinsic[:3, :3] = _entry(folder / _TO_CAMERA, "R", (3, 3))
    extrinsic[:3, 3:] = _entry(folder / _TO_CAMERA, "T", (3, 1))
    rectify[:3, :3] = _entry(folder / _CAMERAS, "R_rect_00", (3, 3))
    return Calibration(_entry(folder / _CAMERAS, "P_rect_02", (3, 4)), rectify @ extrinsic)


def _entry(path: Path, key: str, shape: tuple[int, int]) -> np.ndarray:
    text = read_bytes(path, "calibration").decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        name, _, entries = line.partition(":")
        if name == key:
            return parse_matrix(entries, shape, f"{path}:{number}")
    raise DataError(f"{path}: no line {key}:")
