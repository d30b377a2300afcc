"""The KITTI object data set, or any data in its layout.

Source: Geiger et al., "Are we ready for autonomous driving?", CVPR 2012, and the readme of its
object development kit. Two layouts are read: ROOT/training/{velodyne,image_2,calib,label_2} and the
flat ROOT/{velodyne,image_2,calib,label_2}; label_2 and ROOT/ImageSets/*.txt are optional.
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
from curate.datasets.kitti.labels import read_objects, to_annotations
from curate.detections import Annotations
from curate.errors import DataError
from curate.files.atomic import replace_file
from curate.files.paths import StrPath
from curate.frames import Calibration, Frame, FrameFiles
from curate.shapes import Float, Float32

_log = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
POINT_BYTES = 16  # x, y, z, intensity, float32 each
# No LiDAR sees farther; maps over the points would fill the memory.
FARTHEST_METRES = 2000.0
# KITTI's own development kit says which drive each frame of training/ was taken from.
_MAPPINGS = ("mapping", "devkit_object/mapping", "devkit/mapping")
_MAPPING_FILES = ("train_mapping.txt", "train_rand.txt")
# Focal lengths are thousands of pixels, P2's last column a million at most.
_LARGEST_ENTRY = 1e9
CALIBRATION_SHAPES = {"P2": (3, 4), "R0_rect": (3, 3), "Tr_velo_to_cam": (3, 4)}


class KittiDataset:
    """A `Dataset` in KITTI's layout; its frames are the ones that have a velodyne file.

    Args:
        root: the folder that holds training/, or velodyne/ itself.
        follow_links: whether links may lead out of it.

    Raises:
        DataError: neither is there.
    """

    name = "kitti"

    def __init__(self, root: StrPath, *, follow_links: bool = False) -> None:
        self.root = Path(root)
        self._boundary = Boundary(self.root, follow_links=follow_links)
        homes = [self.root / "training", self.root]
        home = next((home for home in homes if (home / "velodyne").is_dir()), None)
        if home is None:
            raise DataError(
                f"{self.root}: holds neither training/velodyne nor velodyne; "
                "name the root of a data set in KITTI's layout"
            )
        self._home = home
        self._folders = [home / name for name in ("velodyne", "image_2", "calib", "label_2")]

    def frame_ids(self) -> tuple[str, ...]:
        """Return all frames with a velodyne file, in sorted order."""
        return self._frame_ids

    @cached_property
    def _frame_ids(self) -> tuple[str, ...]:
        return tuple(sorted(path.stem for path in visible_files(self._home / "velodyne", "*.bin")))

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """The lists of ROOT/ImageSets, by file name; they may name frames that are not there.

        KITTI's own test.txt names frames of ROOT/testing, whose numbers are those of other frames
        of ROOT/training. It is therefore left out where ROOT/training is read.

        Raises:
            DataError: if a list names something that is no frame id.
        """
        lists = {
            path.stem: path for path in sorted(visible_files(self.root / "ImageSets", "*.txt"))
        }
        if self._home != self.root and "test" in lists:
            _log.info("%s: left out, it names frames of testing/", lists.pop("test"))
        self._boundary.check(*lists.values())
        return {name: read_frame_list(path) for name, path in lists.items()}

    def files(self, frame_id: str) -> FrameFiles:
        """Where the frame's files lie; `label` is None where there is no label file.

        Raises:
            DataError: if the name or a link would lead out of the data set.
        """
        check_frame_id(frame_id)
        velodyne, pictures, calib, labels = self._folders
        images = [pictures / f"{frame_id}{suffix}" for suffix in IMAGE_SUFFIXES]
        label = labels / f"{frame_id}.txt"
        found = FrameFiles(
            points=velodyne / f"{frame_id}.bin",
            image=next((image for image in images if image.exists()), images[0]),
            calibration=calib / f"{frame_id}.txt",
            label=label if label.exists() else None,
        )
        self._boundary.check(*found.paths())
        return found

    def sequence_of(self, frame_id: str) -> str | None:
        """The drive of a frame, where the mapping of KITTI's development kit lies in the root.

        Raises:
            DataError: if the mapping is malformed, or lies elsewhere.
        """
        return self._drives.get(frame_id)

    @cached_property
    def _drives(self) -> Mapping[str, str]:
        homes = (self.root / folder for folder in _MAPPINGS)
        home = next((home for home in homes if (home / _MAPPING_FILES[0]).is_file()), None)
        if home is None:
            return {}
        # Before they are read: messages repeat a piece of what is no number.
        self._boundary.check(*(home / name for name in _MAPPING_FILES))
        return read_drives(home)

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """The frame's calibration, its points unless unwanted, and its image where asked for.

        Raises:
            DataError: if a file is missing, damaged or malformed.
        """
        files = self.files(frame_id)
        sweep = read_points(files.points) if points else np.zeros((0, 4), dtype=np.float32)
        calibration = read_calibration(files.calibration)
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
        return to_annotations(read_objects(files.label), read_calibration(files.calibration))


def read_points(path: Path) -> Float32[np.ndarray, "n 4"]:
    """The (n, 4) float32 points of a velodyne file: x, y, z in metres, intensity. May be empty.

    Raises:
        DataError: if the file is missing or truncated, or holds NaN or infinite numbers.
    """
    with opened(path, "velodyne") as file:
        size = os.fstat(file.fileno()).st_size
        points = np.empty((size // POINT_BYTES, 4), dtype="<f4")
        if size % POINT_BYTES or file.readinto(points.reshape(-1).view(np.uint8).data) != size:
            raise DataError(
                f"{path}: {size} bytes are no multiple of {POINT_BYTES} "
                "(x, y, z, intensity as float32); the file is truncated, fetch it again"
            )
    # NaN and infinite numbers show in the extremes, and all columns at once are read fastest.
    low, high = points.min(initial=0), points.max(initial=0)
    if low >= -FARTHEST_METRES and high <= FARTHEST_METRES:
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
    """Raise DataError if a finite point of (n, >=3) is farther than any LiDAR sees."""
    far = np.abs(points[:, :3]).max(initial=0)
    if far > FARTHEST_METRES:
        k = int(np.abs(points[:, :3]).max(axis=1).argmax())
        raise DataError(
            f"{path}: point {k} is {far:.4g} m away; points are in metres from the LiDAR, remove "
            f"those beyond {FARTHEST_METRES:g} m"
        )


def read_calibration(path: Path) -> Calibration:
    """Return the calibration of the left colour camera (P2, R0_rect, Tr_velo_to_cam).

    Raises:
        DataError: if the file is missing, or one of the three is missing, has a wrong number of
            entries, or is not finite.
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
    if abs(np.linalg.det(lidar_to_camera)) < 1e-6:
        raise DataError(f"{path}: R0_rect times Tr_velo_to_cam cannot be inverted")
    return Calibration(matrices["P2"], lidar_to_camera)


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file that `read_calibration` reads back exactly.

    The whole way from the LiDAR to the rectified camera is in Tr_velo_to_cam, R0_rect is the
    identity. P0, P1 and P3 repeat P2, for readers that take lines by number.
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


