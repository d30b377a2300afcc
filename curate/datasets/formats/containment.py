"""Paths of a data set stay inside it: names lead nowhere else, and neither do links, unless wished.

A data set that was fetched from somewhere is foreign data. A frame name with a separator, or a link
that its archive has brought along, would make curate read files that nobody meant to show it; a
named pipe would make it wait for ever.
"""

import errno
import os
import stat
from pathlib import Path

from curate.errors import DataError


def check_frame_id(frame_id: str) -> None:
    """Raise DataError if the id could lead out of the data set's folders, or garble a message."""
    harmless = frame_id.isprintable() and not {"/", "\\"} & set(frame_id)
    if not frame_id or frame_id.startswith(".") or not harmless:
        raise DataError(
            f"{frame_id[:80]!r} is no frame id: it must be a plain file name such as 000008"
        )


class Boundary:
    """The folder of a data set, which no path of it leads out of.

    Where folders really lie is looked up once each: who can exchange them meanwhile can exchange
    the files as well.

    Args:
        root: the folder.
        follow_links: whether links and names may lead out of it after all.
    """

    def __init__(self, root: Path, *, follow_links: bool = False) -> None:
        self._root = os.fspath(root)
        self._open = follow_links
        self._folders: dict[str, str] = {}

    def check(self, *paths: Path) -> None:
        """Raise DataError if a path leads out, by a link or by its name, or is a pipe or a device.

        Or where no file could have that name. It need not be there.
        """
        if self._open:
            for path in paths:
                _mode(os.fspath(path))
            return
        home = self._real_folder(self._root)
        for path in paths:
            real, mode = self._real(path)
            if real != home and not real.startswith(home.rstrip(os.sep) + os.sep):
                raise DataError(
                    f"{path}: leads out of the data set, to {real}; if you made that link "
                    "yourself, set dataset.follow_links = true (curate init --follow-links)"
                )
            if mode and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise DataError(f"{path}: is a pipe or a device, no file; remove it")

    def _real(self, path: Path) -> tuple[str, int]:
        """`os.path.realpath`, which would ask the system about every folder on the way.

        With the mode of what lies there, 0 where nothing does.
        """
        folder, name = os.path.split(path)
        plain = name not in ("", os.curdir, os.pardir) and "\0" not in name
        mode = _mode(os.fspath(path))
        if plain and not stat.S_ISLNK(mode):
            return f"{self._real_folder(folder).rstrip(os.sep)}{os.sep}{name}", mode
        real = os.path.realpath(path)
        return real, _mode(real)

    def _real_folder(self, folder: str) -> str:
        if folder not in self._folders:
            self._folders[folder] = os.path.realpath(folder)
        return self._folders[folder]


def _mode(path: str) -> int:
    """0 where nothing is there; DataError where nothing could be."""
    try:
        return os.lstat(path).st_mode
    except ValueError:  # a zero byte
        raise DataError(f"{path!r} is no path") from None
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise DataError(f"{path[:80]!r}...: is no path, its name is too long") from None
        return 0
