"""The lists of frames as `curate init` found and chose them, and whether they are still so."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from sqlalchemy import select

from curate.errors import ConfigError
from curate.firewall.split_lists import SplitList, changes
from db import bulk
from pipelines.workspace import SPLITS, Workspace

# Of a data set's own lists, those that decide who may learn from what.
_OWN_LISTS = ("train", "val")


def split_rows(
    chosen: Mapping[str, Iterable[str]],
    own: Mapping[str, Iterable[str]],
    files: Mapping[str, Path],
) -> list[bulk.Row]:
    """The rows of `split_list`.

    Args:
        chosen: the frames of each split.
        own: the data set's lists.
        files: the lists that were given by file, by split.
    """
    rows: list[tuple[str, str, str | None, Iterable[str]]]
    rows = [("chosen", name, None, chosen[name]) for name in SPLITS]
    rows += [("dataset", name, None, own[name]) for name in _OWN_LISTS if name in own]
    rows += [("file", name, str(path.resolve()), _read(path)) for name, path in files.items()]
    return [_row(source, name, path, SplitList.of(names)) for source, name, path, names in rows]


def recorded_lists(workspace: Workspace) -> Mapping[tuple[str, str], tuple[str | None, SplitList]]:
    """The path and the list of each source and name."""
    table = bulk.table("split_list")
    query = select(table.c.source, table.c.name, table.c.path, table.c.sha256, table.c.names)
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, query)
    return {
        (source, name): (path, SplitList.from_text(names)) for source, name, path, _, names in rows
    }


def damaged_records(workspace: Workspace) -> list[str]:
    """The recorded lists that do not fit their own hash."""
    table = bulk.table("split_list")
    query = select(table.c.source, table.c.name, table.c.sha256, table.c.names)
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, query)
    return [
        f"{source} {name}"
        for source, name, digest, names in rows
        if SplitList.from_text(names).sha256 != digest
    ]


def changed_splits(workspace: Workspace) -> Mapping[str, str]:
    """What changed in each split of the database since init; nothing where all is as it was."""
    known = recorded_lists(workspace)
    found = {}
    for name in SPLITS:
        if ("chosen", name) in known:
            told = changes(known["chosen", name][1], SplitList.of(workspace.frames(name)))
            if told:
                found[name] = told
    return found


def changed_lists(workspace: Workspace) -> Mapping[str, str]:
    """What changed in each list outside the workspace; a file that is gone has not changed."""
    own = workspace.dataset.splits()
    found = {}
    for (source, name), (path, before) in recorded_lists(workspace).items():
        if source == "dataset":
            told, what = changes(before, SplitList.of(own.get(name, ()))), f"the data set's {name}"
        elif source == "file" and path is not None and Path(path).is_file():
            told, what = changes(before, SplitList.of(_read(Path(path)))), path
        else:
            continue
        if told:
            found[what] = told
    return found


def _row(source: str, name: str, path: str | None, names: SplitList) -> bulk.Row:
    return (source, name, path, len(names), names.sha256, names.text)


def _read(path: Path) -> list[str]:
    """The frames that a file names."""
    try:
        return path.read_text(encoding="utf-8").split()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: no list of frame ids: {error}") from error
