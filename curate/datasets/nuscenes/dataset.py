"""The key frames of nuScenes as a data set: LIDAR_TOP, one camera, and the objects in its view.

Source: Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020. ROOT
contains samples/ and the tables of a version, such as v1.0-mini/. A frame id is a sample token, as
in nuScenes' result files. Point files have five float32 per point; the fifth, the ring number, is
dropped. Intensities are 0 to 255.
"""

import logging
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import numpy as np

from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.containment import Boundary, check_frame_id
from curate.datasets.formats.images import read_image
from curate.datasets.formats.point_layout import UNDECLARED, PointLayout
from curate.datasets.nuscenes.annotations import AnnotationTable
from curate.datasets.nuscenes.keyframes import TO_SENSOR_AXES, Keyframe, read_keyframes
from curate.datasets.nuscenes.names import CATEGORIES
from curate.datasets.nuscenes.scenes import validation_scenes
from curate.datasets.recognition import layout_hint
from curate.detections import Annotations
from curate.errors import ConfigError, DataError
from curate.files.paths import StrPath
from curate.frames import Frame, FrameFiles

_log = logging.getLogger(__name__)

_COLUMNS, _FULL_INTENSITY = 5, 255.0


class NuScenesDataset:
    """A `Dataset` and `Sequenced` of nuScenes' key frames; frames with missing files are skipped.

    Args:
        root: the folder with samples/ and v1.0-*/.
        layout: the layout of the point files, if it differs from nuScenes' own.
        version: name of the folder of tables; only needed if there are several.
        camera: channel of the camera.
        rename: the category for each class of the detection task, in place of `names.CATEGORIES`.
        minimum_points: annotated objects with fewer LiDAR points (num_lidar_pts) are dropped.
        follow_links: whether links and paths in the tables may lead out of the root.

    Raises:
        DataError: if there are no tables.
        ConfigError: if the version does not exist, or there are several and none is specified.
    """

    name = "nuscenes"

    def __init__(
        self,
        root: StrPath,
        *,
        layout: PointLayout = UNDECLARED,
        version: str | None = None,
        camera: str = "CAM_FRONT",
        rename: Mapping[str, str] | None = None,
        minimum_points: int = 1,
        follow_links: bool = False,
    ) -> None:
        self.root = Path(root)
        self._boundary = Boundary(self.root, follow_links=follow_links)
        self._layout = layout.with_defaults(_COLUMNS, _FULL_INTENSITY)
        self.version = _version(self.root, version)
        self.camera = camera
        self._tables = self.root / self.version
        self._boundary.check(*self._tables.glob("*.json"))
        names = CATEGORIES if rename is None else rename
        self._annotations = AnnotationTable(self._tables, names, minimum_points)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the sample tokens of all key frames with sweep and image, sorted."""
        return self._present

    @cached_property
    def _keyframes(self) -> Mapping[str, Keyframe]:
        return read_keyframes(self._tables, self.camera)

    @cached_property
    def _present(self) -> tuple[str, ...]:
        """The frames with both files; the data set is often downloaded in part (of ten)."""
        frames = self._keyframes
        needed = {file for frame in frames.values() for file in (frame.points, frame.image)}
        folders = {str(Path(file).parent) for file in needed}
        existing = {
            f"{folder}/{path.name}"
            for folder in folders
            if (self.root / folder).is_dir()
            for path in (self.root / folder).iterdir()
        }
        present = tuple(
            token for token, frame in frames.items() if {frame.points, frame.image} <= existing
        )
        if len(present) < len(frames):
            missing = f"the files of {len(frames) - len(present)} of {len(frames)} key frames"
            if not present:
                first = next(iter(frames.values())).points
                raise DataError(
                    f"{self.root}: {missing} are missing, such as {first}; set the root to the "
                    "folder with samples/"
                )
            _log.warning("%s: %s are missing; these frames are skipped", self.root, missing)
        return present

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the official lists train and val of v1.0-trainval and v1.0-mini.

        The split is by scene. For other versions there are no lists.
        """
        scenes = {self._keyframes[token].scene for token in self._present}
        val_scenes = validation_scenes(self.version, scenes)
        if not val_scenes:
            return {}
        lists: dict[str, list[str]] = {"train": [], "val": []}
        for token in self._present:
            lists["val" if self.sequence_of(token) in val_scenes else "train"].append(token)
        return {name: tuple(tokens) for name, tokens in lists.items()}

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the scene of a frame, 20 seconds of a drive, or None for an unknown frame."""
        return self._keyframes[frame_id].scene if frame_id in self._keyframes else None

    def file_names(self) -> Mapping[str, str]:
        """Return the sample token of each name of a sweep or image without suffix."""
        files = ((file, token) for token in self._present for file in self._names(token))
        return {Path(file).name.partition(".")[0]: token for file, token in files}

    def _names(self, token: str) -> tuple[str, str]:
        frame = self._keyframes[token]
        return frame.points, frame.image

    def files(self, frame_id: str) -> FrameFiles:
        """Return the paths of the frame's files; calibration and labels are tables of all frames.

        Raises:
            DataError: if there is no such frame, or its files are outside the data set.
        """
        frame = self._frame(frame_id)
        labels = self._annotations.path
        files = FrameFiles(
            points=self.root / frame.points,
            image=self.root / frame.image,
            calibration=self._tables / "calibrated_sensor.json",
            label=labels if labels.exists() else None,
        )
        self._boundary.check(*files.paths())
        return files

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """Read the frame's calibration and image size, and its points and image if requested.

        Raises:
            DataError: if a file is missing, damaged or malformed.
        """
        frame, files = self._frame(frame_id), self.files(frame_id)
        sweep = np.zeros((0, 4), dtype=np.float32)
        if points:
            sweep = read_cloud(files.points, self._layout)
            # For row vectors, p @ R applies the inverse of R: from the sensor's axes to ours.
            sweep[:, :3] = sweep[:, :3] @ TO_SENSOR_AXES[:3, :3].astype(np.float32)
        pixels = read_image(files.image) if image else None
        size = frame.image_size
        if pixels is not None and pixels.shape[1::-1] != size:
            raise DataError(
                f"{files.image}: {pixels.shape[1::-1]} pixels, but {size} in sample_data.json"
            )
        return Frame(frame_id, sweep, frame.calibration, size, pixels)

    def annotations(self, frame_id: str) -> Annotations:
        """Return the objects in the camera's view, in the LiDAR frame.

        Raises:
            DataError: if the version has no annotations, or they are malformed.
        """
        if self.files(frame_id).label is None:
            raise DataError(
                f"{self._annotations.path}: no such table; {self.version} has no labels"
            )
        frame = self._frame(frame_id)
        return self._annotations.read(frame_id, frame.calibration, frame.image_size)

    def _frame(self, frame_id: str) -> Keyframe:
        check_frame_id(frame_id)
        if frame_id not in self._keyframes:
            raise DataError(f"{self._tables}: no key frame {frame_id}; frame ids are sample tokens")
        return self._keyframes[frame_id]


def _version(root: Path, version: str | None) -> str:
    """Return the name of the folder of tables."""
    versions = sorted(path.parent.name for path in root.glob("*/sample_data.json"))
    if not versions:
        raise DataError(
            f"{root}: contains no v1.0-*/sample_data.json; set the root to the folder with "
            f"samples/ and v1.0-*/{layout_hint(root, NuScenesDataset.name)}"
        )
    if version is None and len(versions) == 1:
        return versions[0]
    if version not in versions:
        problem = f"no version {version}" if version else "several versions"
        raise ConfigError(
            f"{root}: {problem}; set dataset.options.version to one of {', '.join(versions)}"
        )
    return version
