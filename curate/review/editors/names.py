"""Frames of an answer, checked against those that were shown."""

from collections.abc import Iterable
from pathlib import Path

from curate.errors import DataError
from curate.review.sheet import Sheet


def check_frame_names(place: Path, names: Iterable[str], sheet: Sheet) -> None:
    """DataError where an answer holds frames that the review does not."""
    shown = {frame.frame for frame in sheet.frames}
    strangers = sorted(set(names) - shown)
    if strangers:
        raise DataError(
            f"{place}: holds frame '{strangers[0]}', which this review does not; take it out, or "
            "import the answer of the right review"
        )
