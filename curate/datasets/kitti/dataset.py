"""Reader of the KITTI object data set, and of other data in its layout.

Source: Geiger et al., "Are we ready for autonomous driving?", CVPR 2012, and the readme of its
object development kit. Two layouts are supported:
ROOT/training/{velodyne,image_2,calib,label_2} and ROOT/{velodyne,image_2,calib,label_2}. image_2,
label_2 and ROOT/ImageSets/*.txt are optional. Converters of the Waymo Open Dataset write the same
layout with image_0 to image_4, label_0 to label_4 or label_all, and a Tr_velo_to_cam_N for each
camera.
"""

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from curate.datasets.formats.binary import read_bytes
from curate.datasets.formats.clouds import CLOUD_SUFFIXES, read_cloud
from curate.datasets.formats.containment import Boundary, check_frame_id
from curate.datasets.formats.frame_files import (
    IMAGE_SUFFIXES,
    FrameFolder,
    visible_files,
    visible_names,
)
from curate.datasets.formats.images import check_image_size, read_optional_image
from curate.datasets.formats.point_layout import UNDECLARED, PointLayout
from curate.datasets.frame_names import FrameNames, match_frame_list
from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.labels import read_annotations
from curate.datasets.recognition import layout_hint
from curate.detections import Annotations
from curate.errors import ConfigError, DataError
from curate.files.paths import StrPath
from curate.files.text import read_lines, read_text
from curate.frames import Frame, FrameFiles, RotationY
from curate.geometry.mounting import check_rotation_y
from curate.ranges import Count
from curate.shapes import Float32

_log = logging.getLogger(__name__)

_WAYMO_NAME = re.compile(r"\d{7}")
# The folder of KITTI's development kit that says which drive each frame of training/ is from.
_MAPPINGS = ("mapping", "devkit_object/mapping", "devkit/mapping")
_MAPPING_FILES = ("train_mapping.txt", "train_rand.txt")
_TURNS_PER_SECOND = 10  # of KITTI's LiDAR; each turn is a frame


