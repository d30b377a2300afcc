"""A reader of any folder of point files, with the images of no, one or several cameras.

The file ROOT/dataset.toml describes the folder:

points = "lidar"              # folder of FRAME.bin, .pcd, .ply or .npy
images = "camera"             # folder of FRAME.png or .jpg; if there are no images, optionally:
# image_size = [1242, 375]    # width and height in pixels of the calibrated camera's image
labels = "label_2"            # optional: folder of KITTI label files of the labeled frames
splits = "lists"              # optional: folder of train.txt, val.txt
sequence_separator = "_"      # optional: frames are named SEQUENCE_NUMBER; the last one separates
columns = 4                   # columns of .bin and .npy files
intensity_scale = 255.0       # the value of full intensity in the files

[calibration]                 # or calibration = "calib.txt", a file in KITTI's format
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
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from curate.datasets.formats.clouds import CLOUD_SUFFIXES, read_cloud
from curate.datasets.formats.containment import Boundary, check_frame_id
from curate.datasets.formats.images import check_image_size, read_optional_image
from curate.datasets.kitti.dataset import (
    IMAGE_SUFFIXES,
    read_bytes,
    read_calibration,
    read_frame_lists,
    visible_files,
)
from curate.datasets.kitti.labels import read_objects, to_annotations
from curate.detections import Annotations
from curate.errors import ConfigError, DataError
from curate.files.paths import StrPath
from curate.files.toml_text import parse_toml
from curate.frames import Calibration, Camera, Frame, FrameFiles, calibration_without_camera
from curate.spelling import did_you_mean

DESCRIPTION = "dataset.toml"
_FOLDERS = ("points", "images", "labels", "splits")
_TEXTS = (*_FOLDERS, "sequence_separator")
_OF_CAMERA = ("images", "image_size", "calibration")
_KEYS = (*_TEXTS, "image_size", "columns", "intensity_scale", "calibration", "cameras")


@dataclass(frozen=True)
class _CameraTable:
    """The part of dataset.toml that describes one camera.

    Attributes:
        name: name of the camera; "" without a table [cameras.NAME].
        images: folder of its images; None if there are none.
        image_size: (width, height) in pixels of a camera without images; None if it has images.
        calibration: path of a file in KITTI's format, or a table of matrices.
    """

    name: str
    images: Path | None
    image_size: tuple[int, int] | None
    calibration: Path | Mapping[str, Any]

    def image(self, frame_id: str) -> Path | None:
        """Return the path of a frame's image, whether it exists or not; None without images."""
        if self.images is None:
            return None
        paths = [self.images / f"{frame_id}{suffix}" for suffix in IMAGE_SUFFIXES]
        return next((path for path in paths if path.exists()), paths[0])


