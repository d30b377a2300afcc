"""The split lists that `curate init` recorded, and what has changed since."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import select

from curate.datasets.frame_names import read_frame_list
from curate.errors import ConfigError
from curate.firewall.split_lists import SplitList, describe_changes
from db import bulk
from pipelines.workspace.splits import SPLITS
from pipelines.workspace.workspace import Workspace

# The lists of a data set that decide which frames may be used for training.
_DATASET_LISTS = ("train", "val")


def split_rows(
    chosen: Mapping[str, Iterable[str]],
    dataset_lists: Mapping[str, Iterable[str]],
    files: Mapping[str, Path],
) -> list[dict[str, Any]]:
    """Return the rows of `split_list`.

    Args:
        chosen: the frames of each split.
        dataset_lists: the data set's lists, by name.
        files: the files that init was given, by split.
    """
    rows: list[tuple[str, str, str | None, Iterable[str]]]
    rows = [("chosen", name, None, chosen[name]) for name in SPLITS]
    rows += [
        ("dataset", name, None, dataset_lists[name])
        for name in _DATASET_LISTS
        if name in dataset_lists
    ]
    rows += [("file", name, str(path.resolve()), _read(path)) for name, path in files.items()]
    return [_row(source, name, path, SplitList.of(names)) for source, name, path, names in rows]


@dataclass(frozen=True)
class RecordedList:
    """A list of frames that init recorded.

    Attributes:
        source: "chosen" for a split of the workspace, "dataset" for a list of the data set, "file"
            for a file that init was given.
        name: of the split or list.
        path: of the file; None for other sources.
        sha256: the recorded hash of the frames.
        frames: the recorded frames.
    """

    source: str
    name: str
    path: Path | None
    sha256: str
    frames: SplitList


@dataclass(frozen=True)
class SplitRecord:
    """The current splits, and the lists that init recorded.

    Attributes:
        splits: names and keys of the frames of each split, now.
        lists: the recorded lists.
    """

    splits: Mapping[str, Mapping[str, int]]
    lists: Sequence[RecordedList]

    @classmethod
    def read(cls, workspace: Workspace) -> "SplitRecord":
        """Read both from the database."""
        table = bulk.table("split_list")
        columns = (table.c[name] for name in ("source", "name", "path", "sha256", "names"))
        rows = workspace.database.rows(select(*columns))
        lists = [
            RecordedList(source, name, path and Path(path), digest, SplitList.from_text(names))
            for source, name, path, digest, names in rows
        ]
        return cls({split: workspace.frames(split) for split in SPLITS}, lists)

    @property
    def split_of(self) -> Mapping[str, str]:
        """The split of each frame."""
        return {name: split for split, names in self.splits.items() for name in names}

    @property
    def damaged(self) -> Sequence[str]:
        """The recorded lists that do not match their recorded hash."""
        return [
            f"{found.source} {found.name}"
            for found in self.lists
            if found.frames.sha256 != found.sha256
        ]

    @property
    def changed(self) -> Mapping[str, str]:
        """Descriptions of the changes since init, by split; unchanged splits are absent."""
        return _describe_changes(
            (found.name, found.frames, self.splits.get(found.name, ()))
            for found in self.lists
            if found.source == "chosen"
        )


def changed_lists(workspace: Workspace, record: SplitRecord) -> Mapping[str, str]:
    """Describe the changed lists outside the workspace; a missing file counts as unchanged."""
    current = workspace.dataset.splits()
    return _describe_changes(
        (f"the data set's {found.name}", found.frames, current.get(found.name, ()))
        if found.path is None
        else (str(found.path), found.frames, _read(found.path))
        for found in record.lists
        if found.source == "dataset" or (found.path is not None and found.path.is_file())
    )


def _describe_changes(lists: Iterable[tuple[str, SplitList, Iterable[str]]]) -> Mapping[str, str]:
    """Describe the changes by list name; unchanged lists are absent."""
    described = {name: describe_changes(before, SplitList.of(now)) for name, before, now in lists}
    return {name: what for name, what in described.items() if what}


def _row(source: str, name: str, path: str | None, names: SplitList) -> dict[str, Any]:
    return {
        "source": source,
        "name": name,
        "path": path,
        "frames": len(names),
        "sha256": names.sha256,
        "names": names.text,
    }


def _read(path: Path) -> list[str]:
    """Return the frames that a file lists."""
    lines = read_frame_list(path, error_type=ConfigError)
    return [name for _, line in lines for name in line.split()]
