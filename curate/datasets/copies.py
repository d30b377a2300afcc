"""Copies of frames in another folder, in a layout that readers of the data set open.

Each frame is copied as it is, or as A(x) for a similarity A: see `curate.geometry.augmented_views`.
Frame ids stay, images are links, labels are not copied. Formats of points stay as well, with all
columns.

| data set | copies are a data set of the kind |
|---|---|
| kitti, kitti-raw, kitti-tracking | kitti, in training/, with testing as a second name of it |
| nuscenes | nuscenes |
| folder, and a user's own class | folder |

Raw and tracking data have one calibration per recording, but each copy has its own: therefore they
become a data set of single frames.

    writer = copy_writer(dataset, folder, {"000008": Similarity(flip_y=True), "000009": None})
    writer.prepare()
    for frame_id in writer.frame_ids:
        if not writer.is_written(frame_id):
            writer.write(frame_id)
"""

import contextlib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from curate.datasets.base import Dataset
from curate.datasets.formats.containment import check_frame_id
from curate.datasets.formats.moved_clouds import Keep, move_cloud
from curate.datasets.formats.point_layout import PointLayout
from curate.datasets.kitti.calibration import is_written_calibration, write_calibration
from curate.errors import DataError
from curate.files.atomic import replace_file
from curate.files.links import is_linked, link_file
from curate.files.toml_text import toml, toml_key
from curate.frames import Calibration, Camera, Frame
from curate.geometry.augmented_views import augmented_frame
from curate.geometry.projection import in_camera_view
from curate.geometry.similarity import Similarity

Copies = Mapping[str, Similarity | None]
"""A of each frame, None for a frame that is copied as it is."""


class CopyWriter(Protocol):
    """Writes copies of frames into a folder; every file is written atomically.

    Attributes:
        kind: kind of data set that the copies are.
        clouds: folder of the points within the copies.
        frame_ids: the frames, sorted.
    """

    kind: str
    clouds: str
    frame_ids: tuple[str, ...]

    def prepare(self) -> None:
        """Write the files that all copies share: frame lists, tables, a description.

        Their content depends on the frames and their A only, so several processes may write them.
        """
        ...

    def is_written(self, frame_id: str) -> bool:
        """Return whether the copy of a frame is complete.

        Points are the last file and whole if they are there. Of the others, existence and size
        count.
        """
        ...

    def write(self, frame_id: str) -> None:
        """Write the copy of a frame; its points are the last file.

        Raises:
            DataError: if a file of the frame is missing, damaged or malformed.
        """
        ...


@runtime_checkable
class Copyable(Protocol):
    """A data set that writes copies in a layout of its own."""

    def copy_writer(self, folder: Path, copies: Copies, *, camera_view: bool) -> CopyWriter:
        """Return the writer of copies of some frames."""
        ...


@runtime_checkable
class PointFiles(Protocol):
    """A data set that reads points with `clouds.read_cloud`, so that their files can be copied.

    Attributes:
        layout: the layout of the files.
        copied_as: kind of data set that copies are: kitti or folder.
    """

    layout: PointLayout
    copied_as: str


def copy_writer(
    dataset: Dataset, folder: Path, copies: Copies, *, camera_view: bool = False
) -> CopyWriter:
    """Return the writer of copies of some frames of a data set.

    Args:
        dataset: the data set.
        folder: root of the copies.
        copies: A of each frame.
        camera_view: whether only the points that a camera sees are written.
    """
    if isinstance(dataset, Copyable) and _is_own(dataset):
        return dataset.copy_writer(folder, copies, camera_view=camera_view)
    if not isinstance(dataset, PointFiles) or not _is_own(dataset):
        return FolderCopies(dataset, folder, copies, None, camera_view=camera_view)
    kind = KittiCopies if dataset.copied_as == "kitti" else FolderCopies
    return kind(dataset, folder, copies, dataset.layout, camera_view=camera_view)


def copy_kind(dataset: Dataset) -> str:
    """Return the kind of data set that copies are."""
    return copy_writer(dataset, Path(), {}).kind


