"""Check the frames of edited files against the frames of the review."""

from collections.abc import Iterable
from pathlib import Path

from curate.errors import DataError
from curate.review.sheet import Sheet


def check_frame_names(place: Path, names: Iterable[str], sheet: Sheet) -> None:
    """Raise DataError if edited files contain a frame that is not in the review."""
    shown = {frame.frame for frame in sheet.frames}
    unexpected = sorted(set(names) - shown)
    if unexpected:
        raise DataError(
            f"{place}: frame '{unexpected[0]}' is not in this review; remove it, or import the "
            "files of the right review"
        )
