"""Reader of the KITTI object data set, and of other data in its layout.

Source: Geiger et al., "Are we ready for autonomous driving?", CVPR 2012, and the readme of its
object development kit. Two layouts are supported:
ROOT/training/{velodyne,image_2,calib,label_2} and ROOT/{velodyne,image_2,calib,label_2}. label_2
and ROOT/ImageSets/*.txt are optional.
"""

import io
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path

import numpy as np

from curate.datasets.formats.containment import Boundary, check_frame_id
from curate.datasets.formats.images import read_sized_image
from curate.datasets.kitti.labels import read_annotations
from curate.detections import Annotations
from curate.errors import DataError
from curate.files.atomic import replace_file
from curate.files.paths import StrPath
from curate.frames import Calibration, Frame, FrameFiles, RotationY
from curate.geometry.mounting import check_lidar_to_camera, check_rotation_y
from curate.shapes import Float, Float32

_log = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
POINT_BYTES = 16  # x, y, z, intensity, float32 each
# Beyond the range of any LiDAR. Farther points would make grids over the points too large.
MAX_RANGE_METRES = 2000.0
# The folder of KITTI's development kit that says which drive each frame of training/ is from.
_MAPPINGS = ("mapping", "devkit_object/mapping", "devkit/mapping")
_MAPPING_FILES = ("train_mapping.txt", "train_rand.txt")
# Focal lengths are thousands of pixels; the last column of P2 is at most a million.
_MAX_ENTRY = 1e9
CALIBRATION_SHAPES = {"P2": (3, 4), "R0_rect": (3, 3), "Tr_velo_to_cam": (3, 4)}