def parse_matrix(entries: str, shape: tuple[int, int], place: str) -> np.ndarray:
    """A matrix from the numbers of a calibration line; DataError at `place` where it is none."""
    try:
        numbers = np.array([float(entry) for entry in entries.split()])
    except ValueError as error:
        raise DataError(f"{place}: {error}; a calibration line holds only numbers") from None
    if len(numbers) != shape[0] * shape[1]:
        raise DataError(f"{place}: {len(numbers)} numbers, expected {shape[0]} x {shape[1]}")
    if not np.isfinite(numbers).all():
        raise DataError(f"{place}: holds NaN or infinite numbers")
    if np.abs(numbers).max() > _LARGEST_ENTRY:
        raise DataError(f"{place}: holds numbers beyond {_LARGEST_ENTRY:g}")
    return numbers.reshape(shape)


def read_drives(folder: Path) -> Mapping[str, str]:
    """The drive of each frame of KITTI's training/ from train_mapping.txt and train_rand.txt.

    The first has a line "date drive frame" per frame, the second for each frame the number of its
    line, from 1.

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
        raise DataError(f"{path}: {error}; it holds only numbers of lines") from None
    if not all(1 <= number <= len(drives) for number in numbers):
        raise DataError(f"{path}: names a line that train_mapping.txt does not have")
    return {f"{i:06d}": drives[number - 1] for i, number in enumerate(numbers)}


def visible_files(folder: Path, pattern: str) -> Iterator[Path]:
    """Yield the files of a folder without hidden ones: macOS strews ._ files over foreign disks."""
    if not folder.is_dir():
        return
    with os.scandir(folder) as entries:  # `glob` would hold an object per file
        for entry in entries:
            if not entry.name.startswith(".") and fnmatchcase(entry.name, pattern):
                yield folder / entry.name


def read_frame_lists(folder: Path, boundary: Boundary) -> Mapping[str, tuple[str, ...]]:
    """Return the frame lists of a folder by file name; none where it is not there.

    Args:
        folder: of the lists.
        boundary: that links must not lead out of.

    Raises:
        DataError: if a list names something that is no frame id, or lies elsewhere.
    """
    paths = sorted(visible_files(folder, "*.txt"))
    boundary.check(*paths)
    return {path.stem: read_frame_list(path) for path in paths}


def read_frame_list(path: Path) -> tuple[str, ...]:
    """Return the frame ids of a text file, one per line; DataError for what is no frame id."""
    names: list[str] = []
    try:
        text = read_bytes(path, "frame list").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: is no UTF-8 text: {error.reason} at {error.start}") from None
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            try:
                check_frame_id(line.strip())
            except DataError as error:
                raise DataError(f"{path}:{number}: {error}") from None
            names.append(line.strip())
    return tuple(names)


def read_bytes(path: Path, kind: str) -> bytes:
    """Return the content of a file; DataError with its kind where it is missing."""
    with opened(path, kind) as file:
        return file.read()


@contextmanager
def opened(path: Path, kind: str) -> Iterator[io.FileIO]:
    """A file that is read at once, so without a buffer; DataError with its kind where missing."""
    try:
        with path.open("rb", buffering=0) as file:
            yield file
    except FileNotFoundError:
        raise DataError(f"{path}: no such {kind} file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
