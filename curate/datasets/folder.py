"""Any folder of point files and images with one calibration, described in ROOT/dataset.toml.

points = "lidar"              # folder of FRAME.bin, .pcd, .ply or .npy
images = "camera"             # folder of FRAME.png or .jpg; where there are none, instead:
# image_size = [1242, 375]    # width and height of what the camera of the calibration sees
labels = "label_2"            # optional: KITTI label files of the labeled frames
splits = "lists"              # optional: folder of train.txt, val.txt
sequence_separator = "_"      # optional: frames are named SEQUENCE_NUMBER, split at the last of it
columns = 4                   # of .bin and .npy files
intensity_scale = 255.0       # what full intensity is in the files

[calibration]                 # or calibration = "calib.txt", a file in KITTI's form
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
from curate.datasets.kitti.labels import read_objects, to_annotations
from curate.detections import Annotations
from curate.errors import DataError
from curate.files.paths import StrPath
from curate.files.toml_text import parse_toml
from curate.frames import Calibration, Frame, FrameFiles

DESCRIPTION = "dataset.toml"
_FOLDERS = ("points", "images", "labels", "splits")
_TEXTS = (*_FOLDERS, "sequence_separator")
_KEYS = (*_TEXTS, "image_size", "columns", "intensity_scale", "calibration")


class FolderDataset:
    """A `Dataset` in a plain folder; its frames are the ones that have a point file.

    Args:
        root: the folder that holds dataset.toml.
        follow_links: whether links and names in dataset.toml may lead out of it.

    Raises:
        DataError: the description is missing or malformed, or names neither images nor their size
            (which points a detector saw, and every 2D box, follow from what the camera sees).
    """

    name = "folder"

    def __init__(self, root: StrPath, *, follow_links: bool = False) -> None:
        self.root = Path(root)
        self._boundary = Boundary(self.root, follow_links=follow_links)
        self._path = self.root / DESCRIPTION
        self._boundary.check(self._path)
        self._told = _read_description(self._path)
        named = [self._told[key] for key in (*_FOLDERS, "calibration") if key in self._told]
        self._boundary.check(*(self.root / name for name in named if isinstance(name, str)))

    def frame_ids(self) -> tuple[str, ...]:
        """Return all frames with a point file, in sorted order."""
        return tuple(self._points)

    @cached_property
    def _points(self) -> Mapping[str, Path]:
        """The point file of each frame."""
        found = visible_files(self.root / self._told["points"], "*")
        paths = sorted(path for path in found if path.suffix.lower() in CLOUD_SUFFIXES)
        return {path.stem: path for path in paths}

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the lists of the folder `splits`, by file name.

        Raises:
            DataError: if the folder is named, but holds none; no frame would be kept for val.
        """
        if "splits" not in self._told:
            return {}
        folder = self.root / self._told["splits"]
        found = read_frame_lists(folder, self._boundary)
        if not found:
            raise DataError(f"{self._path}: splits: {folder} holds no list such as train.txt")
        return found

    def files(self, frame_id: str) -> FrameFiles:
        """Where the frame's files lie, or an image would; the calibration is that of all frames.

        Raises:
            DataError: if there is no such frame.
        """
        check_frame_id(frame_id)
        if frame_id not in self._points:
            raise DataError(f"{self.root / self._told['points']}: no point file of {frame_id}")
        folder = self.root / self._told.get("images", "images")
        images = [folder / f"{frame_id}{suffix}" for suffix in IMAGE_SUFFIXES]
        calibration = self._told["calibration"]
        label = self._label(frame_id)
        found = FrameFiles(
            points=self._points[frame_id],
            image=next((image for image in images if image.exists()), images[0]),
            calibration=self.root / calibration if isinstance(calibration, str) else self._path,
            label=label if label is not None and label.exists() else None,
        )
        self._boundary.check(*found.paths())
        return found

    def sequence_of(self, frame_id: str) -> str | None:
        """What stands before the last separator of the frame's name, where there is one."""
        separator = self._told.get("sequence_separator", "")
        if not separator or separator not in frame_id:
            return None
        return frame_id.rpartition(separator)[0]

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """The frame's calibration, its points unless unwanted, and its image where asked for.

        Raises:
            DataError: if a file is missing, damaged or malformed.
        """
        files = self.files(frame_id)
        sweep = np.zeros((0, 4), dtype=np.float32)
        if points:
            scale = float(self._told.get("intensity_scale", 1.0))
            sweep = read_cloud(files.points, int(self._told.get("columns", 4)), scale)
        size, pixels = self._seen(files.image, pixels=image)
        return Frame(frame_id, sweep, self._calibration, size, pixels)

    def _seen(self, image: Path, *, pixels: bool) -> tuple[tuple[int, int], np.ndarray | None]:
        """Size and pixels of an image; the size is known without images too."""
        if "images" in self._told:
            return read_sized_image(image, pixels=pixels)
        if pixels:
            raise DataError(
                f"{self._path}: no key images, but the pixels of {image.stem} are needed; "
                "name the folder of images"
            )
        width, height = self._told["image_size"]
        return (width, height), None

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth in the LiDAR frame.

        Raises:
            DataError: if there is no label file, or it is malformed.
        """
        label = self.files(frame_id).label
        if label is None:
            named = self._label(frame_id) or f"{self._path}: names no labels, nor of {frame_id}"
            raise DataError(f"{named}: no such label file")
        return to_annotations(read_objects(label, known=None), self._calibration)

    @cached_property
    def _calibration(self) -> Calibration:
        told = self._told["calibration"]
        if isinstance(told, str):
            return read_calibration(self.root / told)
        projection = _matrix(self._path, told, "projection", ((3, 4),))
        extrinsic = np.eye(4)
        rows = _matrix(self._path, told, "lidar_to_camera", ((3, 4), (4, 4)))
        extrinsic[: len(rows)] = rows
        if abs(np.linalg.det(extrinsic)) < 1e-6:
            raise DataError(f"{self._path}: calibration.lidar_to_camera cannot be inverted")
        return Calibration(projection, extrinsic)

    def _label(self, frame_id: str) -> Path | None:
        if "labels" not in self._told:
            return None
        return self.root / str(self._told["labels"]) / f"{frame_id}.txt"


def _read_description(path: Path) -> Mapping[str, Any]:
    """What dataset.toml says; DataError where it cannot be."""
    try:
        told = parse_toml(read_bytes(path, "description").decode("utf-8"))
    except (RecursionError, ValueError) as error:  # ValueError: also of absurdly long numbers
        raise DataError(f"{path}: not TOML: {' '.join(str(error).split())[:200]}") from None
    unknown = sorted(set(told) - set(_KEYS))
    if unknown:
        raise DataError(f"{path}: unknown key {unknown[0]}; known are {', '.join(_KEYS)}")
    for key in ("points", "calibration"):
        if key not in told:
            raise DataError(f"{path}: no key {key}")
    if "images" not in told and "image_size" not in told:
        raise DataError(
            f"{path}: no key images; data sets without a camera are not read: which points a "
            "detector saw, and every 2D box, come from the image and its calibration; "
            "where only the images are missing, write image_size = [width, height]"
        )
    if "images" in told and "image_size" in told:
        raise DataError(
            f"{path}: image_size is for data sets without images; leave one of them out"
        )
    wrong = [key for key in _TEXTS if not isinstance(told.get(key, ""), str)]
    wrong += [] if _is_size(told.get("image_size", [1, 1])) else ["image_size"]
    wrong += [key for key in ("columns", "intensity_scale") if not _positive(told.get(key, 1))]
    if wrong or not isinstance(told["calibration"], str | dict) or told.get("columns", 4) < 3:
        raise DataError(f"{path}: {(wrong or ['calibration or columns'])[0]} cannot be that")
    return told


def _is_size(value: object) -> bool:
    """Return whether it is width and height in pixels."""
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(side, int) and _positive(side) for side in value)
    )


def _positive(value: object) -> bool:
    # TOML's integers have no end; floating point numbers have.
    return isinstance(value, int | float) and 0 < value <= sys.float_info.max


def _matrix(
    path: Path, told: Mapping[str, Any], key: str, shapes: tuple[tuple[int, int], ...]
) -> np.ndarray:
    try:
        matrix = np.array(told.get(key, ()), dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in shapes or not np.isfinite(matrix).all():
        known = " or ".join(f"{rows} x {columns}" for rows, columns in shapes)
        raise DataError(f"{path}: calibration.{key} must be {known} finite numbers")
    return matrix