class KittiDataset:
    """A `Dataset` in KITTI's layout; every velodyne file is a frame.

    Args:
        root: the folder that contains training/velodyne or velodyne.
        follow_links: whether links may lead out of the root.
        rotation_y: who computed rotation_y of the labels; see `curate.frames.RotationY`.

    Raises:
        DataError: if the root contains neither.
        ConfigError: if `rotation_y` is unknown.
    """

    name = "kitti"

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
        homes = [self.root / "training", self.root]
        home = next((home for home in homes if (home / "velodyne").is_dir()), None)
        if home is None:
            raise DataError(
                f"{self.root}: contains neither training/velodyne nor velodyne; "
                "set the root to a data set in KITTI's layout"
            )
        self._home = home
        self._folders = [home / name for name in ("velodyne", "image_2", "calib", "label_2")]

    def frame_ids(self) -> tuple[str, ...]:
        """Return the ids of all frames with a velodyne file, sorted."""
        return self._frame_ids

    @cached_property
    def _frame_ids(self) -> tuple[str, ...]:
        return tuple(sorted(path.stem for path in visible_files(self._home / "velodyne", "*.bin")))

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the lists in ROOT/ImageSets by file name; they may contain missing frames.

        KITTI's test.txt lists frames of ROOT/testing. Their ids are also ids of other frames in
        ROOT/training, so this list is dropped when ROOT/training is read.

        Raises:
            DataError: if a list contains an invalid frame id.
        """
        lists = {
            path.stem: path for path in sorted(visible_files(self.root / "ImageSets", "*.txt"))
        }
        if self._home != self.root and "test" in lists:
            _log.info("%s: skipped, it lists frames of testing/", lists.pop("test"))
        self._boundary.check(*lists.values())
        return {name: read_frame_list(path) for name, path in lists.items()}

    def files(self, frame_id: str) -> FrameFiles:
        """Return the paths of the frame's files; `label` is None if there is no label file.

        Raises:
            DataError: if the frame id is invalid, or a link leads out of the data set.
        """
        check_frame_id(frame_id)
        velodyne, image_2, calib, label_2 = self._folders
        images = [image_2 / f"{frame_id}{suffix}" for suffix in IMAGE_SUFFIXES]
        label = label_2 / f"{frame_id}.txt"
        files = FrameFiles(
            points=velodyne / f"{frame_id}.bin",
            image=next((image for image in images if image.exists()), images[0]),
            calibration=calib / f"{frame_id}.txt",
            label=label if label.exists() else None,
        )
        self._boundary.check(*files.paths())
        return files

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the drive of a frame if the root contains the mapping of KITTI's development kit.

        Raises:
            DataError: if the mapping is malformed, or a link to it leads out of the data set.
        """
        return self._drives.get(frame_id)

    @cached_property
    def _drives(self) -> Mapping[str, str]:
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
        sweep = read_points(files.points) if points else np.zeros((0, 4), dtype=np.float32)
        calibration = read_calibration(files.calibration, self._rotation_y)
        size, pixels = read_sized_image(files.image, pixels=image)
        return Frame(frame_id, sweep, calibration, size, pixels)

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth in the LiDAR frame, DontCare regions included.

        Raises:
            DataError: if there is no label file, or it is malformed.
        """
        files = self.files(frame_id)
        if files.label is None:
            raise DataError(f"{self._home / 'label_2' / frame_id}.txt: no such label file")
        calibration = read_calibration(files.calibration, self._rotation_y)
        return read_annotations(files.label, calibration)


def read_points(path: Path) -> Float32[np.ndarray, "n 4"]:
    """Return the (n, 4) float32 points of a velodyne file: x, y, z in metres, intensity.

    An empty file has no points.

    Raises:
        DataError: if the file is missing or truncated, or contains NaN, infinite numbers, or points
            beyond `MAX_RANGE_METRES`.
    """
    with open_unbuffered(path, "velodyne") as file:
        size = os.fstat(file.fileno()).st_size
        points = np.empty((size // POINT_BYTES, 4), dtype="<f4")
        if size % POINT_BYTES or file.readinto(points.reshape(-1).view(np.uint8).data) != size:
            raise DataError(
                f"{path}: {size} bytes are not a multiple of {POINT_BYTES} "
                "(x, y, z, intensity as float32); the file is truncated, fetch it again"
            )
    # Fast path: the minimum and maximum over all columns reveal NaN and infinite numbers as well.
    low, high = points.min(initial=0), points.max(initial=0)
    if low >= -MAX_RANGE_METRES and high <= MAX_RANGE_METRES:
        return points
    finite = np.isfinite(points)
    if not finite.all():
        bad = np.flatnonzero(~finite.all(axis=1))
        raise DataError(
            f"{path}: {len(bad)} of {len(points)} points are NaN or infinite, "
            f"the first is point {bad[0]}; remove them from the file"
        )
    check_point_range(path, points)
    return points


def check_point_range(path: Path, points: Float[np.ndarray, "n _"]) -> None:
    """Raise DataError if a point of (n, >=3) has a coordinate beyond `MAX_RANGE_METRES`."""
    far = np.abs(points[:, :3]).max(initial=0)
    if far > MAX_RANGE_METRES:
        k = int(np.abs(points[:, :3]).max(axis=1).argmax())
        raise DataError(
            f"{path}: point {k} is {far:.4g} m away; points must be in metres from the LiDAR, "
            f"remove those beyond {MAX_RANGE_METRES:g} m"
        )


def read_calibration(path: Path, rotation_y: RotationY = "calibration") -> Calibration:
    """Return the calibration of the left colour camera (P2, R0_rect, Tr_velo_to_cam).

    Args:
        path: the calibration file.
        rotation_y: the meaning of rotation_y in the label files of the data set.

    Raises:
        DataError: if the file or one of the three matrices is missing, or a matrix has a wrong
            number of entries or entries that are not finite, or the transform from LiDAR to camera
            is not a rotation and a translation.
    """
    matrices: dict[str, np.ndarray] = {}
    text = read_bytes(path, "calibration").decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        key, _, entries = line.partition(":")
        if key in CALIBRATION_SHAPES:
            matrices[key] = parse_matrix(entries, CALIBRATION_SHAPES[key], f"{path}:{number}")
    missing = [key for key in CALIBRATION_SHAPES if key not in matrices]
    if missing:
        raise DataError(f"{path}: no line {' and no line '.join(f'{key}:' for key in missing)}")
    rectify, extrinsic = np.eye(4), np.eye(4)
    rectify[:3, :3] = matrices["R0_rect"]
    extrinsic[:3] = matrices["Tr_velo_to_cam"]
    lidar_to_camera = rectify @ extrinsic
    check_lidar_to_camera(lidar_to_camera, str(path))
    return Calibration(matrices["P2"], lidar_to_camera, rotation_y=rotation_y)


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file that `read_calibration` reads back exactly.

    Tr_velo_to_cam is the complete transform from the LiDAR to the rectified camera, and R0_rect is
    the identity. P0, P1 and P3 repeat P2, for readers that expect P2 on the third line.
    """
    matrices = dict.fromkeys(("P0", "P1", "P2", "P3"), calibration.projection)
    matrices["R0_rect"] = np.eye(3)
    matrices["Tr_velo_to_cam"] = calibration.lidar_to_camera[:3]
    matrices["Tr_imu_to_velo"] = np.eye(4)[:3]
    lines = [
        f"{key}: {' '.join(f'{entry:.16e}' for entry in matrix.ravel())}\n"
        for key, matrix in matrices.items()
    ]
    replace_file(path, "".join(lines).encode())


