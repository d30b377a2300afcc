"""The key frames of nuScenes as a data set: LIDAR_TOP, cameras, and the objects in their view.

Source: Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020. ROOT
contains samples/ and the tables of a version, such as v1.0-mini/. A frame id is a sample token, as
in nuScenes' result files. Point files have five float32 per point; the fifth, the ring number, is
dropped. Intensities are 0 to 255.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.containment import Boundary, check_frame_id
from curate.datasets.formats.images import read_image
from curate.datasets.formats.point_layout import UNDECLARED, PointLayout
from curate.datasets.nuscenes.annotations import AnnotationTable
from curate.datasets.nuscenes.copies import NuScenesCopies
from curate.datasets.nuscenes.keyframes import (
    FRONT_CAMERA,
    TO_SENSOR_AXES,
    Keyframe,
    choose_cameras,
    read_keyframes,
)
from curate.datasets.nuscenes.names import CATEGORIES
from curate.datasets.nuscenes.scenes import validation_scenes
from curate.datasets.recognition import layout_hint
from curate.detections import Annotations
from curate.errors import ConfigError, DataError
from curate.files.paths import StrPath
from curate.frames import Camera, Frame, FrameFiles
from curate.geometry.similarity import Similarity
from curate.ranges import Count
from curate.shapes import Float

_COLUMNS, _FULL_INTENSITY = 5, 255.0


class NuScenesDataset:
    """A `Dataset` and `Sequenced` of nuScenes' key frames; frames with missing files are skipped.

    Args:
        root: the folder with samples/ and v1.0-*/.
        layout: the layout of the point files, if it differs from nuScenes' own.
        version: name of the folder of tables; only needed if there are several.
        camera: channel of the only camera; CAM_FRONT by default.
        cameras: channels of several cameras, or "all"; replaces `camera`.
        rename: the category for each class of the detection task, in place of `names.CATEGORIES`.
        minimum_points: annotated objects with fewer LiDAR points (num_lidar_pts) are dropped.
        follow_links: whether links and paths in the tables may lead out of the root.

    Raises:
        DataError: if there are no tables.
        ConfigError: if the version or a camera does not exist, or there are several versions and
            none is specified.
    """

    name = "nuscenes"

    def __init__(
        self,
        root: StrPath,
        *,
        layout: PointLayout = UNDECLARED,
        version: str | None = None,
        camera: str | None = None,
        cameras: str | Sequence[str] | None = None,
        rename: Mapping[str, str] | None = None,
        minimum_points: Count = 1,
        follow_links: bool = False,
    ) -> None:
        self.root = Path(root)
        self._boundary = Boundary(self.root, follow_links=follow_links)
        self.layout = layout.with_defaults(_COLUMNS, _FULL_INTENSITY)
        self.version = _version(self.root, version)
        self._tables = self.root / self.version
        self._boundary.check(*self._tables.glob("*.json"))
        if camera is not None and cameras is not None:
            raise ConfigError("dataset.options has both camera and cameras; remove one of them")
        if cameras is None:
            self.cameras = choose_cameras(self._tables, "camera", camera or FRONT_CAMERA)
        else:
            self.cameras = choose_cameras(self._tables, "cameras", cameras)
        names = CATEGORIES if rename is None else rename
        self._annotations = AnnotationTable(self._tables, names, minimum_points)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the sample tokens of all key frames with sweep and images, sorted."""
        return self._present[0]

    @cached_property
    def _keyframes(self) -> Mapping[str, Keyframe]:
        return read_keyframes(self._tables, self.cameras)

    @cached_property
    def _present(self) -> tuple[tuple[str, ...], bool]:
        """The frames with all their files, and whether there are any images.

        The data set is often downloaded in part (of ten). Without any image, the frames are those
        with a sweep.
        """
        frames = self._keyframes
        needed = {file for frame in frames.values() for file in (frame.points, *frame.images)}
        folders = {str(Path(file).parent) for file in needed}
        existing = {
            f"{folder}/{path.name}"
            for folder in folders
            if (self.root / folder).is_dir()
            for path in (self.root / folder).iterdir()
        }
        has_images = any(image in existing for frame in frames.values() for image in frame.images)
        present = tuple(
            token
            for token, frame in frames.items()
            if {frame.points, *(frame.images if has_images else ())} <= existing
        )
        if len(present) < len(frames):
            missing = f"the files of {len(frames) - len(present)} of {len(frames)} key frames"
            if not present:
                first = next(iter(frames.values())).points
                folder = first.split("/")[0]
                similar = sorted(path.name for path in self.root.glob(f"*_{folder}"))
                remedy = f"rename {similar[0]} to {folder}, or " if similar else ""
                raise DataError(
                    f"{self.root}: {missing} are missing, such as {first}; {remedy}set the root to "
                    f"the folder with {folder}/"
                )
        return present, has_images

    def skipped_frames(self) -> str:
        """Return how many key frames are skipped because files are missing; "" if none is."""
        total = len(self._keyframes)
        count = total - len(self._present[0])
        missing = f"the files of {count} of {total} key frames are missing; these are skipped"
        return missing if count else ""

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the official lists train and val of v1.0-trainval and v1.0-mini.

        The split is by scene. For other versions there are no lists.
        """
        present, _ = self._present
        scenes = {self._keyframes[token].scene for token in present}
        val_scenes = validation_scenes(self.version, scenes)
        if not val_scenes:
            return {}
        lists: dict[str, list[str]] = {"train": [], "val": []}
        for token in present:
            lists["val" if self.sequence_of(token) in val_scenes else "train"].append(token)
        return {name: tuple(tokens) for name, tokens in lists.items()}

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the scene of a frame, 20 seconds of a drive, or None for an unknown frame."""
        return self._keyframes[frame_id].scene if frame_id in self._keyframes else None

    def time_of(self, frame_id: str) -> float | None:
        """Return the time of the sample in seconds."""
        return self._frame(frame_id).time_s

    def pose_of(self, frame_id: str) -> Float[np.ndarray, "4 4"] | None:
        """Return the pose of the LiDAR in the map."""
        return self._frame(frame_id).cameras[0].calibration.pose_in_map()

    def file_names(self) -> Mapping[str, str]:
        """Return the sample token of each name of a sweep or image without suffix."""
        names: dict[str, str] = {}
        for token in self._present[0]:
            frame = self._keyframes[token]
            names |= {
                Path(file).name.partition(".")[0]: token for file in (frame.points, *frame.images)
            }
        return names

    def files(self, frame_id: str) -> FrameFiles:
        """Return the paths of the frame's files; calibration and labels are tables of all frames.

        Raises:
            DataError: if there is no such frame, or its files are outside the data set.
        """
        frame = self._frame(frame_id)
        labels = self._annotations.path
        _, has_images = self._present
        images = tuple(self.root / image for image in frame.images) if has_images else ()
        files = FrameFiles(
            points=self.root / frame.points,
            image=images[0] if images else None,
            calibration=self._tables / "calibrated_sensor.json",
            label=labels if labels.exists() else None,
            further_images=images[1:],
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
            sweep = read_cloud(files.points, self.layout)
            # For row vectors, p @ R applies the inverse of R: from the sensor's axes to ours.
            sweep[:, :3] = sweep[:, :3] @ TO_SENSOR_AXES[:3, :3].astype(np.float32)
        cameras = frame.cameras
        if image and files.images:
            cameras = tuple(map(_with_image, cameras, files.images))
        if len(cameras) == 1:
            cameras = (replace(cameras[0], name=""),)
        first = cameras[0]
        found = Frame(frame_id, sweep, first.calibration, first.image_size)
        return found.with_cameras(cameras)

    def annotations(self, frame_id: str) -> Annotations:
        """Return the objects in the view of any of the cameras, in the LiDAR frame.

        Raises:
            DataError: if the version has no annotations, or they are malformed.
        """
        if self.files(frame_id).label is None:
            raise DataError(
                f"{self._annotations.path}: no such table; {self.version} has no labels"
            )
        return self._annotations.read(frame_id, self._frame(frame_id).cameras)

    def copy_writer(
        self, folder: Path, copies: Mapping[str, Similarity | None], *, camera_view: bool
    ) -> NuScenesCopies:
        """Return the writer of copies of some frames."""
        return NuScenesCopies(self, self._tables, folder, copies, camera_view=camera_view)

    def check_path(self, name: str) -> None:
        """Raise DataError if the path of a file in the tables leads out of the data set."""
        self._boundary.check(self.root / name)

    def _frame(self, frame_id: str) -> Keyframe:
        check_frame_id(frame_id)
        if frame_id not in self._keyframes:
            raise DataError(f"{self._tables}: no key frame {frame_id}; frame ids are sample tokens")
        return self._keyframes[frame_id]


def _with_image(camera: Camera, path: Path) -> Camera:
    """Return the camera with the image in a file.

    Raises:
        DataError: if the file is missing or damaged, or has another size than in the table.
    """
    pixels = read_image(path)
    if pixels.shape[1::-1] != camera.image_size:
        raise DataError(
            f"{path}: {pixels.shape[1::-1]} pixels, but {camera.image_size} in sample_data.json"
        )
    return replace(camera, image=pixels)


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
