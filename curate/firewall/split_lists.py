"""Split lists: the frames of a split, their hash, and a description of changes."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass

from curate.exporters.base import named


@dataclass(frozen=True)
class SplitList:
    """Frame names, unique and sorted; the hash does not depend on their order.

    Attributes:
        frames: their names.
    """

    frames: tuple[str, ...]

    @classmethod
    def of(cls, frames: Iterable[str]) -> "SplitList":
        """Return the list of some frames, given in any order."""
        return cls(tuple(sorted(set(frames))))

    @classmethod
    def from_text(cls, text: str) -> "SplitList":
        """Return the list written as `text`."""
        return cls(tuple(text.splitlines()))

    @property
    def text(self) -> str:
        """One name per line."""
        return "".join(f"{frame}\n" for frame in self.frames)

    @property
    def sha256(self) -> str:
        """SHA-256 of the text, in hexadecimal."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def __len__(self) -> int:
        return len(self.frames)


def describe_changes(before: SplitList, now: SplitList) -> str:
    """Describe added and removed frames with a few names; empty if nothing changed."""
    added, removed = set(now.frames) - set(before.frames), set(before.frames) - set(now.frames)
    parts = [
        f"{len(frames)} {how} ({named(frames)})"
        for how, frames in (("added", added), ("removed", removed))
        if frames
    ]
    return " and ".join(parts)