def parse_matrix(entries: str, shape: tuple[int, int], location: str) -> np.ndarray:
    """Parse the numbers of a calibration line as a matrix.

    Args:
        entries: the part of the line after the key.
        shape: rows and columns of the matrix.
        location: file and line, for error messages.

    Raises:
        DataError: if an entry is not a finite number of sane size, or their count is wrong.
    """
    try:
        numbers = np.array([float(entry) for entry in entries.split()])
    except ValueError as error:
        raise DataError(f"{location}: {error}; a calibration line holds only numbers") from None
    if len(numbers) != shape[0] * shape[1]:
        raise DataError(f"{location}: {len(numbers)} numbers, expected {shape[0]} x {shape[1]}")
    if not np.isfinite(numbers).all():
        raise DataError(f"{location}: contains NaN or infinite numbers")
    if np.abs(numbers).max() > _MAX_ENTRY:
        raise DataError(f"{location}: contains numbers beyond {_MAX_ENTRY:g}")
    return numbers.reshape(shape)


def read_drives(folder: Path) -> Mapping[str, str]:
    """Return the drive of each frame of KITTI's training/.

    train_mapping.txt has a line "date drive frame" for each recorded frame. train_rand.txt has one
    number for each frame of training/: the number of its line in train_mapping.txt, from 1. For
    example, if train_rand.txt begins with 7, frame 000000 is from the drive on line 7.

    Raises:
        DataError: if a file is missing or malformed.
    """
    mapping, path = (folder / name for name in _MAPPING_FILES)
    lines = read_bytes(mapping, "mapping").decode("utf-8", "replace")
    drives = [line.split()[1] for line in lines.splitlines() if len(line.split()) == 3]
    try:
        text = read_bytes(path, "mapping").decode("utf-8", "replace")
        numbers = [int(number) for number in text.replace(",", " ").split()]
    except ValueError as error:
        raise DataError(f"{path}: {error}; the file must contain only line numbers") from None
    if not all(1 <= number <= len(drives) for number in numbers):
        raise DataError(f"{path}: contains a line number that train_mapping.txt does not have")
    return {f"{i:06d}": drives[number - 1] for i, number in enumerate(numbers)}


def visible_files(folder: Path, pattern: str) -> Iterator[Path]:
    """Yield the files of a folder that match a pattern, without hidden ones such as macOS' ._*."""
    if not folder.is_dir():
        return
    with os.scandir(folder) as entries:  # `glob` would keep an object per file in memory
        for entry in entries:
            if not entry.name.startswith(".") and fnmatchcase(entry.name, pattern):
                yield folder / entry.name


def read_frame_lists(folder: Path, boundary: Boundary) -> Mapping[str, tuple[str, ...]]:
    """Return the frame lists of a folder by file name; empty if the folder does not exist.

    Args:
        folder: the folder of the lists.
        boundary: the boundary of the data set.

    Raises:
        DataError: if a list contains an invalid frame id, or is a link out of the data set.
    """
    paths = sorted(visible_files(folder, "*.txt"))
    boundary.check(*paths)
    return {path.stem: read_frame_list(path) for path in paths}


def read_frame_list(path: Path) -> tuple[str, ...]:
    """Return the frame ids of a text file, one per line.

    Raises:
        DataError: if the file is missing or not text, or a line is not a valid frame id.
    """
    names: list[str] = []
    try:
        text = read_bytes(path, "frame list").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from None
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            try:
                check_frame_id(line.strip())
            except DataError as error:
                raise DataError(f"{path}:{number}: {error}") from None
            names.append(line.strip())
    return tuple(names)


def read_bytes(path: Path, kind: str) -> bytes:
    """Return the content of a file; `kind` is e.g. "velodyne", for error messages.

    Raises:
        DataError: if the file is missing or cannot be read.
    """
    with open_unbuffered(path, kind) as file:
        return file.read()


@contextmanager
def open_unbuffered(path: Path, kind: str) -> Iterator[io.FileIO]:
    """Open a file for one large read, which needs no buffer.

    Raises:
        DataError: if the file is missing or cannot be read.
    """
    try:
        with path.open("rb", buffering=0) as file:
            yield file
    except FileNotFoundError:
        raise DataError(f"{path}: no such {kind} file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
