"""The files of a folder by frame: exactly one point file, and at most one image."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path

from curate.errors import DataError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


class FrameFolder:
    """The files FRAME.suffix of a folder; suffixes are compared without case.

    The folder is listed once, when it is first needed. A folder that does not exist is empty.

    Args:
        folder: the folder.
        suffixes: the suffixes of the files; the first one is that of a file that does not exist.
        kind: kind of the files, e.g. "point", for error messages.
    """

    def __init__(self, folder: Path, suffixes: tuple[str, ...], kind: str) -> None:
        self.folder = folder
        self._suffixes = suffixes
        self._kind = kind

    @cached_property
    def _listing(self) -> tuple[dict[str, str], dict[str, str], Counter[str]]:
        """The file of each frame, a second file of a frame, and the count of other files."""
        names: dict[str, str] = {}
        second: dict[str, str] = {}
        others: Counter[str] = Counter()
        for name in visible_names(self.folder):
            stem, dot, ending = name.rpartition(".")
            if f"{dot}{ending}".lower() not in self._suffixes:
                others[ending if dot else ""] += 1
            elif stem in names:
                second[stem] = name
            else:
                names[stem] = name
        return names, second, others

    def __contains__(self, frame: str) -> bool:
        return frame in self._listing[0]

    def frames(self) -> tuple[str, ...]:
        """Return the frames that have a file, sorted."""
        return tuple(sorted(self._listing[0]))

    def path(self, frame: str) -> Path:
        """Return the path of a frame's file, which need not exist.

        Raises:
            DataError: if the frame has two files.
        """
        names, second, _ = self._listing
        if frame in second:
            one, two = sorted((names[frame], second[frame]))
            raise DataError(
                f"{self.folder}: frame {frame} has two {self._kind} files, {one} and {two}; "
                "remove or rename one of them"
            )
        return self.folder / names.get(frame, f"{frame}{self._suffixes[0]}")

    def check(self, frames: Iterable[str]) -> None:
        """Check that none of the frames has two files.

        Raises:
            DataError: if one has.
        """
        for frame in sorted(self._listing[1].keys() & set(frames)):
            self.path(frame)

    def content(self) -> str:
        """Return what the folder contains instead, for the message that there is no such file."""
        if not self.folder.is_dir():
            return "there is no such folder"
        others = self._listing[2]
        if not others:
            return "it is empty"
        listed = [
            f"{count} {f'*.{ending}' if ending else 'folders or files without a suffix'}"
            for ending, count in others.most_common(3)
        ]
        return f"it contains {', '.join(listed)}"


def visible_names(folder: Path) -> Iterator[str]:
    """Yield the names in a folder without hidden ones such as macOS' ._*."""
    if not folder.is_dir():
        return
    with os.scandir(folder) as entries:  # `glob` would keep an object per file in memory
        for entry in entries:
            if not entry.name.startswith("."):
                yield entry.name


def visible_files(folder: Path, pattern: str) -> Iterator[Path]:
    """Yield the files of a folder that match a pattern, without hidden ones."""
    for name in visible_names(folder):
        if fnmatchcase(name, pattern):
            yield folder / name
