"""The frames of a data set under the names that other programs give them.

Programs name the frame 000008 also as 8 (a number), 000008.png (a file) or velodyne/000008.bin (a
path, with slashes of any system), and the frame DRIVE_0000000005 also as
DRIVE/velodyne_points/data/0000000005.bin. A name is matched in this order; the first rule that fits
a frame decides, and a rule that fits several frames is an error:

1. The name is a frame id.
2. The last part of the path without suffix is a frame id or the name of a file of the frame, or is
   one together with a folder before it (FOLDER_NUMBER).
3. As rule 2, but numbers may have other leading zeros.
4. The name is a number, with or without suffix, and the frame id ends with this number.
"""

import re
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import TypeVar, overload

from curate.datasets.base import Dataset, FileNamed
from curate.datasets.formats.containment import check_frame_id
from curate.errors import CurateError, DataError
from curate.files.text import read_lines

_Key = TypeVar("_Key")

_SUFFIX = re.compile(
    r"\.(bin|pcd|ply|npy|npz|png|jpe?g|bmp|webp|tiff?|txt|json|xml|label|pkl|pickle|feather)\Z",
    re.IGNORECASE,
)
_LEADING_ZEROS = re.compile(r"(?<![0-9])0+(?=[0-9])")
# A number that stands alone, after a word, or after a separator; not the digits of a hash.
_LAST_NUMBER = re.compile(r"(?:[A-Za-z]*|.*[^0-9A-Za-z])([0-9]+)")
# How many frame ids are compared with a name that fits none, to suggest the nearest.
_COMPARED = 500