class FolderDataset:
    """A `Dataset` in a plain folder; every point file is a frame.

    Args:
        root: the folder with dataset.toml.
        follow_links: whether links and paths in dataset.toml may lead out of the folder.

    Raises:
        DataError: if dataset.toml is missing or malformed.
    """

    name = "folder"

    def __init__(self, root: StrPath, *, follow_links: bool = False) -> None:
        self.root = Path(root)
        self._boundary = Boundary(self.root, follow_links=follow_links)
        self._path = self.root / DESCRIPTION
        self._boundary.check(self._path)
        self._description = _read_description(self._path)
        self._cameras = _cameras(self._path, self._description)
        paths = [self._description[key] for key in _FOLDERS if key in self._description]
        paths += [camera.images for camera in self._cameras if camera.images]
        paths += [each.calibration for each in self._cameras if isinstance(each.calibration, Path)]
        self._boundary.check(*(self.root / path for path in paths))

    def frame_ids(self) -> tuple[str, ...]:
        """Return the ids of all frames with a point file, sorted."""
        return tuple(self._points)

    @cached_property
    def _points(self) -> Mapping[str, Path]:
        """The path of the point file of each frame."""
        files = visible_files(self.root / self._description["points"], "*")
        paths = sorted(path for path in files if path.suffix.lower() in CLOUD_SUFFIXES)
        return {path.stem: path for path in paths}

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the frame lists in the folder `splits`, by file name without suffix.

        Raises:
            DataError: if the folder is specified but contains no list. Otherwise, no frame would be
                kept for val.
        """
        if "splits" not in self._description:
            return {}
        folder = self.root / self._description["splits"]
        lists = read_frame_lists(folder, self._boundary)
        if not lists:
            raise DataError(
                f"{self._path}: splits: {folder} contains no frame list such as train.txt"
            )
        return lists

    def files(self, frame_id: str) -> FrameFiles:
        """Return the paths of the frame's files; all frames share the calibration.

        Image paths are returned even if there are no such files.

        Raises:
            DataError: if there is no such frame.
        """
        check_frame_id(frame_id)
        if frame_id not in self._points:
            folder = self.root / self._description["points"]
            raise DataError(f"{folder}: no point file for frame {frame_id}")
        images = [each.image(frame_id) for each in self._cameras]
        calibration = self._description.get("calibration")
        label = self._label(frame_id)
        files = FrameFiles(
            points=self._points[frame_id],
            image=images[0] if images else None,
            calibration=self.root / calibration if isinstance(calibration, str) else self._path,
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

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """Read the frame's calibration and image size, and its points and image if requested.

        Raises:
            DataError: if a file is missing, damaged or malformed.
        """
        files = self.files(frame_id)
        sweep = np.zeros((0, 4), dtype=np.float32)
        if points:
            scale = float(self._description.get("intensity_scale", 1.0))
            sweep = read_cloud(files.points, int(self._description.get("columns", 4)), scale)
        found = Frame(frame_id, sweep, self._calibration, None)
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
        return Camera(name, self._calibrations[table.name], size, content)

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
        return to_annotations(read_objects(label, categories=None), self._calibration)

    @property
    def _calibration(self) -> Calibration:
        """The calibration that the labels refer to: that of the first camera."""
        return next(iter(self._calibrations.values()))

    @cached_property
    def _calibrations(self) -> Mapping[str, Calibration]:
        """The calibration of each camera by name; without a camera, that of the labels."""
        tables = {each.name: each.calibration for each in self._cameras}
        if not tables and "calibration" in self._description:
            tables = {"": _calibration_of(self._path.parent, self._description["calibration"])}
        return {
            name: _read_calibration(self._path, _place(name, "calibration"), calibration)
            for name, calibration in tables.items()
        } or {"": calibration_without_camera()}

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
        content = parse_toml(read_bytes(path, "description").decode("utf-8"))
    except (RecursionError, ValueError) as error:  # ValueError also for very long integers
        raise DataError(f"{path}: not TOML: {' '.join(str(error).split())[:200]}") from None
    unknown = sorted(set(content) - set(_KEYS))
    if unknown:
        raise DataError(f"{path}: unknown key {unknown[0]}; use one of {', '.join(_KEYS)}")
    if "points" not in content:
        raise DataError(f"{path}: no key points")
    has_camera = not content.keys().isdisjoint(("images", "image_size"))
    if (
        "calibration" not in content
        and "cameras" not in content
        and has_camera | ("labels" in content)
    ):
        raise DataError(f"{path}: no key calibration")
    invalid = [key for key in _TEXTS if not isinstance(content.get(key, ""), str)]
    invalid += [key for key in ("columns", "intensity_scale") if not _positive(content.get(key, 1))]
    if (
        invalid
        or not isinstance(content.get("calibration", ""), str | dict)
        or content.get("columns", 4) < 3
    ):
        raise DataError(
            f"{path}: invalid value of {(invalid or ['calibration or columns'])[0]}; folders and "
            "separators are strings, sizes and scales positive numbers, columns at least 3"
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
        None if images is None else path.parent / images,
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
    if abs(np.linalg.det(extrinsic)) < 1e-6:
        raise DataError(f"{path}: {place}.lidar_to_camera cannot be inverted")
    return Calibration(projection, extrinsic)


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
