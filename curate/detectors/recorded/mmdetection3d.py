"""Results of mmdetection3d 1.0 or newer: boxes with bottom-centre positions, numbered labels.

A list, in a pickle of arrays or in JSON, with boxes_3d (or bboxes_3d), scores_3d and labels_3d of
each frame; or the folder of FRAME.json files that its inferencer writes. `boxes_3d` is (n, 7): x, y
and z of the bottom centre, length, width, height, yaw counter-clockwise from x, in the LiDAR frame.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curate.datasets.frame_names import read_frame_list
from curate.detections import Detections
from curate.detectors.recorded.results import ReadOptions, ResultsByFrame, as_detections
from curate.errors import ConfigError, DataError

# An entry may contain its boxes one level deeper, under either name.
HOLDERS = ("pred_instances_3d", "pts_bbox")
BOX_KEYS = ("boxes_3d", "bboxes_3d")
_FRAME_KEYS = ("frame_id", "sample_idx", "lidar_path")


def read_mmdetection3d(path: Path, entries: Sequence[Any], options: ReadOptions) -> ResultsByFrame:
    """Return the detections of each frame.

    Args:
        path: the file or folder, for messages.
        entries: the content of the file, a dict per frame.
        options: `classes` for the labels; `frame_list` if the entries have no frame ids.

    Raises:
        ConfigError: if the classes are missing, or an entry has no frame id and there is no list.
        DataError: if an entry lacks a key or has invalid values, or a frame occurs twice.
    """
    if not options.classes:
        raise ConfigError(
            f"{path}: labels_3d are numbers: set detector.options.classes in the order of the "
            'model, e.g. classes = ["Pedestrian", "Cyclist", "Car"]'
        )
    frames = _frames(path, entries, options.frame_list)
    found: dict[str, Detections] = {}
    for number, (frame_id, entry) in enumerate(zip(frames, entries, strict=True)):
        if frame_id in found:
            raise DataError(f"{path}: entry {number}: frame {frame_id} occurs twice")
        place = f"{path}: entry {number} (frame {frame_id})"
        found[frame_id] = _detections(place, entry, options.classes)
    return found


def holds_boxes(entry: Any) -> bool:
    """Return whether an entry looks like an mmdetection3d result."""
    return isinstance(entry, Mapping) and any(key in _inner(entry) for key in BOX_KEYS)


def _inner(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    nested = (entry[key] for key in HOLDERS if isinstance(entry.get(key), Mapping))
    return next(nested, entry)


def _detections(place: str, entry: Any, classes: Sequence[str]) -> Detections:
    inner = _inner(entry) if isinstance(entry, Mapping) else {}
    box_key = next((key for key in BOX_KEYS if key in inner), BOX_KEYS[0])
    missing = [key for key in (box_key, "scores_3d", "labels_3d") if key not in inner]
    if missing:
        raise DataError(f"{place}: no {', '.join(missing)}")
    if inner.get("box_type_3d", "LiDAR") != "LiDAR":
        raise DataError(f"{place}: boxes are of type {inner['box_type_3d']}, not LiDAR")
    labels = _labels(place, inner["labels_3d"])
    if len(labels) and (labels.dtype.kind not in "iu" or not 0 <= labels.min() <= labels.max()):
        raise DataError(f"{place}: labels_3d are not the numbers of classes: {labels[:5].tolist()}")
    if len(labels) and labels.max() >= len(classes):
        raise DataError(
            f"{place}: label {labels.max()}, but detector.options.classes lists {len(classes)} "
            "classes"
        )
    names = [classes[label] for label in labels.tolist()]
    found = as_detections(place, inner[box_key], inner["scores_3d"], names)
    found.boxes[:, 2] += found.boxes[:, 5] / 2
    return found


def _labels(place: str, labels: Any) -> np.ndarray:
    """Return (n,) labels of any type."""
    try:
        return np.asarray(labels).reshape(-1)
    except (OverflowError, ValueError):
        raise DataError(f"{place}: labels_3d is not a list of numbers") from None


def _frames(path: Path, entries: Sequence[Any], frame_list: Path | None) -> list[str]:
    """Return the frame id of each entry: from the list if there is one, else from the entry."""
    if frame_list is None:
        frame_ids = [_frame_of(entry) for entry in entries]
        if None in frame_ids:
            raise ConfigError(
                f"{path}: entry {frame_ids.index(None)} has no frame id: set detector.options."
                "frame_list, a file with the frame ids in the order of the results, one per line"
            )
        return [str(frame_id) for frame_id in frame_ids]
    listed = [name for _, name in read_frame_list(frame_list)]
    if len(listed) != len(entries):
        raise DataError(
            f"{frame_list}: {len(listed)} frame ids for {len(entries)} entries in {path}"
        )
    return listed


def _frame_of(entry: Any) -> str | None:
    if not isinstance(entry, Mapping):
        return None
    key = next((key for key in _FRAME_KEYS if key in entry), None)
    return None if key is None else str(entry[key])
