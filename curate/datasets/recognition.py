"""Recognition of the layout of a folder, for the message that it is not the expected one."""

import os
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

from curate.datasets.formats.clouds import CLOUD_SUFFIXES

# Entries of a folder that are looked at: enough to recognise it, and fast for large folders.
_LOOKED_AT = 50


def layout_hint(root: Path, kind: str) -> str:
    """Return "; it looks like ...: use ...", or "" if the folder is not recognised.

    Args:
        root: the folder.
        kind: the kind of data set that was expected.
    """
    found = recognised(root)
    if found is None:
        return _hint_of_folder_inside(root)
    name, known_kind = found
    if known_kind == kind:
        return ""
    if known_kind is None:
        return f"; it looks like {name}, which curate does not read: convert it first"
    return f"; it looks like {name}: use --dataset {known_kind}"


def label_hint(root: Path) -> str:
    """Return a hint if a folder of labels contains files, but no text file; else ""."""
    for folder in (folder for home in _homes(root) for folder in _folders(home)):
        suffixes = {path.suffix.lower() for path, is_folder in _entries(folder) if not is_folder}
        if folder.name.startswith("label") and suffixes and ".txt" not in suffixes:
            kinds = ", ".join(f"*{suffix}" for suffix in sorted(suffixes))
            return f"; {folder} contains {kinds}, but labels are KITTI's text files: convert them"
    return ""


def recognised(root: Path) -> tuple[str, str | None] | None:
    """Return the name of a folder's layout and its kind of data set; None if it is unknown.

    The kind is None if curate has no reader for the layout.
    """
    return next(((name, kind) for name, kind, test in _LAYOUTS if test(root)), None)


def _hint_of_folder_inside(root: Path) -> str:
    """Return a hint if one of the folders in the root, or the one around it, is a data set."""
    for folder in (*_folders(root), root.parent):
        found = recognised(folder)
        if found is not None and found[1] is not None:
            return f"; {folder} looks like {found[0]}: use --dataset {found[1]} --root {folder}"
    return _hint_of_points(root)


def _hint_of_points(root: Path) -> str:
    """Return a hint if a folder with another name than expected contains point files."""
    for home in _homes(root):
        for folder in _folders(home):
            if not _has(folder, *CLOUD_SUFFIXES):
                continue
            if folder.name.startswith("velodyne"):
                return f"; {folder} contains point files: rename it to velodyne"
            return (
                f"; {folder} contains point files: write {root / 'dataset.toml'} with points = "
                f'"{folder.relative_to(root).as_posix()}" (docs/datasets.md, "Plain folders") and '
                "use --dataset folder"
            )
    return ""


def _is_kitti(root: Path) -> bool:
    return any(_has(home / "velodyne", *CLOUD_SUFFIXES) for home in _homes(root))


def _is_tracking(root: Path) -> bool:
    """Return whether velodyne, or image_02 or label_02, contains sequences."""
    return any(
        any(_has(sequence, *CLOUD_SUFFIXES) for sequence in _folders(home / "velodyne"))
        for home in _homes(root)
    )


def _is_raw(root: Path) -> bool:
    return any(
        (drive / "velodyne_points").is_dir() for drive in (*_folders(root), *_folders(root, 2))
    )


def _is_nuscenes(root: Path) -> bool:
    return any((folder / "sample_data.json").is_file() for folder in _folders(root))


def _is_folder(root: Path) -> bool:
    return (root / "dataset.toml").is_file()


def _is_waymo_records(root: Path) -> bool:
    return any(_has(folder, ".tfrecord") for folder in (root, *_folders(root)))


def _is_waymo_parquet(root: Path) -> bool:
    homes = (root, *_folders(root))
    return any(_has(home / "lidar", ".parquet") for home in homes)


def _is_argoverse(root: Path) -> bool:
    logs = (root, *_folders(root), *_folders(root, 2))
    return any((log / "sensors" / "lidar").is_dir() for log in logs)


def _is_semantic_kitti(root: Path) -> bool:
    homes = (*_folders(root / "sequences"), *_folders(root / "dataset" / "sequences"))
    return any((home / "velodyne").is_dir() for home in homes)


def _is_kitti_360(root: Path) -> bool:
    return (root / "data_3d_raw").is_dir()


def _is_dair(root: Path) -> bool:
    return any(_has(home / "velodyne", ".pcd") for home in _folders(root)) or (
        (root / "data_info.json").is_file() and (root / "velodyne").is_dir()
    )


def _is_panda(root: Path) -> bool:
    return any(_has(sequence / "lidar", ".gz", ".pkl") for sequence in (root, *_folders(root)))


def _is_once(root: Path) -> bool:
    homes = (*_folders(root), *_folders(root / "data"))
    return any((home / "lidar_roof").is_dir() for home in homes)


def _is_sustech(root: Path) -> bool:
    homes = (root, *_folders(root))
    return any(_has(home / "lidar", ".pcd") and (home / "camera").is_dir() for home in homes)


def _is_recording(root: Path) -> bool:
    return any(_has(folder, ".bag", ".db3", ".mcap", ".pcap") for folder in (root, *_folders(root)))


# From the most specific to the most general.
_LAYOUTS: tuple[tuple[str, str | None, Callable[[Path], bool]], ...] = (
    ("a plain folder with dataset.toml", "folder", _is_folder),
    ("nuScenes", "nuscenes", _is_nuscenes),
    ("KITTI raw", "kitti-raw", _is_raw),
    ("KITTI's object layout", "kitti", _is_kitti),
    ("KITTI tracking", "kitti-tracking", _is_tracking),
    ("KITTI odometry or SemanticKITTI", None, _is_semantic_kitti),
    ("KITTI-360", None, _is_kitti_360),
    ("the Waymo Open Dataset (tfrecord)", None, _is_waymo_records),
    ("the Waymo Open Dataset (parquet)", None, _is_waymo_parquet),
    ("Argoverse 2", None, _is_argoverse),
    ("DAIR-V2X", None, _is_dair),
    ("PandaSet", None, _is_panda),
    ("ONCE", None, _is_once),
    ("SUSTechPOINTS", None, _is_sustech),
    ("ROS or pcap recordings", None, _is_recording),
)


def _homes(root: Path) -> tuple[Path, Path]:
    return root / "training", root


def _folders(root: Path, depth: int = 1) -> Iterator[Path]:
    """Yield some of the folders at a depth below the root."""
    if depth > 1:
        for folder in _folders(root):
            yield from _folders(folder, depth - 1)
        return
    yield from (path for path, is_folder in _entries(root) if is_folder)


def _has(folder: Path, *suffixes: str) -> bool:
    """Return whether a folder contains a file with one of the suffixes among its first entries."""
    return any(
        path.suffix.lower() in suffixes for path, is_folder in _entries(folder) if not is_folder
    )


def _entries(folder: Path) -> Iterator[tuple[Path, bool]]:
    """Yield some visible entries of a folder, and whether they are folders."""
    try:
        with os.scandir(folder) as entries:
            shown = (entry for entry in entries if not entry.name.startswith("."))
            found = [(folder / each.name, each.is_dir()) for each in islice(shown, _LOOKED_AT)]
    except OSError:
        return
    yield from sorted(found)
