"""OpenPCDet's result.pkl: a list with frame_id, name, score and boxes_lidar of each frame.

`boxes_lidar` is (n, 7): box centre, length, width, height, yaw counter-clockwise from x, in the
LiDAR frame, the convention of `Detections`; two further columns of velocities are ignored.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

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
        DataError: if an entry lacks a key or has invalid values, or a frame occurs twice.
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
        found[frame_id] = as_detections(place, entry["boxes_lidar"], entry["score"], entry["name"])
    return found
