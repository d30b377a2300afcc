"""A reader of any folder of point files and images with a single calibration.

The file ROOT/dataset.toml describes the folder:

points = "lidar"              # folder of FRAME.bin, .pcd, .ply or .npy
images = "camera"             # folder of FRAME.png or .jpg; if there are no images, instead:
# image_size = [1242, 375]    # width and height in pixels of the calibrated camera's image
labels = "label_2"            # optional: folder of KITTI label files of the labeled frames
splits = "lists"              # optional: folder of train.txt, val.txt
sequence_separator = "_"      # optional: frames are named SEQUENCE_NUMBER; the last one separates
columns = 4                   # number of columns of .bin and .npy files
column_names = ["x", "y", "z", "intensity", "ring"]   # optional: their names, in any order
intensity_field = "intensity" # optional: the column of the intensity, where several may be it
intensity_scale = 255.0       # the value of full intensity in the files

[calibration]                 # or calibration = "calib.txt", a file in KITTI's format,
                              # or calibration = "calib", a folder of such files FRAME.txt
projection = [[...], [...], [...]]             # 3 x 4, camera (z forward) to pixels
lidar_to_camera = [[...], [...], [...]]        # 3 x 4 or 4 x 4, LiDAR (x forward) to camera
"""

import sys
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from curate.datasets.formats.clouds import CLOUD_SUFFIXES, read_cloud
from curate.datasets.formats.containment import Boundary, check_frame_id
from curate.datasets.formats.frame_files import IMAGE_SUFFIXES, FrameFolder
from curate.datasets.formats.images import read_sized_image
from curate.datasets.formats.point_layout import UNDECLARED, PointLayout
from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.dataset import checked_frames, read_frame_lists
from curate.datasets.kitti.labels import read_objects, to_annotations
from curate.datasets.recognition import layout_hint
from curate.detections import Annotations
from curate.errors import ConfigError, DataError
from curate.files.paths import StrPath
from curate.files.text import read_text
from curate.files.toml_text import parse_toml
from curate.frames import Calibration, Frame, FrameFiles
from curate.spelling import did_you_mean

DESCRIPTION = "dataset.toml"
_FOLDERS = ("points", "images", "labels", "splits")
_TEXTS = (*_FOLDERS, "sequence_separator")
# The keys that describe the point files; the settings in [dataset] have the same names.
_LAYOUT = ("columns", "column_names", "intensity_field", "intensity_scale")
_KEYS = (*_TEXTS, *_LAYOUT, "image_size", "calibration")


