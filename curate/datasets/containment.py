"""Paths of a data set stay inside it: names lead nowhere else, and neither do links, unless wished.

A data set that was fetched from somewhere is foreign data. A frame name with a separator, or a link
that its archive has brought along, would make curate read files that nobody meant to show it.
"""

import os
from pathlib import Path

from curate.errors import DataError


def check_frame_id(frame_id: str) -> None:
    """DataError where the id could lead out of the data set's folders, or garble a message."""
    harmless = frame_id.isprintable() and not {"/", "\\"} & set(frame_id)
    if not frame_id or frame_id.startswith(".") or not harmless:
        raise DataError(
            f"{frame_id[:80]!r} is no frame id: it must be a plain file name such as 000008"
        )


def refuse_escape(root: Path, *paths: Path) -> None:
    """DataError where a path leads out of a folder, by a link or by its name.

    Args:
        root: the folder.
        paths: files or folders, which need not be there.
    """
    home = os.path.realpath(root)
    for path in paths:
        try:
            real = os.path.realpath(path)
        except ValueError:  # a zero byte
            raise DataError(f"{str(path)!r} is no path") from None
        if real != home and not real.startswith(home.rstrip(os.sep) + os.sep):
            raise DataError(
                f"{path}: leads out of the data set, to {real}; if you made that link yourself, "
                "set dataset.follow_links = true (curate init --follow-links)"
            )
