"""Reader of KITTI's raw recordings, synced and rectified.

Source: Geiger et al., "Vision meets robotics: the KITTI dataset", IJRR 2013. A date folder contains
calib_velo_to_cam.txt, calib_cam_to_cam.txt, and drives with velodyne_points/data and image_02/data.
A frame id is the drive and the number: 2011_09_26_drive_0001_sync_0000000005. The labels of a drive
are those in DRIVE/label_2, in the format of the KITTI object data set, or else the recordings' own
DRIVE/tracklet_labels.xml.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from curate.datasets.formats.clouds import CLOUD_SUFFIXES
from curate.datasets.formats.containment import Boundary
from curate.datasets.formats.frame_files import IMAGE_SUFFIXES, FrameFolder, visible_names
from curate.datasets.formats.images import read_optional_image
from curate.datasets.formats.point_layout import UNDECLARED, PointLayout
from curate.datasets.kitti.calibration import RAW_CAMERAS, RAW_TO_CAMERA, read_raw_calibration
from curate.datasets.kitti.dataset import (
    contains_images,
    frame_number,
    image_size_option,
    read_frame_lists,
    read_points,
)
from curate.datasets.kitti.labels import read_annotations
from curate.datasets.kitti.oxts import imu_pose, read_lidar_to_imu, read_oxts, read_times
from curate.datasets.kitti.sequences import SequenceFrames
from curate.datasets.kitti.tracklets import TRACKLETS, TrackletTable
from curate.datasets.recognition import layout_hint
from curate.detections import Annotations
from curate.errors import DataError
from curate.files.paths import StrPath
from curate.frames import Calibration, Frame, FrameFiles, RotationY
from curate.geometry.mounting import check_rotation_y
from curate.shapes import Float

_POINTS, _IMAGES = Path("velodyne_points/data"), Path("image_02/data")
_TIMES, _OXTS = Path("velodyne_points/timestamps.txt"), Path("oxts/data")
_TO_LIDAR = "calib_imu_to_velo.txt"
# The root is a date folder with drives, or a folder of date folders.
_DRIVES = ("*", "*/*")


class _Drive:
    """The files of a drive by the number of the frame."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.points = FrameFolder(folder / _POINTS, CLOUD_SUFFIXES, "point")
        self.images = FrameFolder(folder / _IMAGES, IMAGE_SUFFIXES, "image")
        labels, tracklets = folder / "label_2", folder / TRACKLETS
        self.has_tracklets = tracklets.is_file() and not labels.is_dir()
        self.labels = tracklets if self.has_tracklets else labels

    @cached_property
    def times(self) -> Sequence[float]:
        """The time of each frame by its number; empty if there are no timestamps."""
        path = self.folder / _TIMES
        return read_times(path) if path.exists() else []

    @cached_property
    def first_latitude(self) -> float | None:
        """The latitude of the first frame with a position; None if there are no positions."""
        first = min(visible_names(self.folder / _OXTS), default=None)
        return None if first is None else float(self._position(first)[0])

    def _position(self, name: str) -> np.ndarray:
        path = self.folder / _OXTS / name
        rows = read_oxts(path)
        if len(rows) != 1:
            raise DataError(f"{path}: {len(rows)} lines, expected one")
        return np.asarray(rows[0])

    @cached_property
    def _lidar_to_imu(self) -> np.ndarray:
        return read_lidar_to_imu(self.folder.parent / _TO_LIDAR)

    def pose(self, number: str) -> np.ndarray | None:
        """Return the pose of the LiDAR in a frame; None if the drive has no positions."""
        latitude = self.first_latitude
        if latitude is None:
            return None
        return np.asarray(imu_pose(self._position(f"{number}.txt"), latitude) @ self._lidar_to_imu)

    def label(self, number: str) -> Path:
        """Return the path of the file with a frame's labels, which need not exist."""
        return self.labels if self.has_tracklets else self.labels / f"{number}.txt"