class KittiDataset:
    """A `Dataset` in KITTI's layout; every point file is a frame.

    Args:
        root: the folder that contains training/velodyne or velodyne.
        layout: the declared layout of the point files.
        camera: number of the camera, for image_N and PN. The default is the left colour camera 2;
            camera 0, the front camera, if each camera has a Tr_velo_to_cam_N of its own, as
            converters of the Waymo Open Dataset write; or the first camera with a folder image_N.
        image_size: width and height in pixels of the calibrated camera's image, for a data set
            without images; without it, such a data set has no camera.
        follow_links: whether links may lead out of the root.
        rotation_y: who computed rotation_y of the labels; see `curate.frames.RotationY`. The
            default is "calibration", and "mmdetection3d" for conversions of Waymo.

    Raises:
        DataError: if the root contains neither.
        ConfigError: if `rotation_y` is unknown, there is no folder of images of the camera, or the
            image size is invalid, or given for a data set with images.
    """

    name = "kitti"
    copied_as = "kitti"

    def __init__(
        self,
        root: StrPath,
        *,
        layout: PointLayout = UNDECLARED,
        camera: Count | None = None,
        image_size: Sequence[int] | None = None,
        follow_links: bool = False,
        rotation_y: RotationY | None = None,
    ) -> None:
        self.root = Path(root)
        self._boundary = Boundary(self.root, follow_links=follow_links)
        homes = [self.root / "training", self.root]
        home = next((home for home in homes if (home / "velodyne").is_dir()), None)
        if home is None:
            raise DataError(
                f"{self.root}: contains neither training/velodyne nor velodyne; "
                f"set the root to a data set in KITTI's layout{layout_hint(self.root, self.name)}"
            )
        self._home = home
        self.layout = layout
        self._boundary.check(home / "calib")
        # Converters of data with several cameras write all labels in the frame of camera 0.
        self._front = _has_own_extrinsics(home / "calib")
        self._rotation_y: RotationY = "mmdetection3d" if self._front else "calibration"
        if rotation_y is not None:
            check_rotation_y(rotation_y)
            self._rotation_y = rotation_y
        self.camera = _camera(home, camera, front=self._front)
        folder = home / f"image_{self.camera}"
        self._has_images = contains_images(folder)
        self._image_size = image_size_option(image_size, self._has_images, folder)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the ids of all frames with a point file, sorted.

        Raises:
            DataError: if there are none, or a frame has two point files or two images.
        """
        return self._frame_ids

    @cached_property
    def _frame_ids(self) -> tuple[str, ...]:
        return checked_frames(self._points, [self._images], self.root, self.name)

    @cached_property
    def _points(self) -> FrameFolder:
        return FrameFolder(self._home / "velodyne", CLOUD_SUFFIXES, "point")

    @cached_property
    def _images(self) -> FrameFolder:
        return FrameFolder(self._home / f"image_{self.camera}", IMAGE_SUFFIXES, "image")

    @cached_property
    def _labels(self) -> Path:
        """The folder of labels: those of the camera, or else those that are there."""
        names = (f"label_{self.camera}", "label_2", "label_all")
        folders = [self._home / name for name in names]
        return next((folder for folder in folders if folder.is_dir()), folders[1])

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the lists in ROOT/ImageSets by file name; they may contain missing frames.

        KITTI's test.txt lists frames of ROOT/testing. Their ids are also ids of other frames in
        ROOT/training, so this list is dropped when ROOT/training is read.

        Raises:
            DataError: if a list contains an invalid frame id.
        """
        lists = dict(read_frame_lists(self.root / "ImageSets", self._boundary, self.frame_ids()))
        if self._home != self.root and lists.pop("test", None) is not None:
            _log.info("%s/ImageSets/test.txt: skipped, it lists frames of testing/", self.root)
        return lists

    def files(self, frame_id: str) -> FrameFiles:
        """Return the paths of the frame's files; `label` is None if there is no label file.

        Raises:
            DataError: if the frame id is invalid, a link leads out of the data set, or the frame
                has two point files or two images.
        """
        check_frame_id(frame_id)
        label = self._labels / f"{frame_id}.txt"
        files = FrameFiles(
            points=self._points.path(frame_id),
            image=self._images.path(frame_id) if self._has_images else None,
            calibration=self._home / "calib" / f"{frame_id}.txt",
            label=label if label.exists() else None,
        )
        self._boundary.check(*files.paths())
        return files

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the drive of a frame, if it is known.

        It is known from the mapping of KITTI's development kit, if the root contains it, and from
        the names that converters of the Waymo Open Dataset give: a digit for the split, three for
        the segment, and three for the frame.

        Raises:
            DataError: if the mapping is malformed, or a link to it leads out of the data set.
        """
        if self._front and _WAYMO_NAME.fullmatch(frame_id):
            return frame_id[:4]
        return self._drives[frame_id][0] if frame_id in self._drives else None

    def time_of(self, frame_id: str) -> float | None:
        """Return the time of a frame since its drive began, if the drive is known.

        Raises:
            DataError: if `sequence_of` raises it.
        """
        found = self._drives.get(frame_id)
        return None if found is None else found[1] / _TURNS_PER_SECOND

    @cached_property
    def _drives(self) -> Mapping[str, tuple[str, int]]:
        homes = (self.root / folder for folder in _MAPPINGS)
        home = next((home for home in homes if (home / _MAPPING_FILES[0]).is_file()), None)
        if home is None:
            return {}
        # Checked before reading, because error messages quote content of the files.
        self._boundary.check(*(home / name for name in _MAPPING_FILES))
        return read_drives(home)

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """Read the frame's calibration and image size, and its points and image if requested.

        Raises:
            DataError: if a file is missing, damaged or malformed.
        """
        files = self.files(frame_id)
        sweep = np.zeros((0, 4), dtype=np.float32)
        if points:
            sweep = read_points(files.points, self.layout)
        calibration = read_calibration(files.calibration, self.camera, self._rotation_y)
        size, pixels = read_optional_image(files.image, self._image_size, pixels=image)
        return Frame(frame_id, sweep, calibration, size, pixels)

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth in the LiDAR frame, DontCare regions included.

        Raises:
            DataError: if there is no label file, or it is malformed.
        """
        files = self.files(frame_id)
        if files.label is None:
            raise DataError(f"{self._labels / frame_id}.txt: no such label file")
        camera = 0 if self._front else self.camera
        calibration = read_calibration(files.calibration, camera, self._rotation_y)
        return read_annotations(files.label, calibration, categories=None)


def read_points(path: Path, layout: PointLayout = UNDECLARED) -> Float32[np.ndarray, "n 4"]:
    """Return the (n, 4) float32 points of a velodyne file: x, y, z in metres, intensity in [0, 1].

    An empty file has no points.

    Raises:
        DataError: if `read_cloud` raises it, or a .bin file contains NaN or infinite numbers.
    """
    return read_cloud(path, layout, drop_missing=False)


