"""Reader of the KITTI tracking data set.

Source: Geiger et al., "Are we ready for autonomous driving?", CVPR 2012, and the readme of its
tracking development kit. ROOT/training or ROOT contains velodyne/0000/000000.bin,
image_02/0000/000000.png, calib/0000.txt, label_02/0000.txt and optionally oxts/0000.txt (the poses
of the vehicle), where 0000 is the sequence. A frame id is the sequence and the number: 0000_000000.

A line of a label file is the number of the frame, the number of the track (-1 for DontCare), and
then the 15 fields of the object data set; result files have an 18th field, the score, which is left
out here. Truncation is a level instead of a fraction: 0 not, 1 partly, 2 largely truncated. Here it
becomes 0, 0.5 and 1: in KITTI's evaluation, a partly truncated object counts as hard at most.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from curate.datasets.formats.clouds import CLOUD_SUFFIXES
from curate.datasets.formats.containment import Boundary
from curate.datasets.formats.frame_files import IMAGE_SUFFIXES, FrameFolder, visible_names
from curate.datasets.formats.images import read_optional_image
from curate.datasets.formats.point_layout import UNDECLARED, PointLayout
from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.dataset import (
    contains_images,
    frame_number,
    image_size_option,
    read_frame_lists,
    read_points,
)
from curate.datasets.kitti.labels import LABEL_FIELDS, parse_rows, read_rows, to_annotations
from curate.datasets.kitti.oxts import imu_pose, read_lidar_to_imu, read_oxts
from curate.datasets.kitti.sequences import SequenceFrames
from curate.datasets.recognition import layout_hint
from curate.detections import Annotations
from curate.errors import DataError, error_prefix
from curate.files.paths import StrPath
from curate.frames import Frame, FrameFiles, RotationY
from curate.geometry.mounting import check_rotation_y
from curate.shapes import Float

# The fraction outside the image for a level of truncation.
_TRUNCATION = {0: 0.0, 1: 0.5, 2: 1.0}
# Number of the frame and of the track.
_FIRST_FIELDS = 2


class _Sequence:
    """The files of a sequence by the number of the frame."""

    def __init__(self, home: Path, name: str) -> None:
        self.name = name
        self.points = FrameFolder(home / "velodyne" / name, CLOUD_SUFFIXES, "point")
        self.images = FrameFolder(home / "image_02" / name, IMAGE_SUFFIXES, "image")
        self.calibration = home / "calib" / f"{name}.txt"
        self.label = home / "label_02" / f"{name}.txt"
        self.oxts = home / "oxts" / f"{name}.txt"

    @cached_property
    def positions(self) -> np.ndarray:
        """The rows of the OXTS file by the number of the frame; empty if there is none."""
        return read_oxts(self.oxts) if self.oxts.exists() else np.zeros((0, 6))

    @cached_property
    def lidar_to_imu(self) -> np.ndarray:
        """The (4, 4) transform from the LiDAR to the IMU."""
        return read_lidar_to_imu(self.calibration)


class KittiTrackingDataset:
    """A `Dataset` of sequences; if there are images, frames without one are skipped.

    Args:
        root: the folder that contains training/velodyne or velodyne.
        layout: the declared layout of the point files.
        image_size: see `KittiDataset`.
        follow_links: whether links may lead out of the root.
        rotation_y: who computed rotation_y of the labels; see `curate.frames.RotationY`.

    Raises:
        ConfigError: if `rotation_y` is unknown.
        DataError: if the root contains neither.
    """

    name = "kitti-tracking"
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
        self._rotation_y = rotation_y
        self.root = Path(root)
        self.layout = layout
        self._boundary = Boundary(self.root, follow_links=follow_links)
        self._rows: dict[Path, Mapping[int, Sequence[tuple[int, Sequence[str]]]]] = {}
        homes = [self.root / "training", self.root]
        home = next((home for home in homes if (home / "velodyne").is_dir()), None)
        if home is None:
            raise DataError(
                f"{self.root}: contains neither training/velodyne nor velodyne; set the root to a "
                f"data set in the layout of KITTI tracking{layout_hint(self.root, self.name)}"
            )
        self._home = home
        images = home / "image_02"
        self._has_images = any(contains_images(images / name) for name in visible_names(images))
        self._image_size = image_size_option(image_size, self._has_images, images)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the ids of all frames with points, and with an image if there are any, sorted.

        Raises:
            DataError: if there are none, or a frame has two point files or two images.
        """
        return self._frames.ids()

    @cached_property
    def _frames(self) -> SequenceFrames[_Sequence]:
        names = visible_names(self._home / "velodyne")
        sequences = {name: _Sequence(self._home, name) for name in names}
        frames = SequenceFrames(sequences, has_images=self._has_images)
        if not any(sequence.points.frames() for sequence in sequences.values()):
            raise DataError(
                f"{self._home / 'velodyne'}: no point files SEQUENCE/FRAME.bin"
                f"{layout_hint(self.root, self.name)}"
            )
        return frames

    def skipped_frames(self) -> str:
        """Return how many frames are skipped because they have no image; "" if none is."""
        return self._frames.describe_skipped()

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the frame lists in ROOT/ImageSets by file name."""
        return read_frame_lists(self.root / "ImageSets", self._boundary, self.frame_ids())

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the sequence of a frame, or None if there is no such frame."""
        return self._frame(frame_id)[0].name if frame_id in self._frames else None

    def pose_of(self, frame_id: str) -> Float[np.ndarray, "4 4"] | None:
        """Return the pose of the LiDAR, x east, y north; None if the sequence has no OXTS file.

        Raises:
            DataError: if the file is malformed or has no line for the frame, or the calibration
                has no transform from the IMU to the LiDAR.
        """
        sequence, number = self._frame(frame_id)
        self._boundary.check(sequence.oxts, sequence.calibration)
        rows, index = sequence.positions, frame_number(number, sequence.points.path(number))
        if not len(rows):
            return None
        if index >= len(rows):
            raise DataError(f"{sequence.oxts}: no line for frame {index}")
        return np.asarray(imu_pose(rows[index], float(rows[0, 0])) @ sequence.lidar_to_imu)

    def files(self, frame_id: str) -> FrameFiles:
        """Return the paths of the frame's files; a sequence shares calibration and label file.

        Raises:
            DataError: if there is no such frame, or a link leads out of the data set.
        """
        sequence, number = self._frame(frame_id)
        files = FrameFiles(
            points=sequence.points.path(number),
            image=sequence.images.path(number) if self._has_images else None,
            calibration=sequence.calibration,
            label=sequence.label if sequence.label.exists() else None,
        )
        self._boundary.check(*files.paths())
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
        calibration = read_calibration(files.calibration, rotation_y=self._rotation_y)
        size, pixels = read_optional_image(files.image, self._image_size, pixels=image)
        return Frame(frame_id, sweep, calibration, size, pixels)

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth in the LiDAR frame, DontCare regions included.

        Raises:
            DataError: if the sequence has no label file, or it is malformed.
        """
        files = self.files(frame_id)
        sequence, number = self._frame(frame_id)
        if files.label is None:
            raise DataError(f"{sequence.label}: no such label file")
        if files.label not in self._rows:
            self._rows[files.label] = rows_by_frame(files.label)
        rows = self._rows[files.label].get(frame_number(number, files.points), [])
        objects = parse_rows(files.label, rows, categories=None)
        levels = objects.truncated.tolist()
        objects = replace(
            objects, truncated=np.array([_TRUNCATION.get(level, level) for level in levels])
        )
        calibration = read_calibration(files.calibration, rotation_y=self._rotation_y)
        with error_prefix(str(files.label)):
            return to_annotations(objects, calibration)

    def _frame(self, frame_id: str) -> tuple[_Sequence, str]:
        return self._frames.find(frame_id, self.root, "SEQUENCE_NUMBER")


def rows_by_frame(path: Path) -> Mapping[int, Sequence[tuple[int, Sequence[str]]]]:
    """Return the lines of a label file by frame: line number, and the fields of the object.

    Raises:
        DataError: if the file is missing or not text, or a line has a wrong number of fields or
            does not begin with two integers.
    """
    frames: dict[int, list[tuple[int, Sequence[str]]]] = {}
    for number, row in read_rows(path):
        if len(row) - _FIRST_FIELDS not in (LABEL_FIELDS, LABEL_FIELDS + 1):
            raise DataError(
                f"{path}:{number}: {len(row)} fields, but lines of KITTI tracking have 17, or 18 "
                "with a score: frame, track, and the fields of KITTI's object data set"
            )
        try:
            frame, _track = map(int, row[:_FIRST_FIELDS])
        except ValueError:
            raise DataError(
                f"{path}:{number}: begins with {' '.join(row[:2])[:40]!r}, expected the numbers of "
                "the frame and the track"
            ) from None
        fields = row[_FIRST_FIELDS : _FIRST_FIELDS + LABEL_FIELDS]
        frames.setdefault(frame, []).append((number, fields))
    return frames
