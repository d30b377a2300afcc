"""A reader of any folder of point files, with the images of no, one or several cameras.

The file ROOT/dataset.toml describes the folder:

points = "lidar"              # folder of FRAME.bin, .pcd, .ply or .npy
images = "camera"             # folder of FRAME.png or .jpg; if there are no images, optionally:
# image_size = [1242, 375]    # width and height in pixels of the calibrated camera's image
labels = "label_2"            # optional: folder of KITTI label files of the labeled frames
splits = "lists"              # optional: folder of train.txt, val.txt
sequence_separator = "_"      # optional: frames are named SEQUENCE_NUMBER; the last one separates
poses = "poses"               # optional: folder of FRAME.txt, 3 x 4 or 4 x 4 numbers, LiDAR to map
times = "times.txt"           # optional: a file with lines "FRAME SECONDS"
columns = 4                   # number of columns of .bin and .npy files
column_names = ["x", "y", "z", "intensity", "ring"]   # optional: their names, in any order
intensity_field = "intensity" # optional: the column of the intensity, where several may be it
intensity_scale = 255.0       # the value of full intensity in the files

[calibration]                 # or calibration = "calib.txt", a file in KITTI's format,
                              # or calibration = "calib", a folder of such files FRAME.txt
projection = [[...], [...], [...]]             # 3 x 4, camera (z forward) to pixels
lidar_to_camera = [[...], [...], [...]]        # 3 x 4 or 4 x 4, LiDAR (x forward) to camera

Several cameras each have a table [cameras.NAME] with images (or image_size) and calibration, in
place of the keys of the same names above. The labels are in the frame of the first camera. Without
images, image_size and cameras, there is no camera; calibration is then only needed for labels.

[cameras.left]
images = "left"
[cameras.left.calibration]
projection = [[...], [...], [...]]
lidar_to_camera = [[...], [...], [...]]
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from curate.datasets.formats.clouds import CLOUD_SUFFIXES, read_cloud
from curate.datasets.formats.containment import Boundary, check_frame_id
from curate.datasets.formats.frame_files import IMAGE_SUFFIXES, FrameFolder
from curate.datasets.formats.images import check_image_size, read_optional_image
from curate.datasets.formats.point_layout import UNDECLARED, PointLayout
from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.dataset import checked_frames, read_frame_lists
from curate.datasets.kitti.labels import read_annotations
from curate.datasets.motion import read_pose, read_times
from curate.datasets.recognition import layout_hint
from curate.detections import Annotations
from curate.errors import ConfigError, DataError
from curate.files.paths import StrPath
from curate.files.text import read_text
from curate.files.toml_text import parse_toml
from curate.frames import (
    Calibration,
    Camera,
    Frame,
    FrameFiles,
    RotationY,
    calibration_without_camera,
)
from curate.geometry.mounting import check_lidar_to_camera, check_rotation_y
from curate.shapes import Float
from curate.spelling import did_you_mean

DESCRIPTION = "dataset.toml"
_FOLDERS = ("points", "images", "labels", "splits", "poses", "times")
_TEXTS = (*_FOLDERS, "sequence_separator")
_OF_CAMERA = ("images", "image_size", "calibration")
# The keys that describe the point files; the settings in [dataset] have the same names.
_LAYOUT = ("columns", "column_names", "intensity_field", "intensity_scale")
_KEYS = (*_TEXTS, *_LAYOUT, "image_size", "calibration", "cameras")


@dataclass(frozen=True)
class _CameraTable:
    """The part of dataset.toml that describes one camera.

    Attributes:
        name: name of the camera; "" without a table [cameras.NAME].
        images: its images; None if there are none.
        image_size: (width, height) in pixels of a camera without images; None if it has images.
        calibration: path of a file in KITTI's format or of a folder with a file FRAME.txt for each
            frame, or a table of matrices.
    """

    name: str
    images: FrameFolder | None
    image_size: tuple[int, int] | None
    calibration: Path | Mapping[str, Any]

    def image(self, frame_id: str) -> Path | None:
        """Return the path of a frame's image, whether it exists or not; None without images."""
        return None if self.images is None else self.images.path(frame_id)


