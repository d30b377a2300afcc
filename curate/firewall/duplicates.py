"""Find one recording under two names: files with the same content in different splits.

Files are compared by size, then by the hash of their first bytes, and only if both are equal by
their whole content. The hashes of first bytes are cached between runs by path, size and mtime.
"""

import hashlib
import json
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from curate.files.atomic import replace_file

_log = logging.getLogger(__name__)

HEAD_BYTES = 1 << 16
# Smaller files are empty sweeps or blank images, which are equal without being one recording.
SMALLEST_BYTES = 256


@dataclass(frozen=True)
class SplitFile:
    """A file of a frame.

    Attributes:
        split: of the frame.
        frame: its name.
        path: of the file.
    """

    split: str
    frame: str
    path: Path


class HeadHashes:
    """A cache of the hashes of files' first bytes, in a JSON file; a damaged cache is rebuilt.

    Args:
        path: of the JSON file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._cache: dict[str, list[int | str]] = _read_cache(path)
        self._changed = False

    def of(self, path: Path, size: int, changed_ns: int) -> str:
        """Return the hash of a file's first bytes; the file is read only if it has changed."""
        cached = self._cache.get(str(path))
        if isinstance(cached, list) and cached[:2] == [size, changed_ns] and len(cached) == 3:
            return str(cached[2])
        with path.open("rb") as file:
            head = hashlib.sha256(file.read(HEAD_BYTES)).hexdigest()
        self._cache[str(path)] = [size, changed_ns, head]
        self._changed = True
        return head

    def save(self) -> None:
        """Write the cache if it has changed."""
        if self._changed:
            replace_file(self._path, json.dumps(self._cache).encode())


def find_duplicates(
    files: Iterable[SplitFile], heads: HeadHashes
) -> list[tuple[SplitFile, SplitFile]]:
    """Return pairs of equal files in different splits, one pair per content and split.

    Files that are missing or smaller than `SMALLEST_BYTES` are skipped.
    """
    by_size: dict[int, list[tuple[SplitFile, int]]] = {}
    for file in files:
        try:
            found = file.path.stat()
        except OSError:
            continue
        if found.st_size >= SMALLEST_BYTES:
            by_size.setdefault(found.st_size, []).append((file, found.st_mtime_ns))
    pairs: list[tuple[SplitFile, SplitFile]] = []
    for size, group in by_size.items():
        if len({file.split for file, _ in group}) > 1:
            by_head: dict[str, list[SplitFile]] = {}
            for file, changed_ns in group:
                by_head.setdefault(heads.of(file.path, size, changed_ns), []).append(file)
            for candidates in by_head.values():
                pairs += _pairs(candidates)
    heads.save()
    return pairs


def _pairs(candidates: list[SplitFile]) -> list[tuple[SplitFile, SplitFile]]:
    """Return the pairs across splits, among files with equal first bytes, that are equal."""
    if len({file.split for file in candidates}) < 2:
        return []
    first: dict[str, dict[str, SplitFile]] = {}
    for file in candidates:
        with file.path.open("rb") as content:
            digest = hashlib.file_digest(content, "sha256").hexdigest()
        first.setdefault(digest, {}).setdefault(file.split, file)
    return [
        (files[0], other)
        for files in (list(of_content.values()) for of_content in first.values())
        for other in files[1:]
    ]


def _read_cache(path: Path) -> dict[str, list[int | str]]:
    try:
        cached = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError):
        _log.warning("%s is damaged; hashing all files again", path)
        return {}
    return dict(cached) if isinstance(cached, Mapping) else {}
