"""Lists of frames, their hash, and what changed between two of them in words."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass

from curate.exporters.base import named


@dataclass(frozen=True)
class SplitList:
    """Some frames by name, each once and sorted, so that the hash depends on nothing else.

    Attributes:
        frames: their names.
    """

    frames: tuple[str, ...]

    @classmethod
    def of(cls, frames: Iterable[str]) -> "SplitList":
        """The list of some frames in any order."""
        return cls(tuple(sorted(set(frames))))

    @classmethod
    def from_text(cls, text: str) -> "SplitList":
        """The inverse of `text`."""
        return cls(tuple(text.splitlines()))

    @property
    def text(self) -> str:
        """A name per line."""
        return "".join(f"{frame}\n" for frame in self.frames)

    @property
    def sha256(self) -> str:
        """Of the text, in hexadecimal."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def __len__(self) -> int:
        return len(self.frames)


def changes(before: SplitList, now: SplitList) -> str:
    """What was added and removed, with a few names; empty where nothing was."""
    added, removed = set(now.frames) - set(before.frames), set(before.frames) - set(now.frames)
    told = [
        f"{len(frames)} {how} ({named(frames)})"
        for how, frames in (("added", added), ("removed", removed))
        if frames
    ]
    return " and ".join(told)
