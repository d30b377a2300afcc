"""Checks that the paths of a data set stay inside its folder, unless `follow_links` is set.

A downloaded data set is untrusted data. A frame name with a path separator, or a symbolic link in
its archive, could make curate read files outside the data set. A named pipe would make it wait
forever.
"""

import errno
import os
import stat
from pathlib import Path

from curate.errors import DataError


def check_frame_id(frame_id: str) -> None:
    """Raise DataError if the id is not a plain file name that can be printed in a message."""
    # A database may have a null or a number in its place.
    is_text = isinstance(frame_id, str) and frame_id.isprintable() and frame_id != ""
    if not is_text or frame_id.startswith(".") or {"/", "\\"} & set(frame_id):
        raise DataError(
            f"{str(frame_id)[:80]!r} is not a frame id: it must be a plain file name such as 000008"
        )


class Boundary:
    """The folder of a data set; `check` rejects paths that lead out of it.

    The real path of each folder is resolved once and cached. This is safe: whoever can replace a
    folder after the check can also replace the files in it.

    Args:
        root: the folder.
        follow_links: whether links and paths may lead out of the folder.
    """

    def __init__(self, root: Path, *, follow_links: bool = False) -> None:
        self._root = os.fspath(root)
        self._open = follow_links
        self._folders: dict[str, str] = {}

    def check(self, *paths: Path) -> None:
        """Check paths, which need not exist.

        Raises:
            DataError: if a path leads out of the folder (by a link or by its name), is a pipe or a
                device, or is not a valid path.
        """
        if self._open:
            for path in paths:
                _mode(os.fspath(path))
            return
        root = self._real_folder(self._root)
        for path in paths:
            real, mode = self._real(path)
            if real != root and not real.startswith(root.rstrip(os.sep) + os.sep):
                raise DataError(
                    f"{path}: leads out of the data set, to {real}; if you created that link "
                    "yourself, set dataset.follow_links = true (curate init --follow-links)"
                )
            if mode and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise DataError(f"{path}: is a pipe or a device, not a file; remove it")

    def _real(self, path: Path) -> tuple[str, int]:
        """Return the real path and its mode, 0 if it does not exist.

        `os.path.realpath` makes a system call for every parent folder. Here the folder's real path
        is cached, so a path that is not a link needs one call.
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
    """Return the mode of a path without following links, 0 if it does not exist.

    Raises:
        DataError: if no file could have that path.
    """
    try:
        return os.lstat(path).st_mode
    except ValueError:  # a null byte
        raise DataError(f"{path!r} is not a valid path") from None
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise DataError(f"{path[:80]!r}... is not a valid path: the name is too long") from None
        return 0
