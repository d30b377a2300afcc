"""What every data set offers."""

from collections.abc import Iterable, Mapping
from typing import Protocol, runtime_checkable

from curate.detections import Annotations
from curate.frames import Frame, FrameFiles


class Dataset(Protocol):
    """LiDAR-camera frames by name.

    Every method that reads a file raises `DataError` with the file, the place in it and the remedy
    where it is missing, damaged or malformed.
    """

    name: str

    def frame_ids(self) -> tuple[str, ...]:
        """Return all frames, in sorted order."""
        ...

    def splits(self) -> Mapping[str, tuple[str, ...]]:
        """The named lists of frames that the data set ships (KITTI's ImageSets); may be empty."""
        ...

    def files(self, frame_id: str) -> FrameFiles:
        """Where the frame's files lie; does not open them."""
        ...

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """The frame's calibration, its points unless unwanted, and its image where asked for."""
        ...

    def annotations(self, frame_id: str) -> Annotations:
        """Return the frame's ground truth."""
        ...


@runtime_checkable
class Sequenced(Protocol):
    """A data set that knows which frames were recorded one after the other."""

    def sequence_of(self, frame_id: str) -> str | None:
        """Return the sequence (drive, scene, clip) of a frame; None where it is not known."""
        ...


def sequences_of(dataset: Dataset, frames: Iterable[str]) -> Mapping[str, str]:
    """Return the sequence of each frame that the data set knows one of."""
    if not isinstance(dataset, Sequenced):
        return {}
    found = {frame: dataset.sequence_of(frame) for frame in frames}
    return {frame: sequence for frame, sequence in found.items() if sequence is not None}
