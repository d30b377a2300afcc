"""The protocol of an editor: writes boxes with their point clouds and images, reads edits."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Protocol

from curate.frames import Frame
from curate.review.edits import EditedBox
from curate.review.sheet import Sheet

Reader = Callable[[str], Frame]
"""Returns a frame with its points, image and calibration, by name."""


class Editor(Protocol):
    """The files of one annotation tool."""

    name: ClassVar[str]

    def write(self, folder: Path, sheet: Sheet, read: Reader) -> None:
        """Write the boxes with their point clouds or images into an existing folder."""
        ...

    def read(self, edited: Path, sheet: Sheet, read: Reader) -> Mapping[str, Sequence[EditedBox]]:
        """Return the edited boxes by frame; a frame that is missing was not looked at.

        Args:
            edited: the exported folder after editing, or the output of the tool elsewhere.
            sheet: the manifest of the review.
            read: reads a frame, for formats in the camera's frame of reference.

        Raises:
            DataError: if a file is missing or damaged, or belongs to a frame that was not shown.
        """
        ...
