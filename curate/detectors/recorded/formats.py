"""Detection of a record's format by suffix and contents, and the reader of each format."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curate.detectors.recorded.argoverse2 import Argoverse2Results
from curate.detectors.recorded.json_files import holds_object, stream_results
from curate.detectors.recorded.kitti_results import KittiResults
from curate.detectors.recorded.mmdetection3d import holds_boxes, read_mmdetection3d
from curate.detectors.recorded.nuscenes import read_nuscenes
from curate.detectors.recorded.openpcdet import read_openpcdet
from curate.detectors.recorded.plain_pickle import read_plain_pickle
from curate.detectors.recorded.results import ReadOptions, ResultsByFrame
from curate.detectors.recorded.st3d import holds_pseudo_labels, read_st3d
from curate.errors import ConfigError, DataError
from curate.files.json_text import read_json

# Readers of formats with one list entry per frame.
_LISTS: Mapping[str, Callable[[Path, Sequence[Any], ReadOptions], ResultsByFrame]] = {
    "openpcdet": read_openpcdet,
    "mmdetection3d": read_mmdetection3d,
}
KINDS = ("csv", "parquet", "kitti", *_LISTS, "nuscenes", "argoverse2", "st3d")
_KINDS_BY_SUFFIX = {
    ".csv": "csv",
    ".parquet": "parquet",
    ".feather": "argoverse2",
    **dict.fromkeys((".pkl", ".pickle", ".json"), "list"),
}
SUFFIXES = tuple(_KINDS_BY_SUFFIX)
"""Suffixes of files with the results of several frames."""

_EXPECTED = (
    "a .csv or .parquet file, a folder of KITTI result files, OpenPCDet's result.pkl, "
    "mmdetection3d's results as .pkl, .json or a folder of .json, nuScenes' results as .json, "
    "Argoverse 2's results as .feather, or ST3D's ps_label_e0.pkl"
)


def detect_kind(path: Path) -> str:
    """Return the format of a record: one of `KINDS`, or "list" if the contents decide.

    Raises:
        DataError: if the path does not exist or its format is not supported.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file of recorded detections")
    if path.is_dir():
        return "mmdetection3d" if any(path.glob("*.json")) else "kitti"
    if path.suffix.lower() not in _KINDS_BY_SUFFIX:
        raise DataError(f"{path}: not a supported format of detections; expected {_EXPECTED}")
    return _KINDS_BY_SUFFIX[path.suffix.lower()]


def read_results(path: Path, kind: str, options: ReadOptions) -> ResultsByFrame:
    """Return the results of one pass, in any format except CSV and Parquet.

    Args:
        path: file or folder.
        kind: one of `KINDS`, or "list" for a pickle or JSON file of any kind.
        options: see `ReadOptions`.

    Raises:
        ConfigError: if an option that the format needs is missing.
        DataError: if the file is missing, damaged or in another format.
    """
    if kind == "kitti":
        return KittiResults(path)
    if kind == "argoverse2":
        return Argoverse2Results(path, options)
    if kind in ("list", "nuscenes") and path.suffix.lower() == ".json" and holds_object(path):
        return read_nuscenes(path, stream_results(path))
    content = _read(path)
    if kind == "nuscenes":
        raise DataError(
            f"{path}: not nuScenes results; expected a JSON object with meta and results"
        )
    if isinstance(content, Mapping) and (kind == "st3d" or holds_pseudo_labels(content)):
        return read_st3d(path, content, options)
    if kind == "st3d":
        raise DataError(f"{path}: not ST3D's pseudo-labels; expected a dict of frames")
    if not content:
        raise DataError(f"{path}: contains no frames")
    if not isinstance(content, list | tuple):
        raise DataError(f"{path}: contains a {type(content).__name__}, not a list of frames")
    if kind == "list":
        kind = _detect_list_kind(path, content)
    return _LISTS[kind](path, content, options)


def category_names(results: ResultsByFrame) -> frozenset[str]:
    """Return the category names of all boxes of a pass."""
    if isinstance(results, KittiResults | Argoverse2Results):
        return frozenset(results.category_names())
    return frozenset(
        str(name) for result in results.values() for name in np.unique(result.categories)
    )


def _detect_list_kind(path: Path, entries: Sequence[Any]) -> str:
    """Return the format of a list, detected from its first entry."""
    first = entries[0]
    if holds_boxes(first):
        return "mmdetection3d"
    if isinstance(first, Mapping) and "boxes_lidar" in first:
        return "openpcdet"
    if isinstance(first, Mapping) and {"location", "rotation_y"} <= set(first):
        raise DataError(
            f"{path}: boxes in the camera frame (location, rotation_y) without boxes_lidar; write "
            "them as KITTI result files, which are converted by the calibration"
        )
    names = " ".join(", ".join(map(str, first)).split())[:80] if isinstance(first, Mapping) else ""
    keys = names or type(first).__name__
    raise DataError(f"{path}: entries of an unknown format ({keys}); expected {_EXPECTED}")


def _read(path: Path) -> Any:
    """Return the content of a pickle or JSON file, or the entries of a folder of JSON files."""
    if path.is_dir():
        entries = []
        for file in sorted(path.glob("*.json")):
            entry = read_json(file)
            if not isinstance(entry, dict):
                raise DataError(f"{file}: does not contain the results of a frame")
            entries.append({"frame_id": file.stem, **entry})
        return entries
    return read_json(path) if path.suffix.lower() == ".json" else read_plain_pickle(path)


def check_kind(kind: str) -> None:
    """Raise ConfigError if a format is not supported."""
    if kind not in (*KINDS, "auto"):
        raise ConfigError(f"detector.options.kind '{kind}': use one of auto, {', '.join(KINDS)}")