def checked_frames(
    points: FrameFolder, images: Iterable[FrameFolder], root: Path, kind: str
) -> tuple[str, ...]:
    """Return the frames with a point file, after a check that their files are unambiguous.

    Args:
        points: the point files.
        images: the images of each camera.
        root: root of the data set.
        kind: name of the data set, for the message that there are no frames.

    Raises:
        DataError: if there are none, or a frame has two point files or two images.
    """
    frames = points.frames()
    if not frames:
        raise DataError(
            f"{points.folder}: no point files ({', '.join(CLOUD_SUFFIXES)}); "
            f"{points.content()}{layout_hint(root, kind)}"
        )
    points.check(frames)
    for camera in images:
        camera.check(frames)
    return frames


def frame_number(stem: str, path: Path) -> int:
    """Return the number of a frame within its sequence, from the name of its point file.

    Raises:
        DataError: if the name is not a number.
    """
    if not (stem.isascii() and stem.isdecimal()):
        raise DataError(
            f"{path}: the name is not the number of the frame, to which the labels refer"
        )
    return int(stem)


def _has_own_extrinsics(calib: Path) -> bool:
    """Return whether each camera has a transform of its own, from one of the calibration files."""
    path = next(visible_files(calib, "*.txt"), None)
    return path is not None and b"Tr_velo_to_cam_0" in read_bytes(path, "calibration")


def _camera(home: Path, camera: int | None, *, front: bool) -> int:
    """Return the number of the camera; see `KittiDataset`.

    Raises:
        ConfigError: if the camera is given but has no folder of images.
    """
    names = (path.name.removeprefix("image_") for path in visible_files(home, "image_*"))
    present = sorted(int(name) for name in names if name.isdecimal())
    if camera is None:
        first = 0 if front else 2
        return first if first in present or not present else present[0]
    if present and camera not in present:
        listed = ", ".join(f"{number} (image_{number})" for number in present) or "none"
        raise ConfigError(
            f"dataset.options.camera = {camera!r}: {home} has no folder image_{camera}; its "
            f"cameras are {listed}"
        )
    return camera


def read_drives(folder: Path) -> Mapping[str, tuple[str, int]]:
    """Return the drive of each frame of KITTI's training/, and its number in the drive.

    train_mapping.txt has a line "date drive frame" for each recorded frame. train_rand.txt has one
    number for each frame of training/: the number of its line in train_mapping.txt, from 1. For
    example, if train_rand.txt begins with 7, frame 000000 is from the drive on line 7.

    Raises:
        DataError: if a file is missing or malformed.
    """
    mapping, path = (folder / name for name in _MAPPING_FILES)
    lines = map(str.split, read_lines(mapping, "mapping"))
    rows = [(line[1], line[2]) for line in lines if len(line) == 3]
    if wrong := [number for _, number in rows if not (number.isascii() and number.isdecimal())]:
        raise DataError(f"{mapping}: {wrong[0][:40]!r} is not the number of a frame")
    drives = [(drive, int(number)) for drive, number in rows]
    text = read_text(path, "mapping")
    try:
        numbers = [int(number) for number in text.replace(",", " ").split()]
    except ValueError as error:
        raise DataError(f"{path}: {error}; the file must contain only line numbers") from None
    if not all(1 <= number <= len(drives) for number in numbers):
        raise DataError(f"{path}: contains a line number that train_mapping.txt does not have")
    return {f"{i:06d}": drives[number - 1] for i, number in enumerate(numbers)}


def contains_images(folder: Path) -> bool:
    """Return whether a folder exists and contains a PNG or JPEG."""
    return any(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in visible_names(folder))


def image_size_option(
    size: Sequence[int] | None, has_images: bool, place: Path
) -> tuple[int, int] | None:
    """Return the option `image_size` of a data set without images; None if it is not given.

    Raises:
        ConfigError: if it is not a size, or the data set has images.
    """
    if size is None:
        return None
    if has_images:
        raise ConfigError(
            f"dataset.options.image_size is for data sets without images, but {place} contains "
            "some; remove the option"
        )
    return check_image_size(size, "dataset.options.image_size")


def read_frame_lists(
    folder: Path, boundary: Boundary, frame_ids: Sequence[str] = ()
) -> Mapping[str, tuple[str, ...]]:
    """Return the frame lists of a folder by file name; empty if the folder does not exist.

    The lists may contain frames without files; their names stay as they are.

    Args:
        folder: the folder of the lists.
        boundary: the boundary of the data set.
        frame_ids: the frames of the data set.

    Raises:
        DataError: if a list contains an invalid frame id, or is a link out of the data set.
    """
    paths = sorted(visible_files(folder, "*.txt"))
    boundary.check(*paths)
    frames = FrameNames.of(frame_ids)
    return {path.stem: match_frame_list(path, frames, allow_missing=True) for path in paths}
