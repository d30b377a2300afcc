"""nuScenes' key frames as a data set: LIDAR_TOP, one camera, and the objects that it sees.

Source: Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020. ROOT
holds samples/ and the tables of a version, such as v1.0-mini/. A frame is named by its sample
token, as in nuScenes' results. Point files have five float32 per point, of which the fifth, the
number of the ring, is left out; intensities are 0 to 255.
"""

import logging
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import numpy as np

from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.containment import Boundary, check_frame_id
from curate.datasets.formats.images import read_image
from curate.datasets.nuscenes.annotations import AnnotationTable
from curate.datasets.nuscenes.keyframes import TO_SENSOR_AXES, Keyframe, read_keyframes
from curate.datasets.nuscenes.names import CATEGORIES
from curate.datasets.nuscenes.scenes import validation_scenes
from curate.detections import Annotations
from curate.errors import ConfigError, DataError
from curate.files.paths import StrPath
from curate.frames import Frame, FrameFiles

_log = logging.getLogger(__name__)

_COLUMNS, _FULL_INTENSITY = 5, 255.0


class NuScenesDataset:
    """A `Dataset` and `Sequenced` of nuScenes' key frames; those whose files are not there are out.

    Args:
        root: the folder with samples/ and v1.0-*/.
        version: name of the folder of tables; needless where there is one.
        camera: channel of the camera.
        rename: categories by name of the detection task's class, in place of `names.CATEGORIES`.
        minimum_points: annotated objects with fewer LiDAR points (num_lidar_pts) are left out.
        follow_links: whether links and names in the tables may lead out of the root.

    Raises:
        DataError: there are no tables.
        ConfigError: there is no such version, or there are several and none is named.
    """

    name = "nuscenes"

    def __init__(
        self,
        root: StrPath,
        *,
        version: str | None = None,
        camera: str = "CAM_FRONT",
        rename: Mapping[str, str] | None = None,
        minimum_points: int = 1,
        follow_links: bool = False,
    ) -> None:
        self.root = Path(root)
        self._boundary = Boundary(self.root, follow_links=follow_links)
        self.version = _version(self.root, version)
        self.camera = camera
        self._tables = self.root / self.version
        self._boundary.check(*self._tables.glob("*.json"))
        names = CATEGORIES if rename is None else rename
        self._annotated = AnnotationTable(self._tables, names, minimum_points)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the sample tokens of all key frames with sweep and image, in sorted order."""
        return self._present

    @cached_property
    def _keyframes(self) -> Mapping[str, Keyframe]:
        return read_keyframes(self._tables, self.camera)

    @cached_property
    def _present(self) -> tuple[str, ...]:
        """The frames whose files are there: the data set comes in ten parts, not all at once."""
        frames = self._keyframes
        wanted = {file for one in frames.values() for file in (one.points, one.image)}
        folders = {str(Path(file).parent) for file in wanted}
        there = {
            f"{folder}/{path.name}"
            for folder in folders
            if (self.root / folder).is_dir()
            for path in (self.root / folder).iterdir()
        }
        present = tuple(token for token, one in frames.items() if {one.points, one.image} <= there)
        if len(present) < len(frames):
            told = f"{len(frames) - len(present)} of {len(frames)} key frames have no files"
            if not present:
                first = next(iter(frames.values())).points
                raise DataError(f"{self.root}: {told}, such as {first}; is this the whole folder?")
            _log.info("%s: %s; they are left out", self.root, told)
        return present

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the official train and val of v1.0-trainval and v1.0-mini, by scene; else none."""
        scenes = {self._keyframes[token].scene for token in self._present}
        held_out = validation_scenes(self.version, scenes)
        if not held_out:
            return {}
        lists: dict[str, list[str]] = {"train": [], "val": []}
        for token in self._present:
            lists["val" if self.sequence_of(token) in held_out else "train"].append(token)
        return {name: tuple(tokens) for name, tokens in lists.items()}

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the scene of a frame: 20 seconds of one drive."""
        return self._keyframes[frame_id].scene if frame_id in self._keyframes else None

    def files(self, frame_id: str) -> FrameFiles:
        """Where the frame's files lie; calibration and labels are tables of all frames.

        Raises:
            DataError: if there is no such frame, or its files lie elsewhere.
        """
        frame = self._frame(frame_id)
        labels = self._annotated.path
        found = FrameFiles(
            points=self.root / frame.points,
            image=self.root / frame.image,
            calibration=self._tables / "calibrated_sensor.json",
            label=labels if labels.exists() else None,
        )
        self._boundary.check(*found.paths())
        return found

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """The frame's calibration, its points unless unwanted, and its image where asked for.

        Raises:
            DataError: if a file is missing, damaged or malformed.
        """
        frame, files = self._frame(frame_id), self.files(frame_id)
        sweep = np.zeros((0, 4), dtype=np.float32)
        if points:
            sweep = read_cloud(files.points, _COLUMNS, _FULL_INTENSITY)
            # Rows times a rotation are its inverse on each: from the sensor's axes to ours.
            sweep[:, :3] = sweep[:, :3] @ TO_SENSOR_AXES[:3, :3].astype(np.float32)
        pixels = read_image(files.image) if image else None
        size = frame.image_size
        if pixels is not None and pixels.shape[1::-1] != size:
            raise DataError(f"{files.image}: {pixels.shape[1::-1]} pixels, its table says {size}")
        return Frame(frame_id, sweep, frame.calibration, size, pixels)

    def annotations(self, frame_id: str) -> Annotations:
        """Return the objects that the camera sees, in the LiDAR frame.

        Raises:
            DataError: if the version has no annotations, or they are malformed.
        """
        if self.files(frame_id).label is None:
            raise DataError(f"{self._annotated.path}: no such table; {self.version} has no labels")
        frame = self._frame(frame_id)
        return self._annotated.read(frame_id, frame.calibration, frame.image_size)

    def _frame(self, frame_id: str) -> Keyframe:
        check_frame_id(frame_id)
        if frame_id not in self._keyframes:
            raise DataError(
                f"{self._tables}: no key frame {frame_id}; frames are named by their sample token"
            )
        return self._keyframes[frame_id]


def _version(root: Path, version: str | None) -> str:
    """Return the folder of tables below a root."""
    found = sorted(path.parent.name for path in root.glob("*/sample_data.json"))
    if not found:
        raise DataError(
            f"{root}: holds no v1.0-*/sample_data.json; name the folder with samples/ and v1.0-*/"
        )
    if version is None and len(found) == 1:
        return found[0]
    if version not in found:
        asked = f"no version {version}" if version else "several versions"
        raise ConfigError(
            f"{root}: {asked}; set dataset.options.version to one of {', '.join(found)}"
        )
    return version
