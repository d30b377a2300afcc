"""The files of a folder by frame: exactly one point file, and at most one image."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path

from curate.errors import DataError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


class FrameFolder:
    """The files FRAME.suffix of a folder; suffixes are compared without case.

    The folder is listed once. A folder that does not exist is empty.

    Args:
        folder: the folder.
        suffixes: the suffixes of the files; the first one is that of a file that does not exist.
        kind: kind of the files, e.g. "point", for error messages.
    """

    def __init__(self, folder: Path, suffixes: tuple[str, ...], kind: str) -> None:
        self.folder = folder
        self._suffixes = suffixes
        self._kind = kind
        self._names: dict[str, str] = {}
        self._second: dict[str, str] = {}
        self.others: Counter[str] = Counter()
        for name in visible_names(folder):
            stem, dot, ending = name.rpartition(".")
            if f"{dot}{ending}".lower() not in suffixes:
                self.others[ending if dot else ""] += 1
            elif stem in self._names:
                self._second[stem] = name
            else:
                self._names[stem] = name

    def __contains__(self, frame: str) -> bool:
        return frame in self._names

    def __len__(self) -> int:
        return len(self._names)

    def frames(self) -> tuple[str, ...]:
        """Return the frames that have a file, sorted."""
        return tuple(sorted(self._names))

    def path(self, frame: str) -> Path:
        """Return the path of a frame's file, which need not exist.

        Raises:
            DataError: if the frame has two files.
        """
        if frame in self._second:
            one, two = sorted((self._names[frame], self._second[frame]))
            raise DataError(
                f"{self.folder}: frame {frame} has two {self._kind} files, {one} and {two}; "
                "remove or rename one of them"
            )
        return self.folder / self._names.get(frame, f"{frame}{self._suffixes[0]}")

    def check(self, frames: Iterable[str]) -> None:
        """Check that none of the frames has two files.

        Raises:
            DataError: if one has.
        """
        for frame in sorted(self._second.keys() & set(frames)):
            self.path(frame)

    def content(self) -> str:
        """Return what the folder contains instead, for the message that there is no such file."""
        if not self.folder.is_dir():
            return "there is no such folder"
        if not self.others:
            return "it is empty"
        listed = [
            f"{count} {f'*.{ending}' if ending else 'folders or files without a suffix'}"
            for ending, count in self.others.most_common(3)
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
