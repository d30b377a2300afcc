"""A reader of any folder of point files and images with a single calibration.

The file ROOT/dataset.toml describes the folder:

points = "lidar"              # folder of FRAME.bin, .pcd, .ply or .npy
images = "camera"             # folder of FRAME.png or .jpg; if there are no images, instead:
# image_size = [1242, 375]    # width and height in pixels of the calibrated camera's image
labels = "label_2"            # optional: folder of KITTI label files of the labeled frames
splits = "lists"              # optional: folder of train.txt, val.txt
sequence_separator = "_"      # optional: frames are named SEQUENCE_NUMBER; the last one separates
columns = 4                   # columns of .bin and .npy files
intensity_scale = 255.0       # the value of full intensity in the files

[calibration]                 # or calibration = "calib.txt", a file in KITTI's format
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
from curate.datasets.formats.images import read_sized_image
from curate.datasets.kitti.dataset import (
    IMAGE_SUFFIXES,
    read_bytes,
    read_calibration,
    read_frame_lists,
    visible_files,
)
from curate.datasets.kitti.labels import read_annotations
from curate.detections import Annotations
from curate.errors import DataError
from curate.files.paths import StrPath
from curate.files.toml_text import parse_toml
from curate.frames import Calibration, Frame, FrameFiles, RotationY
from curate.geometry.mounting import check_lidar_to_camera, check_rotation_y

DESCRIPTION = "dataset.toml"
_FOLDERS = ("points", "images", "labels", "splits")
_TEXTS = (*_FOLDERS, "sequence_separator")
_KEYS = (*_TEXTS, "image_size", "columns", "intensity_scale", "calibration")


class FolderDataset:
    """A `Dataset` in a plain folder; every point file is a frame.

    Args:
        root: the folder with dataset.toml.
        follow_links: whether links and paths in dataset.toml may lead out of the folder.
        rotation_y: who computed rotation_y of the labels; see `curate.frames.RotationY`.

    Raises:
        ConfigError: if `rotation_y` is unknown.
        DataError: if dataset.toml is missing or malformed, or specifies neither images nor their
            size. The size is necessary: the camera's field of view decides which points are passed
            to a detector, and it clips every 2D box.
    """

    name = "folder"

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
        self._path = self.root / DESCRIPTION
        self._boundary.check(self._path)
        self._description = _read_description(self._path)
        keys = (*_FOLDERS, "calibration")
        paths = [self._description[key] for key in keys if key in self._description]
        self._boundary.check(*(self.root / path for path in paths if isinstance(path, str)))

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

        The image path is returned even if there is no such file.

        Raises:
            DataError: if there is no such frame.
        """
        check_frame_id(frame_id)
        if frame_id not in self._points:
            folder = self.root / self._description["points"]
            raise DataError(f"{folder}: no point file for frame {frame_id}")
        folder = self.root / self._description.get("images", "images")
        images = [folder / f"{frame_id}{suffix}" for suffix in IMAGE_SUFFIXES]
        calibration = self._description["calibration"]
        label = self._label(frame_id)
        files = FrameFiles(
            points=self._points[frame_id],
            image=next((image for image in images if image.exists()), images[0]),
            calibration=self.root / calibration if isinstance(calibration, str) else self._path,
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
            scale = float(self._description.get("intensity_scale", 1.0))
            sweep = read_cloud(files.points, int(self._description.get("columns", 4)), scale)
        size, pixels = self._size_and_pixels(files.image, pixels=image)
        return Frame(frame_id, sweep, self._calibration, size, pixels)

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
        label = self.files(frame_id).label
        if label is None:
            expected = self._label(frame_id)
            if expected is None:
                raise DataError(
                    f"{self._path}: no labels for frame {frame_id}: there is no key labels; set it "
                    "to the folder of label files"
                )
            raise DataError(f"{expected}: no such label file")
        return read_annotations(label, self._calibration, categories=None)

    @cached_property
    def _calibration(self) -> Calibration:
        calibration = self._description["calibration"]
        if isinstance(calibration, str):
            return read_calibration(self.root / calibration, self._rotation_y)
        projection = _matrix(self._path, calibration, "projection", ((3, 4),))
        extrinsic = np.eye(4)
        rows = _matrix(self._path, calibration, "lidar_to_camera", ((3, 4), (4, 4)))
        extrinsic[: len(rows)] = rows
        check_lidar_to_camera(extrinsic, f"{self._path}: calibration.lidar_to_camera")
        return Calibration(projection, extrinsic, rotation_y=self._rotation_y)

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
    invalid += [key for key in ("columns", "intensity_scale") if not _positive(content.get(key, 1))]
    if (
        invalid
        or not isinstance(content["calibration"], str | dict)
        or content.get("columns", 4) < 3
    ):
        raise DataError(
            f"{path}: invalid value of {(invalid or ['calibration or columns'])[0]}; folders and "
            "separators are strings, sizes and scales positive numbers, columns at least 3"
        )
    return content


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