def _is_own(dataset: Dataset) -> bool:
    """Return whether a class is one of curate; a derived one may read other points."""
    return type(dataset).__module__.startswith("curate.")


class _Copies:
    """The common part of copies in folders of points, calibrations and images."""

    def __init__(
        self,
        dataset: Dataset,
        folder: Path,
        copies: Copies,
        layout: PointLayout | None,
        *,
        camera_view: bool,
    ) -> None:
        self._dataset = dataset
        self._camera_view = camera_view
        self._folder = folder
        self._copies = copies
        self._layout = layout  # None if the files of points cannot be copied
        self.frame_ids = tuple(sorted(copies))
        for frame_id in self.frame_ids:
            check_frame_id(frame_id)

    def _points(self, folder: Path, frame_id: str) -> Path:
        """Return the path of a copy's points in a folder."""
        suffix = ".bin" if self._layout is None else self._dataset.files(frame_id).points.suffix
        return folder / f"{frame_id}{suffix}"

    def _calibrated(self, frame: Frame) -> Frame:
        """Return a frame with the calibrations of its copy, without points."""
        similarity = self._copies[frame.frame_id] or Similarity()
        return augmented_frame(frame.with_points(frame.points[:0]), similarity)

    def _write_points(self, target: Path, frame: Frame) -> None:
        """Write the points of a frame's copy."""
        similarity = self._copies[frame.frame_id]
        move = (similarity or Similarity()).apply_to_points
        keep = view_of(frame) if self._camera_view else None
        source = self._dataset.files(frame.frame_id).points
        if self._layout is None:
            points = frame.points if keep is None else frame.points[keep(frame.points)]
            replace_file(target, np.ascontiguousarray(move(points), dtype="<f4").tobytes())
        elif similarity is None and keep is None:
            link_file(source, target)
        else:
            move_cloud(source, target, self._layout, move, keep)


class KittiCopies(_Copies):
    """Copies in the layout of KITTI's object data set.

    The frames are in training/. testing is a link to it, and ImageSets/test.txt lists the frames,
    because tools take frames without labels from there; train.txt and val.txt are empty.
    """

    kind = "kitti"
    clouds = "training/velodyne"

    @property
    def _home(self) -> Path:
        return self._folder / "training"

    @property
    def _camera(self) -> int:
        """KITTI's camera of the colour images, unless the data set reads another one."""
        return int(getattr(self._dataset, "camera", 2))

    def prepare(self) -> None:
        """Write the frame lists, and the second name of the folder of frames."""
        for name in ("velodyne", "calib"):
            (self._home / name).mkdir(parents=True, exist_ok=True)
        for name, frames in {"test": self.frame_ids, "train": (), "val": ()}.items():
            text = "".join(f"{frame}\n" for frame in frames)
            replace_file(self._folder / "ImageSets" / f"{name}.txt", text.encode())
        # Another shard may have made it; without links, the tools' split test has no folder.
        with contextlib.suppress(OSError):
            (self._folder / "testing").symlink_to(self._home.name)

    def is_written(self, frame_id: str) -> bool:
        """Return whether the copy is complete."""
        image = self._dataset.files(frame_id).image
        return (
            self._points(self._home / "velodyne", frame_id).exists()
            and is_written_calibration(self._home / "calib" / f"{frame_id}.txt")
            and (image is None or is_linked(image, self._image(image, frame_id)))
        )

    def write(self, frame_id: str) -> None:
        """Write calibration, image and points of a copy."""
        frame = self._dataset.read(frame_id)  # checks all its files
        copied = self._calibrated(frame)
        write_calibration(self._home / "calib" / f"{frame_id}.txt", copied.calibration)
        image = self._dataset.files(frame_id).image
        if image is not None:
            link_file(image, self._image(image, frame_id))
        self._write_points(self._points(self._home / "velodyne", frame_id), frame)

    def _image(self, image: Path, frame_id: str) -> Path:
        """Return the path of a copy's image."""
        return self._home / f"image_{self._camera}" / f"{frame_id}{image.suffix}"