class FolderDataset:
    """A `Dataset` in a plain folder; every point file is a frame.

    Args:
        root: the folder with dataset.toml.
        layout: the declared layout of the point files, in place of the keys of dataset.toml.
        follow_links: whether links and paths in dataset.toml may lead out of the folder.

    Raises:
        DataError: if dataset.toml is missing or malformed, or specifies neither images nor their
            size. The size is necessary: the camera's field of view decides which points are passed
            to a detector, and it clips every 2D box.
        ConfigError: if the layout and dataset.toml contradict each other.
    """

    name = "folder"

    def __init__(
        self,
        root: StrPath,
        *,
        layout: PointLayout = UNDECLARED,
        follow_links: bool = False,
    ) -> None:
        self.root = Path(root)
        self._boundary = Boundary(self.root, follow_links=follow_links)
        self._path = self.root / DESCRIPTION
        self._boundary.check(self._path)
        if not self._path.exists():
            raise DataError(
                f"{self._path}: no such description file{layout_hint(self.root, self.name)}"
            )
        self._description = _read_description(self._path)
        self._layout = _merged(_described_layout(self._path, self._description), layout, self._path)
        keys = (*_FOLDERS, "calibration")
        paths = [self._description[key] for key in keys if key in self._description]
        self._boundary.check(*(self.root / path for path in paths if isinstance(path, str)))

    def frame_ids(self) -> tuple[str, ...]:
        """Return the ids of all frames with a point file, sorted.

        Raises:
            DataError: if there are none, or a frame has two point files or two images.
        """
        return self._frame_ids

    @cached_property
    def _frame_ids(self) -> tuple[str, ...]:
        return checked_frames(self._points, self._images, self.root, self.name)

    @cached_property
    def _points(self) -> FrameFolder:
        return FrameFolder(self.root / self._description["points"], CLOUD_SUFFIXES, "point")

    @cached_property
    def _images(self) -> FrameFolder:
        folder = self.root / self._description.get("images", "images")
        return FrameFolder(folder, IMAGE_SUFFIXES, "image")

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

        The paths of image and calibration are returned even if there are no such files.

        Raises:
            DataError: if there is no such frame, or it has two point files or two images.
        """
        check_frame_id(frame_id)
        points = self._points.path(frame_id)
        if frame_id not in self._points:
            raise DataError(f"{self._points.folder}: no point file for frame {frame_id}")
        label = self._label(frame_id)
        files = FrameFiles(
            points=points,
            image=self._images.path(frame_id),
            calibration=self._calibration_path(frame_id),
            label=label if label is not None and label.exists() else None,
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
            sweep = read_cloud(files.points, self._layout)
        size, pixels = self._size_and_pixels(files.image, pixels=image)
        return Frame(frame_id, sweep, self._calibration(files.calibration), size, pixels)

    def _size_and_pixels(
        self, image: Path, *, pixels: bool
    ) -> tuple[tuple[int, int], np.ndarray | None]:
        """Return (width, height) of an image, from dataset.toml if there are none, and its pixels.

        The pixels are None if they are not requested.
        """
        if "images" in self._description:
            return read_sized_image(image, pixels=pixels)
        if pixels:
            raise DataError(
                f"{self._path}: the image of frame {image.stem} is needed, but there is no key "
                "images; set it to the folder of images"
            )
        width, height = self._description["image_size"]
        return (width, height), None

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth in the LiDAR frame.

        Raises:
            DataError: if there is no label file, or it is malformed.
        """
        files = self.files(frame_id)
        if files.label is None:
            expected = self._label(frame_id)
            if expected is None:
                raise DataError(
                    f"{self._path}: no labels for frame {frame_id}: there is no key labels; set it "
                    "to the folder of label files"
                )
            raise DataError(f"{expected}: no such label file")
        objects = read_objects(files.label, categories=None)
        return to_annotations(objects, self._calibration(files.calibration))

    def _calibration_path(self, frame_id: str) -> Path:
        """Return the file with the calibration of a frame."""
        calibration = self._description["calibration"]
        if not isinstance(calibration, str):
            return self._path
        path = self.root / calibration
        return path / f"{frame_id}.txt" if self._calibrated_by_frame else path

    @cached_property
    def _calibrated_by_frame(self) -> bool:
        """Whether the calibration is a folder with a file for each frame."""
        calibration = self._description["calibration"]
        return isinstance(calibration, str) and (self.root / calibration).is_dir()

    def _calibration(self, path: Path) -> Calibration:
        """Return the calibration in a file, which is read once if all frames share it."""
        return read_calibration(path) if self._calibrated_by_frame else self._shared_calibration

    @cached_property
    def _shared_calibration(self) -> Calibration:
        calibration = self._description["calibration"]
        if isinstance(calibration, str):
            return read_calibration(self.root / calibration)
        projection = _matrix(self._path, calibration, "projection", ((3, 4),))
        extrinsic = np.eye(4)
        rows = _matrix(self._path, calibration, "lidar_to_camera", ((3, 4), (4, 4)))
        extrinsic[: len(rows)] = rows
        if abs(np.linalg.det(extrinsic)) < 1e-6:
            raise DataError(f"{self._path}: calibration.lidar_to_camera cannot be inverted")
        return Calibration(projection, extrinsic)

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
    for key in ("points", "calibration"):
        if key not in content:
            raise DataError(f"{path}: no key {key}")
    if "images" not in content and "image_size" not in content:
        raise DataError(
            f"{path}: no key images; data sets without a camera are not supported: the camera's "
            "field of view selects the points and clips every 2D box; if only the images are "
            "missing, set image_size = [width, height]"
        )
    if "images" in content and "image_size" in content:
        raise DataError(
            f"{path}: both images and image_size are set; image_size is only for data sets "
            "without images, remove one of them"
        )
    invalid = [key for key in _TEXTS if not isinstance(content.get(key, ""), str)]
    invalid += [] if _is_size(content.get("image_size", [1, 1])) else ["image_size"]
    if not isinstance(content["calibration"], str | dict):
        invalid.append("calibration")
    if invalid:
        raise DataError(
            f"{path}: invalid value of {invalid[0]}; folders and separators are strings, sizes "
            "positive numbers, and calibration is a table, a file or a folder"
        )
    return content


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


def _is_size(value: object) -> bool:
    """Return whether the value is a list of width and height in pixels."""
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(side, int) and _positive(side) for side in value)
    )


def _positive(value: object) -> bool:
    # tomllib reads integers of any size; larger ones cannot be converted to float.
    return isinstance(value, int | float) and 0 < value <= sys.float_info.max


def _matrix(
    path: Path, calibration: Mapping[str, Any], key: str, shapes: tuple[tuple[int, int], ...]
) -> np.ndarray:
    try:
        matrix = np.array(calibration.get(key, ()), dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in shapes or not np.isfinite(matrix).all():
        expected = " or ".join(f"{rows} x {columns}" for rows, columns in shapes)
        raise DataError(f"{path}: calibration.{key} must be {expected} finite numbers")
    return matrix
