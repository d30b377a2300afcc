"""OpenPCDet's result.pkl: a list with frame_id, name, score and boxes_lidar of each frame.

`boxes_lidar` is (n, 7): box centre, length, width, height, yaw counter-clockwise from x, in the
LiDAR frame, the convention of `Detections`; two further columns of velocities are ignored.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curate.detectors.recorded.results import (
    ReadOptions,
    RecordedResult,
    ResultsByFrame,
    as_detections,
)
from curate.errors import DataError

KEYS = ("frame_id", "name", "score", "boxes_lidar")


def read_openpcdet(path: Path, entries: Sequence[Any], _reading: ReadOptions) -> ResultsByFrame:
    """Return the detections of each frame.

    Args:
        path: the file, for messages.
        entries: the content of the file.

    Raises:
        DataError: if an entry lacks a key, has invalid values or those of an old version, or a
            frame occurs twice.
    """
    found: dict[str, RecordedResult] = {}
    for number, entry in enumerate(entries):
        place = f"{path}: entry {number}"
        missing = [key for key in KEYS if not isinstance(entry, dict) or key not in entry]
        if missing:
            raise DataError(f"{place}: no {', '.join(missing)}; expected a dict with {KEYS}")
        frame_id = str(entry["frame_id"])
        if frame_id in found:
            raise DataError(f"{place}: frame {frame_id} occurs twice")
        place = f"{place} (frame {frame_id})"
        detections = as_detections(place, entry["boxes_lidar"], entry["score"], entry["name"])
        _check_version(place, detections.boxes, entry.get("dimensions"))
        found[frame_id] = detections
    return found


def _check_version(place: str, boxes: np.ndarray, dimensions: Any) -> None:
    """Raise DataError if boxes_lidar begin with the width, as before OpenPCDet 0.3.

    For KITTI, an entry has the same boxes in the camera frame, where `dimensions` is always (n, 3)
    length, height, width.
    """
    try:
        lengths = np.array(dimensions, dtype=np.float64)[:, 0]
        is_new, is_old = (np.allclose(lengths, boxes[:, column], atol=0.01) for column in (3, 4))
    except (IndexError, OverflowError, TypeError, ValueError):
        return
    if is_old and not is_new:
        raise DataError(
            f"{place}: boxes_lidar begin with the width, as in OpenPCDet before 0.3, where yaw and "
            "z also differ; convert them to centre, length, width, height, yaw"
        )
