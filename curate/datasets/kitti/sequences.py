"""The frames of data sets with files numbered within each sequence."""

from collections.abc import Mapping
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from curate.datasets.formats.containment import check_frame_id
from curate.datasets.formats.frame_files import FrameFolder
from curate.errors import DataError


class SequenceFiles(Protocol):
    """The point files and images of a sequence by the number of the frame."""

    points: FrameFolder
    images: FrameFolder


Files = TypeVar("Files", bound=SequenceFiles)


class SequenceFrames(Generic[Files]):
    """The frames SEQUENCE_NUMBER with points, and with an image if the data set has any, sorted.

    Args:
        sequences: the files of each sequence.
        has_images: whether frames without an image are skipped.

    Raises:
        DataError: if a frame has two point files or two images.
    """

    def __init__(self, sequences: Mapping[str, Files], *, has_images: bool) -> None:
        frames: dict[str, tuple[Files, str]] = {}
        for name, files in sequences.items():
            numbers = files.points.frames()
            files.points.check(numbers)
            files.images.check(numbers)
            frames |= {f"{name}_{number}": (files, number) for number in numbers}
        self._found = {
            frame: (files, number)
            for frame, (files, number) in sorted(frames.items())
            if not has_images or number in files.images
        }
        self._skipped = len(frames) - len(self._found)

    def ids(self) -> tuple[str, ...]:
        """Return the ids of the frames."""
        return tuple(self._found)

    def describe_skipped(self) -> str:
        """Return how many frames are skipped because they have no image; "" if none is."""
        count = len(self._found) + self._skipped
        return (
            f"{self._skipped} of {count} frames have no image and are skipped"
            if self._skipped
            else ""
        )

    def __contains__(self, frame_id: str) -> bool:
        return frame_id in self._found

    def find(self, frame_id: str, root: Path, form: str) -> tuple[Files, str]:
        """Return the files of a frame's sequence, and the number of the frame.

        Args:
            frame_id: the frame.
            root: root of the data set, for messages.
            form: the form of frame ids, for messages.

        Raises:
            DataError: if there is no such frame.
        """
        check_frame_id(frame_id)
        if frame_id not in self._found:
            raise DataError(f"{root}: no frame {frame_id}; frame ids are {form}")
        return self._found[frame_id]
