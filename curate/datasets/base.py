"""The protocols of data sets."""

from collections.abc import Iterable, Mapping
from typing import Protocol, runtime_checkable

import numpy as np

from curate.detections import Annotations
from curate.frames import Frame, FrameFiles
from curate.shapes import Float


class Dataset(Protocol):
    """A set of LiDAR-camera frames, each with a name.

    Every method that reads a file raises `DataError` if the file is missing, damaged or malformed.
    The message says which file, where in it, and what to do.
    """

    name: str

    def frame_ids(self) -> tuple[str, ...]:
        """Return the ids of all frames, sorted."""
        ...

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """Return the frame lists that come with the data set (KITTI's ImageSets); may be empty."""
        ...

    def files(self, frame_id: str) -> FrameFiles:
        """Return the paths of the frame's files without opening them."""
        ...

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """Read the frame's calibration and image size, and its points and image if requested."""
        ...

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth."""
        ...


@runtime_checkable
class Sequenced(Protocol):
    """A data set that can tell which frames belong to the same recording."""

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the sequence (drive, scene, clip) of a frame, or None if it is unknown."""
        ...


@runtime_checkable
class Timed(Protocol):
    """A data set that can tell when its frames were recorded."""

    def time_of(self, frame_id: str) -> float | None:
        """Return the time of a frame's sweep in seconds, or None if it is unknown."""
        ...


@runtime_checkable
class Posed(Protocol):
    """A data set that can tell where its frames were recorded."""

    def pose_of(self, frame_id: str) -> Float[np.ndarray, "4 4"] | None:
        """Return the pose of the LiDAR in the sequence's map frame, or None if it is unknown.

        It maps LiDAR to map coordinates; z of the map frame is up.
        """
        ...


@runtime_checkable
class FileNamed(Protocol):
    """A data set with file names that differ from the names of its frames."""

    def file_names(self) -> Mapping[str, str]:
        """Return the frame of each name of a file without suffix."""
        ...


@runtime_checkable
class Incomplete(Protocol):
    """A data set that skips frames with missing files."""

    def skipped_frames(self) -> str:
        """Return how many frames are skipped because of which files; "" if none is."""
        ...


def sequences_of(dataset: Dataset, frames: Iterable[str]) -> Mapping[str, str]:
    """Return the sequence of each frame, without frames of unknown sequence."""
    if not isinstance(dataset, Sequenced):
        return {}
    found = {frame: dataset.sequence_of(frame) for frame in frames}
    return {frame: sequence for frame, sequence in found.items() if sequence is not None}


def time_of(dataset: Dataset, frame_id: str) -> float | None:
    """Return the time of a frame in seconds, or None if it is unknown."""
    return dataset.time_of(frame_id) if isinstance(dataset, Timed) else None


def pose_of(dataset: Dataset, frame_id: str) -> Float[np.ndarray, "4 4"] | None:
    """Return the pose of the LiDAR in a frame, or None if it is unknown; see `Posed`."""
    return dataset.pose_of(frame_id) if isinstance(dataset, Posed) else None
