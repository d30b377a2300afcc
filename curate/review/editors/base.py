"""What every editor's format offers: boxes out with what it takes to see them, and boxes back."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Protocol

from curate.frames import Frame
from curate.review.edits import EditedBox
from curate.review.sheet import Sheet

Reader = Callable[[str], Frame]
"""A frame with its points, its image and its calibration, by name."""


class Editor(Protocol):
    """The files of one annotation tool."""

    name: ClassVar[str]

    def write(self, folder: Path, sheet: Sheet, read: Reader) -> None:
        """Writes the boxes, and what the tool shows them in, into an existing folder."""
        ...

    def read(self, answer: Path, sheet: Sheet, read: Reader) -> Mapping[str, Sequence[EditedBox]]:
        """The boxes that came back, by frame; a frame that is not there was not looked at.

        Args:
            answer: the folder as it was exported and edited, or what the tool wrote elsewhere.
            sheet: what was shown.
            read: for formats in the camera's frame of reference.

        Raises:
            DataError: a file is missing or damaged, or belongs to a frame that was not shown.
        """
        ...
