"""Pseudo-labels of ST3D and MS3D (ps_label_e0.pkl) as recorded detections.

Source: Yang et al., "ST3D", CVPR 2021, and Tsai et al., "MS3D", RA-L 2023, with their code
(github.com/CVMI-Lab/ST3D, github.com/darrenjkt/MS3D). The file is a dict by frame id:

    gt_boxes        (n, 9) x, y, z of the box centre, length, width, height, yaw in the LiDAR frame,
                    category from 1 in the order of CLASS_NAMES, and score; (n, 8) without score
    cls_scores      (n,) or None: the scores if gt_boxes has none
    iou_scores      (n,) or None: the detector's own estimate of the IoU
    memory_counter  (n,) ignored

A negative category marks a box in the band of doubt, which the trainer ignores. ST3D writes -1
whatever the class was, ST3D++ and curate's export `st3d` write -category. No file says which, so
such boxes are left out unless `ignored = "keep"` declares the second form.

Boxes that were predicted with SHIFT_COOR in the data set configuration are shifted by it.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from curate.detections import Detections
from curate.detectors.recorded.results import ReadOptions, ResultsByFrame, as_detections
from curate.errors import ConfigError, DataError, one_line
from curate.warnings_once import warn_once

_BOXES = "gt_boxes"


def holds_pseudo_labels(content: Any) -> bool:
    """Return whether the content of a pickle looks like a file of pseudo-labels."""
    first = next(iter(content.values()), None) if isinstance(content, Mapping) else None
    return isinstance(first, Mapping) and _BOXES in first


def read_st3d(path: Path, frames: Mapping[Any, Any], options: ReadOptions) -> ResultsByFrame:
    """Return the detections of each frame.

    Args:
        path: the file, for messages.
        frames: the content of the file.
        options: `classes` for the categories; `ignored` and `shift`.

    Raises:
        ConfigError: if the classes are missing.
        DataError: if a frame has no boxes, or an invalid value.
    """
    if not options.classes:
        raise ConfigError(
            f"{path}: categories are numbers: set detector.options.classes in the order of "
            'CLASS_NAMES, e.g. classes = ["Car", "Pedestrian", "Cyclist"]'
        )
    found: dict[str, Detections] = {}
    dropped = 0
    for frame_id, frame in frames.items():
        place = f"{path}: frame {str(frame_id)[:80]}"
        if not isinstance(frame, Mapping) or _BOXES not in frame:
            raise DataError(f"{place}: expected a dict with {_BOXES}")
        if str(frame_id) in found:
            raise DataError(f"{place}: occurs twice, as a number and as text")
        found[str(frame_id)], ignored = _detections(place, frame, options)
        dropped += ignored
    if dropped:
        total = dropped + sum(map(len, found.values()))
        warn_once(
            f"{path}: {dropped} of {total} boxes have a negative category, ST3D's band of doubt; "
            "they are left out. If -2 means the second class, set detector.options.ignored = "
            '"keep"'
        )
    return found


def _detections(
    place: str, frame: Mapping[str, Any], options: ReadOptions
) -> tuple[Detections, int]:
    """Return the detections of a frame, and the number of ignored boxes that were left out."""
    try:
        rows = np.array(frame[_BOXES], dtype=np.float64)
    except (OverflowError, TypeError, ValueError) as error:
        raise DataError(f"{place}: {_BOXES} must be numbers: {one_line(error, 200)}") from None
    if rows.size == 0:
        return Detections.empty(), 0
    if rows.ndim != 2 or rows.shape[1] not in {8, 9}:
        raise DataError(
            f"{place}: {_BOXES} {list(rows.shape)}; expected [n, 9]: box, category, score"
        )
    scores = rows[:, 8] if rows.shape[1] == 9 else frame.get("cls_scores")
    if scores is None:
        raise DataError(f"{place}: has neither a ninth column of scores nor cls_scores")
    labels = rows[:, 7]
    count = len(options.classes)
    valid = (np.abs(labels) >= 1) & (np.abs(labels) <= count) & (labels == np.floor(labels))
    if not valid.all():
        raise DataError(
            f"{place}: category {labels[~valid][0]:g}, but detector.options.classes lists {count} "
            f"classes, 1 to {count}"
        )
    names = [options.classes[int(abs(label)) - 1] for label in labels]
    boxes = rows[:, :7].copy()
    boxes[:, :3] -= options.shift
    detections = as_detections(place, boxes, scores, names)
    detections = _with_ious(place, detections, frame.get("iou_scores"))
    kept = labels > 0 if options.ignored == "drop" else np.ones(len(labels), dtype=bool)
    return detections.select(kept), int((~kept).sum())


def _with_ious(place: str, found: Detections, ious: Any) -> Detections:
    """Return detections with the detector's estimates of the IoU, if there are any."""
    if ious is None:
        return found
    try:
        values = np.array(ious, dtype=np.float64).reshape(-1)
    except (OverflowError, TypeError, ValueError):
        values = np.zeros(0)
    if len(values) != len(found) or not ((values >= 0) & (values <= 1)).all():
        raise DataError(f"{place}: iou_scores are not {len(found)} numbers from 0 to 1")
    return Detections(found.boxes, found.scores, found.categories, values)