class FolderDataset:
    """A `Dataset` in a plain folder; every point file is a frame.

    Args:
        root: the folder with dataset.toml.
        layout: the declared layout of the point files, in place of the keys of dataset.toml.
        follow_links: whether links and paths in dataset.toml may lead out of the folder.
        rotation_y: who computed rotation_y of the labels; see `curate.frames.RotationY`.

    Raises:
        DataError: if dataset.toml is missing or malformed.
        ConfigError: if `rotation_y` is unknown, or the layout and dataset.toml contradict each
            other.
    """

    name = "folder"
    copied_as = "folder"

    def __init__(
        self,
        root: StrPath,
        *,
        layout: PointLayout = UNDECLARED,
        follow_links: bool = False,
        rotation_y: RotationY = "calibration",
    ) -> None:
        check_rotation_y(rotation_y)
        self._rotation_y = rotation_y
        self.root = Path(root)
        self._boundary = Boundary(self.root, follow_links=follow_links)
        self._path = self.root / DESCRIPTION
        self._boundary.check(self._path)
        if not self._path.exists():
            raise DataError(
                f"{self._path}: no such description file{layout_hint(self.root, self.name)}"
            )
        self._description = _read_description(self._path)
        self.layout = _merged(_described_layout(self._path, self._description), layout, self._path)
        self._cameras = _cameras(self._path, self._description)
        paths = [self._description[key] for key in _FOLDERS if key in self._description]
        paths += [camera.images.folder for camera in self._cameras if camera.images]
        paths += [each.calibration for each in self._cameras if isinstance(each.calibration, Path)]
        self._boundary.check(*(self.root / path for path in paths))

    def frame_ids(self) -> tuple[str, ...]:
        """Return the ids of all frames with a point file, sorted.

        Raises:
            DataError: if there are none, or a frame has two point files or two images of a camera.
        """
        return self._frame_ids

    @cached_property
    def _frame_ids(self) -> tuple[str, ...]:
        images = [each.images for each in self._cameras if each.images is not None]
        return checked_frames(self._points, images, self.root, self.name)

    @cached_property
    def _points(self) -> FrameFolder:
        return FrameFolder(self.root / self._description["points"], CLOUD_SUFFIXES, "point")

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the frame lists in the folder `splits`, by file name without suffix.

        Raises:
            DataError: if the folder is specified but contains no list. Otherwise, no frame would be
                kept for val.
        """
        if "splits" not in self._description:
            return {}
        folder = self.root / self._description["splits"]
        lists = read_frame_lists(folder, self._boundary, self.frame_ids())
        if not lists:
            raise DataError(
                f"{self._path}: splits: {folder} contains no frame list such as train.txt"
            )
        return lists

    def files(self, frame_id: str) -> FrameFiles:
        """Return the paths of the frame's files.

        The paths of images and calibration are returned even if there are no such files.

        Raises:
            DataError: if there is no such frame, or it has two point files or two images.
        """
        check_frame_id(frame_id)
        points = self._points.path(frame_id)
        if frame_id not in self._points:
            raise DataError(f"{self._points.folder}: no point file for frame {frame_id}")
        images = [each.image(frame_id) for each in self._cameras]
        calibration = self._description.get("calibration")
        path = self._path
        if isinstance(calibration, str):
            path = _of_frame(self.root / calibration, frame_id)
        label = self._label(frame_id)
        files = FrameFiles(
            points=points,
            image=images[0] if images else None,
            calibration=path,
            label=label if label is not None and label.exists() else None,
            further_images=tuple(image for image in images[1:] if image is not None),
        )
        self._boundary.check(*files.paths())
        return files

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the part of the frame's name before the last separator, or None without one."""
        separator = self._description.get("sequence_separator", "")
        if not separator or separator not in frame_id:
            return None
        return frame_id.rpartition(separator)[0]

    def time_of(self, frame_id: str) -> float | None:
        """Return the time of a frame in the file `times`, or None if the key is not set.

        Raises:
            DataError: if the file is missing or malformed, or does not contain the frame.
        """
        if "times" not in self._description:
            return None
        if frame_id not in self._times:
            path = self.root / self._description["times"]
            raise DataError(f"{path}: no line for frame {frame_id}")
        return self._times[frame_id]

    @cached_property
    def _times(self) -> Mapping[str, float]:
        return read_times(self.root / self._description["times"])

    def pose_of(self, frame_id: str) -> Float[np.ndarray, "4 4"] | None:
        """Return the pose of the LiDAR in the folder `poses`, or None if the key is not set.

        Raises:
            DataError: if the frame's file is missing, or not a pose.
        """
        if "poses" not in self._description:
            return None
        check_frame_id(frame_id)
        path = self.root / self._description["poses"] / f"{frame_id}.txt"
        self._boundary.check(path)
        return read_pose(path)

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """Read the frame's calibration and image size, and its points and image if requested.

        Raises:
            DataError: if a file is missing, damaged or malformed.
        """
        files = self.files(frame_id)
        sweep = np.zeros((0, 4), dtype=np.float32)
        if points:
            sweep = read_cloud(files.points, self.layout)
        found = Frame(frame_id, sweep, self._label_calibration(frame_id), None)
        if not self._cameras:
            return found
        return found.with_cameras([self._camera(each, frame_id, image) for each in self._cameras])

    def _camera(self, table: _CameraTable, frame_id: str, pixels: bool) -> Camera:
        """Return a camera of a frame, with its pixels if requested and if there are images."""
        image = table.image(frame_id)
        size, content = read_optional_image(image, table.image_size, pixels=pixels)
        if size is None:
            raise DataError(f"{self._path}: the camera of frame {frame_id} has no image size")
        name = table.name if len(self._cameras) > 1 else ""
        return Camera(name, self._calibration(table.name, frame_id), size, content)

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth in the LiDAR frame.

        Raises:
            DataError: if there is no label file, or it is malformed.
        """
        label = self.files(frame_id).label
        if label is None:
            expected = self._label(frame_id)
            if expected is None:
                raise DataError(
                    f"{self._path}: no labels for frame {frame_id}: there is no key labels; set it "
                    "to the folder of label files"
                )
            raise DataError(f"{expected}: no such label file")
        return read_annotations(label, self._label_calibration(frame_id), categories=None)

    def _label_calibration(self, frame_id: str) -> Calibration:
        """Return the calibration that the labels refer to: that of the first camera."""
        if not self._calibrations:
            return replace(calibration_without_camera(), rotation_y=self._rotation_y)
        return self._calibration(next(iter(self._calibrations)), frame_id)

    def _calibration(self, camera: str, frame_id: str) -> Calibration:
        """Return the calibration of a camera in a frame."""
        found = self._calibrations[camera]
        if isinstance(found, Path):
            return read_calibration(_of_frame(found, frame_id), rotation_y=self._rotation_y)
        return found

    @cached_property
    def _calibrations(self) -> Mapping[str, Calibration | Path]:
        """The calibration of each camera by name; without a camera, that of the labels.

        A folder stands for a file per frame. Calibrations that all frames share are read once.
        """
        tables = {each.name: each.calibration for each in self._cameras}
        if not tables and "calibration" in self._description:
            tables = {"": _calibration_of(self._path.parent, self._description["calibration"])}
        return {
            name: calibration
            if isinstance(calibration, Path) and calibration.is_dir()
            else replace(
                _read_calibration(self._path, _place(name, "calibration"), calibration),
                rotation_y=self._rotation_y,
            )
            for name, calibration in tables.items()
        }

    def _label(self, frame_id: str) -> Path | None:
        if "labels" not in self._description:
            return None
        return self.root / str(self._description["labels"]) / f"{frame_id}.txt"


def _read_description(path: Path) -> Mapping[str, Any]:
    """Return the content of dataset.toml.

    Raises:
        DataError: if the file is missing or not TOML, or a key is missing, unknown or invalid.
    """
    try:
        content = parse_toml(read_text(path, "description"))
    except (RecursionError, ValueError) as error:  # ValueError also for very long integers
        raise DataError(f"{path}: not TOML: {' '.join(str(error).split())[:200]}") from None
    unknown = sorted(set(content) - set(_KEYS))
    if unknown:
        raise DataError(
            f"{path}: unknown key {unknown[0]}; use one of {', '.join(_KEYS)}"
            f"{did_you_mean(unknown[0], _KEYS)}"
        )
    if "points" not in content:
        raise DataError(f"{path}: no key points")
    has_camera = not content.keys().isdisjoint(("images", "image_size"))
    if (
        "calibration" not in content
        and "cameras" not in content
        and has_camera | ("labels" in content)
    ):
        needed_by = (
            "images" if has_camera else "labels in KITTI's form, which are in a camera frame,"
        )
        raise DataError(f"{path}: no key calibration; {needed_by} need it, see docs/datasets.md")
    invalid = [key for key in _TEXTS if not isinstance(content.get(key, ""), str)]
    if not isinstance(content.get("calibration", ""), str | dict):
        invalid.append("calibration")
    if invalid:
        raise DataError(
            f"{path}: invalid value of {invalid[0]}; folders and separators are strings, and "
            "calibration is a table, a file or a folder"
        )
    return content


def _cameras(path: Path, description: Mapping[str, Any]) -> Sequence[_CameraTable]:
    """Return the cameras of a description, in its order; empty if it has none.

    Raises:
        DataError: if the table of a camera is malformed, or cameras are described twice.
    """
    tables = description.get("cameras")
    if tables is None:
        has_camera = not description.keys().isdisjoint(("images", "image_size"))
        return [_camera_table(path, "", description)] if has_camera else []
    shared = [key for key in _OF_CAMERA if key in description]
    if shared:
        raise DataError(
            f"{path}: both {shared[0]} and [cameras.NAME]; move {shared[0]} into the table of its "
            "camera"
        )
    if not isinstance(tables, dict) or not tables:
        raise DataError(f"{path}: cameras must be tables [cameras.NAME]")
    for name, table in tables.items():
        check_frame_id(name)  # the name of a folder of semantic maps
        if not isinstance(table, dict):
            raise DataError(f"{path}: cameras.{name} is not a table [cameras.{name}]")
        unknown = sorted(set(table) - set(_OF_CAMERA))
        if unknown:
            raise DataError(
                f"{path}: unknown key cameras.{name}.{unknown[0]}"
                f"{did_you_mean(unknown[0], _OF_CAMERA)}; use one of {', '.join(_OF_CAMERA)}"
            )
        if "calibration" not in table:
            raise DataError(f"{path}: no key cameras.{name}.calibration")
    cameras = [_camera_table(path, name, table) for name, table in tables.items()]
    with_images = [each.name for each in cameras if each.images]
    if len(with_images) not in (0, len(cameras)):
        raise DataError(
            f"{path}: cameras {', '.join(with_images)} have images, the others only an image_size; "
            "give images for all cameras, or for none"
        )
    return cameras


def _camera_table(path: Path, name: str, table: Mapping[str, Any]) -> _CameraTable:
    """Return the description of one camera."""
    if ("images" in table) == ("image_size" in table):
        both = "both" if "images" in table else "neither"
        raise DataError(
            f"{path}: {_place(name, 'images')} and image_size: {both} are set; image_size is only "
            "for cameras without images, "
            + ("remove one" if both == "both" else "set one")
            + " of them"
        )
    images, size, calibration = (table.get(key) for key in _OF_CAMERA)
    if not isinstance(images, str | None) or not isinstance(calibration, str | dict):
        raise DataError(
            f"{path}: {_place(name, 'images')} must be a folder, and calibration a file or a table"
        )
    try:
        image_size = None if size is None else check_image_size(size, _place(name, "image_size"))
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from None
    return _CameraTable(
        name,
        None if images is None else FrameFolder(path.parent / images, IMAGE_SUFFIXES, "image"),
        image_size,
        _calibration_of(path.parent, calibration),
    )


def _place(name: str, key: str) -> str:
    """Return the place of a key of a camera in dataset.toml."""
    return f"cameras.{name}.{key}" if name else key


def _calibration_of(root: Path, value: str | Mapping[str, Any]) -> Path | Mapping[str, Any]:
    return root / value if isinstance(value, str) else value


def _read_calibration(path: Path, place: str, calibration: Path | Mapping[str, Any]) -> Calibration:
    """Return the calibration in a file, or in a table of dataset.toml."""
    if isinstance(calibration, Path):
        return read_calibration(calibration)
    projection = _matrix(path, place, calibration, "projection", ((3, 4),))
    extrinsic = np.eye(4)
    rows = _matrix(path, place, calibration, "lidar_to_camera", ((3, 4), (4, 4)))
    extrinsic[: len(rows)] = rows
    check_lidar_to_camera(extrinsic, f"{path}: {place}.lidar_to_camera")
    return Calibration(projection, extrinsic)


def _described_layout(path: Path, description: Mapping[str, Any]) -> PointLayout:
    """Return the layout of the point files in dataset.toml.

    Raises:
        DataError: if a value is invalid, or two of them contradict each other.
    """
    values = {key: description[key] for key in _LAYOUT if key in description}
    names = values.get("column_names", ())
    valid = {
        "columns": _is_integer(values.get("columns", 4)),
        "column_names": isinstance(names, list | tuple) and all(isinstance(n, str) for n in names),
        "intensity_field": isinstance(values.get("intensity_field", ""), str),
        "intensity_scale": _positive(values.get("intensity_scale", 1)),
    }
    invalid = [key for key, is_valid in valid.items() if not is_valid]
    if invalid:
        raise DataError(
            f"{path}: invalid value of {invalid[0]}; columns is an integer from 3, column_names a "
            "list of strings, intensity_field a string, and intensity_scale a positive number"
        )
    if names:
        values["column_names"] = tuple(names)
    try:
        return PointLayout(**values)
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from None


def _merged(described: PointLayout, declared: PointLayout, path: Path) -> PointLayout:
    """Return the layout of dataset.toml with the settings of the workspace.

    Raises:
        ConfigError: if they contradict each other.
    """
    for key in _LAYOUT:
        one, other = getattr(described, key), getattr(declared, key)
        if None not in (one, other) and one != other:
            raise ConfigError(
                f"dataset.{key} is {other!r}, but {path} has {key} = {one!r}; remove one of them"
            )
    values = {
        key: getattr(described if getattr(declared, key) is None else declared, key)
        for key in _LAYOUT
    }
    try:
        return PointLayout(**values)
    except ConfigError as error:
        raise ConfigError(f"{error} (settings in [dataset] and {path})") from None


def _is_integer(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _of_frame(path: Path, frame_id: str) -> Path:
    """Return a path of a calibration, or of the frame's file in it if it is a folder."""
    return path / f"{frame_id}.txt" if path.is_dir() else path


def _positive(value: object) -> bool:
    # tomllib reads integers of any size; larger ones cannot be converted to float.
    return isinstance(value, int | float) and 0 < value <= sys.float_info.max


def _matrix(
    path: Path,
    place: str,
    calibration: Mapping[str, Any],
    key: str,
    shapes: tuple[tuple[int, int], ...],
) -> np.ndarray:
    try:
        matrix = np.array(calibration.get(key, ()), dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in shapes or not np.isfinite(matrix).all():
        expected = " or ".join(f"{rows} x {columns}" for rows, columns in shapes)
        raise DataError(f"{path}: {place}.{key} must be {expected} finite numbers")
    return matrix
