"""Match the frames of edited files with the frames of the review."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from curate.datasets.frame_names import FrameNames
from curate.errors import DataError
from curate.review.sheet import Sheet


def match_frame_names(place: Path, names: Iterable[str], sheet: Sheet) -> Mapping[str, str]:
    """Return the frame of each name in edited files.

    Raises:
        DataError: if edited files contain a frame that is not in the review, or one frame twice.
    """
    frames = FrameNames(frame.frame for frame in sheet.frames)
    found, unexpected = frames.match(names, place)
    if unexpected:
        raise DataError(
            f"{place}: frame '{unexpected[0]}' is not in this review{frames.nearest(unexpected[0])}"
            "; remove it, or import the files of the right review"
        )
    return found