class FolderCopies(_Copies):
    """Copies in a plain folder with dataset.toml, for data of any layout.

    The points of a user's own data set are written as it reads them: x, y, z and intensity.
    """

    kind = "folder"
    clouds = "points"

    def prepare(self) -> None:
        """Write dataset.toml and the frame list."""
        text = "".join(f"{frame}\n" for frame in self.frame_ids)
        replace_file(self._folder / "ImageSets" / "test.txt", text.encode())
        (self._folder / "points").mkdir(parents=True, exist_ok=True)
        replace_file(self._folder / "dataset.toml", self._description().encode())

    def is_written(self, frame_id: str) -> bool:
        """Return whether the copy is complete."""
        images = self._dataset.files(frame_id).images
        return (
            self._points(self._folder / "points", frame_id).exists()
            and all(
                is_written_calibration(path) for path in self._calibrations(self._first, frame_id)
            )
            and all(
                is_linked(image, self._image(image, camera, frame_id))
                for camera, image in zip(self._first.cameras, images, strict=False)
            )
        )

    def write(self, frame_id: str) -> None:
        """Write calibrations, images and points of a copy."""
        frame = self._dataset.read(frame_id)  # checks all its files
        copied = self._calibrated(frame)
        images = self._dataset.files(frame_id).images
        for path, calibration in self._calibrations(copied, frame_id).items():
            write_calibration(path, calibration)
        for camera, image in zip(copied.cameras, images, strict=False):  # there may be no images
            link_file(image, self._image(image, camera, frame_id))
        self._write_points(self._points(self._folder / "points", frame_id), frame)

    def _calibrations(self, frame: Frame, frame_id: str) -> dict[Path, Calibration]:
        """Return the calibrations of a frame by their paths in a copy."""
        home, name = self._folder / "calib", f"{frame_id}.txt"
        if not frame.cameras and frame.calibration.has_camera:
            return {home / name: frame.calibration}
        return {home / each.name / name: each.calibration for each in frame.cameras}

    def _image(self, image: Path, camera: Camera, frame_id: str) -> Path:
        """Return the path of a copy's image."""
        return self._folder / "images" / camera.name / f"{frame_id}{image.suffix}"

    @cached_property
    def _first(self) -> Frame:
        """The first frame that can be read, without points: its cameras are those of all frames.

        Raises:
            DataError: if no frame can be read.
        """
        for frame_id in self.frame_ids[:-1]:
            with contextlib.suppress(DataError):
                return self._dataset.read(frame_id, points=False)
        return self._dataset.read(self.frame_ids[-1], points=False)

    def _description(self) -> str:
        """Return the content of dataset.toml, from the first frame."""
        lines = ['points = "points"', 'splits = "ImageSets"']
        if self._layout is not None:
            layout = {
                "columns": None if self._layout.column_names else self._layout.columns,
                "column_names": self._layout.column_names,
                "intensity_field": self._layout.intensity_field,
                "intensity_scale": self._layout.intensity_scale,
            }
            lines += [f"{key} = {toml(value)}" for key, value in layout.items() if value]
        first = self._first
        has_images = bool(self._dataset.files(first.frame_id).images)
        if not first.cameras and first.calibration.has_camera:
            lines.append('calibration = "calib"')
        for camera in first.cameras:
            if camera.name:
                check_frame_id(camera.name)  # the name of a folder
            (self._folder / "calib" / camera.name).mkdir(parents=True, exist_ok=True)
            lines += _camera_table(camera, has_images=has_images)
        return "\n".join(lines) + "\n"


def view_of(frame: Frame) -> Keep:
    """Return the function that selects the points that a camera of the frame sees."""
    return lambda points: in_camera_view(frame.with_points(points))


def _camera_table(camera: Camera, *, has_images: bool) -> list[str]:
    """Return the lines of dataset.toml that describe a camera."""
    path = f"/{camera.name}" if camera.name else ""
    images = f"images{path}" if has_images else list(camera.image_size)
    return [
        *([f"[cameras.{toml_key(camera.name)}]"] if camera.name else []),
        f"{'images' if has_images else 'image_size'} = {toml(images)}",
        f"calibration = {toml(f'calib{path}')}",
    ]