class KittiRawDataset:
    """A `Dataset` of synced drives; if there are images, frames without one are skipped.

    Args:
        root: a date folder with drives, or a folder of date folders.
        layout: the declared layout of the point files.
        image_size: see `KittiDataset`.
        follow_links: whether links may lead out of the root.
        rotation_y: who computed rotation_y of the labels; see `curate.frames.RotationY`.

    Raises:
        DataError: if there is no drive.
    """

    name = "kitti-raw"
    copied_as = "kitti"

    def __init__(
        self,
        root: StrPath,
        *,
        layout: PointLayout = UNDECLARED,
        image_size: Sequence[int] | None = None,
        follow_links: bool = False,
        rotation_y: RotationY = "calibration",
    ) -> None:
        check_rotation_y(rotation_y)
        self.root = Path(root)
        self.layout = layout
        self._rotation_y = rotation_y
        self._boundary = Boundary(self.root, follow_links=follow_links)
        self._tracklets: dict[Path, TrackletTable] = {}
        folders = (
            path.parent.parent
            for pattern in _DRIVES
            for path in self.root.glob(f"{pattern}/{_POINTS}")
        )
        self._folders = {path.name: path for path in sorted(folders)}
        if not self._folders:
            raise DataError(
                f"{self.root}: contains no DRIVE/{_POINTS}; set the root to the date folder, which "
                f"also contains {RAW_TO_CAMERA}, or to the folder of all dates"
                f"{layout_hint(self.root, self.name)}"
            )

        self._has_images = any(contains_images(path / _IMAGES) for path in self._folders.values())
        self._image_size = image_size_option(image_size, self._has_images, self.root)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the ids of all frames with points, and with an image if there are any, sorted.

        Raises:
            DataError: if a frame has two point files or two images.
        """
        return self._frames.ids()

    @cached_property
    def _frames(self) -> SequenceFrames[_Drive]:
        drives = {name: _Drive(folder) for name, folder in self._folders.items()}
        return SequenceFrames(drives, has_images=self._has_images)

    def skipped_frames(self) -> str:
        """Return how many frames are skipped because they have no image; "" if none is."""
        return self._frames.describe_skipped()

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the frame lists in ROOT/ImageSets by file name."""
        return read_frame_lists(self.root / "ImageSets", self._boundary, self.frame_ids())

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the drive of a frame, or None if there is no such frame."""
        return self._frame(frame_id)[0].folder.name if frame_id in self._frames else None

    def time_of(self, frame_id: str) -> float | None:
        """Return the time of a frame's sweep, or None if its drive has no timestamps.

        Raises:
            DataError: if the timestamps are malformed, or too few.
        """
        drive, number = self._frame(frame_id)
        self._boundary.check(drive.folder / _TIMES)
        index = frame_number(number, drive.points.path(number))
        if drive.times and index >= len(drive.times):
            raise DataError(f"{drive.folder / _TIMES}: no line for frame {index}")
        return drive.times[index] if drive.times else None

    def pose_of(self, frame_id: str) -> Float[np.ndarray, "4 4"] | None:
        """Return the pose of the LiDAR, x east, y north; None if the drive has no oxts/data.

        Raises:
            DataError: if the frame's file or calib_imu_to_velo.txt is missing or malformed.
        """
        drive, number = self._frame(frame_id)
        self._boundary.check(drive.folder / _OXTS, drive.folder.parent / _TO_LIDAR)
        return drive.pose(number)

    def files(self, frame_id: str) -> FrameFiles:
        """Return the paths of the frame's files; all frames of a date share the calibration.

        Raises:
            DataError: if there is no such frame.
        """
        drive, number = self._frame(frame_id)
        label = drive.label(number)
        files = FrameFiles(
            points=drive.points.path(number),
            image=drive.images.path(number) if self._has_images else None,
            calibration=drive.folder.parent / RAW_TO_CAMERA,
            label=label if label.exists() else None,
        )
        self._boundary.check(*files.paths(), drive.folder.parent / RAW_CAMERAS)
        return files

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """Read the frame's calibration and image size, and its points and image if requested.

        Raises:
            DataError: if a file is missing, damaged or malformed.
        """
        files = self.files(frame_id)
        sweep = np.zeros((0, 4), dtype=np.float32)
        if points:
            sweep = read_points(files.points, self.layout)
        calibration = self._calibration(files)
        size, pixels = read_optional_image(files.image, self._image_size, pixels=image)
        return Frame(frame_id, sweep, calibration, size, pixels)

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth in the LiDAR frame.

        From tracklet_labels.xml, these are the objects in the camera's view.

        Raises:
            DataError: if there is no label file, or it is malformed.
        """
        files = self.files(frame_id)
        drive, number = self._frame(frame_id)
        if files.label is None:
            raise DataError(f"{drive.label(number)}: no such label file")
        if drive.has_tracklets:
            if files.label not in self._tracklets:
                self._tracklets[files.label] = TrackletTable(files.label)
            table = self._tracklets[files.label]
            index = frame_number(number, files.points)
            return table.read(index, self.read(frame_id, points=False))
        return read_annotations(files.label, self._calibration(files), categories=None)

    def _calibration(self, files: FrameFiles) -> Calibration:
        return read_raw_calibration(files.calibration.parent, rotation_y=self._rotation_y)

    def _frame(self, frame_id: str) -> tuple[_Drive, str]:
        return self._frames.find(frame_id, self.root, "DRIVE_NUMBER")