class FrameNames(Sequence[str]):
    """The ids of all frames of a data set, found by any spelling.

    Args:
        frame_ids: the ids.
        file_names: returns the frame of further names, such as those of its files without suffix;
            called once, if a name is not a frame id.
    """

    def __init__(
        self,
        frame_ids: Iterable[str],
        file_names: Callable[[], Mapping[str, str]] | None = None,
    ) -> None:
        self._ids = tuple(frame_ids)
        self._known = frozenset(self._ids)
        self._read_file_names = file_names

    @classmethod
    def of(cls, frame_ids: Iterable[str]) -> "FrameNames":
        """Return frame ids as `FrameNames`."""
        return frame_ids if isinstance(frame_ids, FrameNames) else cls(frame_ids)

    @classmethod
    def of_dataset(cls, dataset: Dataset) -> "FrameNames":
        """Return the frames of a data set, found by the names of their files as well."""
        named = dataset.file_names if isinstance(dataset, FileNamed) else None
        return cls(dataset.frame_ids(), named)

    def __len__(self) -> int:
        return len(self._ids)

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[str, ...]: ...
    def __getitem__(self, index: int | slice) -> str | tuple[str, ...]:
        return self._ids[index]

    def __iter__(self) -> Iterator[str]:
        return iter(self._ids)

    def __contains__(self, name: object) -> bool:
        return name in self._known

    def find(self, name: str) -> str | None:
        """Return the frame with a name; None if there is none.

        Raises:
            DataError: if the name fits several frames.
        """
        if name in self._known:
            return name
        folders, last = _parts(name)
        texts = [last, *(f"{folder}_{last}" for folder in folders)]
        exact = [text for text in texts if text in self._known]
        exact += [self._file_names[text] for text in texts if text in self._file_names]
        if exact:
            return _only(name, exact)
        padded = [frame for text in texts for frame in self._unpadded.get(_unpadded(text), ())]
        if padded:
            return _only(name, padded)
        if not folders and last.isdecimal():
            return _only(name, self._numbered.get(int(last), ()))
        return None

    def require(
        self, name: str, place: object = None, *, error_type: type[CurateError] = DataError
    ) -> str:
        """Return the frame with a name.

        Args:
            name: the name.
            place: file and line, or the option of the command line, for messages.
            error_type: class of the error.

        Raises:
            CurateError: of class `error_type`, if no frame has it, or several have.
        """
        prefix = "" if place is None else f"{place}: "
        try:
            found = self.find(name)
        except DataError as error:
            raise error_type(f"{prefix}{error}") from None
        if found is None:
            raise error_type(f"{prefix}there is no frame {name[:200]!r}{self.nearest(name)}")
        return found

    def match(self, names: Iterable[str], place: object) -> tuple[dict[str, str], list[str]]:
        """Return the frame of each name, and the names that no frame has.

        Args:
            names: different names.
            place: the file, for messages.

        Raises:
            DataError: if a name fits several frames, or two names fit one frame.
        """
        found: dict[str, str] = {}
        unmatched: list[str] = []
        for name in names:
            try:
                frame = self.find(name)
            except DataError as error:
                raise DataError(f"{place}: {error}") from None
            if frame is None:
                unmatched.append(name)
            else:
                found[name] = frame
        if len(set(found.values())) < len(found):
            name_of: dict[str, str] = {}
            for name, frame in found.items():
                other = name_of.setdefault(frame, name)
                if other != name:
                    raise DataError(
                        f"{place}: {other[:200]!r} and {name[:200]!r} are both frame {frame}; "
                        "remove one"
                    )
        return found, unmatched

    def nearest(self, name: str) -> str:
        """Return "; the nearest are 'a' and 'b'", the ids most similar to a name."""
        ordered, last = self._ordered, _parts(name)[1]
        place = max(0, bisect_left(ordered, last) - _COMPARED // 2)
        pool = ordered if len(ordered) <= _COMPARED else ordered[place:][:_COMPARED]
        close = get_close_matches(last[:200], pool, n=2, cutoff=0) or list(pool[:2])
        shown = " and ".join(repr(each) for each in close)
        return f"; the nearest {'is' if len(close) == 1 else 'are'} {shown}" if close else ""

    @cached_property
    def _file_names(self) -> Mapping[str, str]:
        return self._read_file_names() if self._read_file_names else {}

    @cached_property
    def _ordered(self) -> Sequence[str]:
        return sorted(self._ids)

    @cached_property
    def _unpadded(self) -> Mapping[str, list[str]]:
        """The frames by their ids without leading zeros."""
        return _grouped((_unpadded(frame), frame) for frame in self._ids)

    @cached_property
    def _numbered(self) -> Mapping[int, list[str]]:
        """The frames by the number at the end of their ids."""
        matches = ((_LAST_NUMBER.fullmatch(frame), frame) for frame in self._ids)
        return _grouped((int(match[1]), frame) for match, frame in matches if match)


def files_by_frame(
    folder: Path, patterns: str | Sequence[str], frame_ids: Sequence[str]
) -> Mapping[str, Path]:
    """Return the file of each frame in a folder; files of other frames are left out.

    Args:
        folder: the folder; if no file in it matches the patterns, its subfolders are searched.
        patterns: of the file names in lower case, such as "*.png".
        frame_ids: the ids of all frames; if empty, no file is matched.

    Raises:
        DataError: if no file is of a frame of the data set, a file could be of several, or two
            files are of one frame.
    """
    if not len(frame_ids):
        return {}
    allowed = (patterns,) if isinstance(patterns, str) else patterns
    by_name = _matching(folder.iterdir(), allowed, folder)
    by_name = by_name or _matching(folder.rglob("*"), allowed, folder)
    frames = FrameNames.of(frame_ids)
    found, unmatched = frames.match(by_name, folder)
    if unmatched and not found:
        raise DataError(
            f"{folder}: no file is of a frame of the data set, such as {unmatched[0][:200]!r}"
            f"{frames.nearest(unmatched[0])}"
        )
    return {frame: by_name[name] for name, frame in found.items()}


def _matching(paths: Iterable[Path], patterns: Sequence[str], folder: Path) -> Mapping[str, Path]:
    """Return the visible files that match a pattern, by their paths in the folder."""
    return {
        path.relative_to(folder).as_posix(): path
        for path in paths
        if path.name[0] != "." and any(fnmatchcase(path.name.lower(), each) for each in patterns)
    }


def read_frame_list(
    path: Path, *, error_type: type[CurateError] = DataError
) -> list[tuple[int, str]]:
    """Return line number and content of each line of a list of frames.

    Empty lines and lines that begin with # are left out.

    Raises:
        CurateError: of class `error_type`, if the file is missing or not text.
    """
    lines = enumerate(read_lines(path, "frame list", error_type=error_type), start=1)
    stripped = ((number, line.strip()) for number, line in lines)
    return [(number, line) for number, line in stripped if line and not line.startswith("#")]


def match_frame_list(
    path: Path,
    frame_ids: Iterable[str],
    *,
    groups: Mapping[str, Sequence[str]] | None = None,
    allow_missing: bool = False,
    error_type: type[CurateError] = DataError,
) -> tuple[str, ...]:
    """Return the frames that a file lists, each once, in the order of the file.

    A line holds one name, or several names separated by spaces.

    Args:
        path: the file.
        frame_ids: the ids of all frames, or `FrameNames`.
        groups: frames by the name of their sequence, which may be listed instead of its frames.
        allow_missing: whether plain names that fit no frame are returned unchanged.
        error_type: class of the errors.

    Raises:
        CurateError: of class `error_type`, if the file is missing or not text, or a name fits no
            frame or several.
    """
    frames, groups = FrameNames.of(frame_ids), groups or {}
    found: dict[str, None] = {}
    for number, line in read_frame_list(path, error_type=error_type):
        for name in [line] if line in frames or line in groups else line.split():
            try:
                listed = groups.get(name) or [_listed(frames, name, allow_missing)]
            except DataError as error:
                raise error_type(f"{path}:{number}: {error}") from None
            found |= dict.fromkeys(listed)
    return tuple(found)


def _listed(frames: FrameNames, name: str, allow_missing: bool) -> str:
    frame = frames.find(name)
    if frame is None and allow_missing:
        check_frame_id(name)
        return name
    return frames.require(name)


def last_part(name: str) -> str:
    """Return the last part of a path of any system, without suffix."""
    return _parts(name)[1]


def _parts(name: str) -> tuple[list[str], str]:
    """Return the folders of a path of any system, and its last part without suffix."""
    folders, _, last = name.strip().replace("\\", "/").rpartition("/")
    while "." in last and (match := _SUFFIX.search(last)) and match.start():
        last = last[: match.start()]
    return [folder for folder in folders.split("/") if folder], last


def _unpadded(text: str) -> str:
    return _LEADING_ZEROS.sub("", text)


def _only(name: str, frames: Collection[str]) -> str | None:
    """Return the only frame, None if there is none; raise DataError if there are several."""
    different = sorted(set(frames))
    if len(different) > 1:
        raise DataError(
            f"{name[:200]!r} could be {' or '.join(map(repr, different[:2]))}; write the whole "
            "frame id"
        )
    return different[0] if different else None


def _grouped(pairs: Iterable[tuple[_Key, str]]) -> Mapping[_Key, list[str]]:
    groups: dict[_Key, list[str]] = {}
    for key, frame in pairs:
        groups.setdefault(key, []).append(frame)
    return groups
