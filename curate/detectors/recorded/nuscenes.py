"""Results of the nuScenes detection task: boxes in the map frame, by sample token.

Source: nuScenes detection task (nuscenes.org). The file is a JSON object with `meta` and `results`.
`results` maps each sample token to a list of boxes: translation (centre), size (width, length,
height), rotation (w, x, y, z), detection_name, detection_score; velocity and attribute_name are
ignored. Common mistakes get their own message: sizes in another order, a quaternion that begins
with x, boxes in the LiDAR frame.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curate.datasets.nuscenes.names import CATEGORIES
from curate.detections import Detections, as_categories
from curate.detectors.recorded.results import as_detections
from curate.errors import DataError
from curate.frames import Calibration
from curate.geometry.poses import boxes_in_frame, rotation_matrices

_KEYS = ("translation", "size", "rotation", "detection_name", "detection_score")
_NUMBERS = 11  # translation, size, rotation, score
# Classes with a length greater than the width in every detector's output.
_LONG_CLASSES = ("car", "truck", "bus", "trailer", "bicycle", "motorcycle")
# With this many boxes of long classes, and this share of them wider than long, the order of the
# sizes is wrong.
_MIN_LONG_BOXES, _MAX_WIDE_SHARE = 10, 0.9
# Minimum cosine of a box's tilt. A misread quaternion tilts boxes more than any real object.
_MIN_COS_TILT = 0.7
_UNIT_TOLERANCE = 0.01
# Metres: beyond the range of a LiDAR, but less than vehicles are from the origin of their map.
_MAX_RANGE = 200.0
# Metres; products of such numbers stay finite.
_LARGEST = 1e7


@dataclass(frozen=True)
class MapBoxes:
    """The boxes of one frame in the map frame; their conversion needs the LiDAR's pose.

    Attributes:
        place: file and frame, for messages.
        numbers: (n, 11) translation, size (width, length, height), rotation (w, x, y, z), score.
        names: (n,) class names of the detection task.
    """

    place: str
    numbers: np.ndarray
    names: Sequence[str]

    @property
    def categories(self) -> np.ndarray:
        """(n,) category names of the project."""
        return as_categories([CATEGORIES.get(name, name) for name in self.names])

    @property
    def scores(self) -> np.ndarray:
        """(n,) the scores of the boxes."""
        return self.numbers[:, 10]

    def in_lidar(self, calibration: Calibration) -> Detections:
        """Return the boxes in the LiDAR frame, with the category names of the project.

        Raises:
            DataError: if no box is near the vehicle, or a value is invalid.
            ConfigError: if the data set has no poses.
        """
        centres, sizes, rotations = self.numbers[:, :3], self.numbers[:, 3:6], self.numbers[:, 6:10]
        pose = calibration.pose_in_map()
        distance = np.linalg.norm(centres - pose[:3, 3], axis=1)
        if len(distance) and distance.min() > _MAX_RANGE:
            example = np.round(centres[0], 1).tolist()
            near_origin = np.linalg.norm(centres, axis=1).max() < _MAX_RANGE
            hint = (
                "are these in the LiDAR or vehicle frame?"
                if near_origin
                else "are these results of another frame?"
            )
            raise DataError(
                f"{self.place}: boxes such as {example} are {distance.min():.0f} m or more from "
                f"the vehicle, which is at {np.round(pose[:2, 3], 1).tolist()} in the map; results "
                f"must be in the map frame: {hint}"
            )
        boxes = boxes_in_frame(centres, sizes[:, [1, 0, 2]], rotations, pose)
        return as_detections(self.place, boxes, self.numbers[:, 10], self.categories)


def read_nuscenes(path: Path, results: Iterable[tuple[str, Any]]) -> Mapping[str, MapBoxes]:
    """Return the results of each frame; memory holds only eleven numbers and a name per box.

    Args:
        path: the file, for messages.
        results: sample token and list of boxes of each frame; read one by one.

    Raises:
        DataError: if a result lacks a key or has an invalid value, or the file shows one of the
            common mistakes.
    """
    found: dict[str, MapBoxes] = {}
    interned: dict[str, str] = {}
    long_boxes = wide_boxes = 0
    for token, boxes in results:
        if token in found:
            raise DataError(f"{path}: results of {_shortened(token)} occur twice; remove one")
        frame = _frame(path, token, boxes, interned)
        _check_rotations(frame)
        width_length = frame.numbers[np.isin(frame.names, _LONG_CLASSES), 3:5]
        long_boxes += len(width_length)
        wide_boxes += int(np.sum(width_length[:, 0] > width_length[:, 1]))
        found[token] = frame
    if long_boxes >= _MIN_LONG_BOXES and wide_boxes > _MAX_WIDE_SHARE * long_boxes:
        raise DataError(
            f"{path}: {wide_boxes} of {long_boxes} boxes of {', '.join(_LONG_CLASSES)} would be "
            "wider than long: the order of size is width, length, height; swap the first two"
        )
    return found


def _frame(path: Path, token: str, boxes: Any, interned: dict[str, str]) -> MapBoxes:
    """Return the boxes of a frame; equal names share one string, from `interned`."""
    place = f"{path}: results of {_shortened(token)}"
    if not isinstance(boxes, list):
        raise DataError(f"{place}: expected a list of boxes, not {type(boxes).__name__}")
    rows = [_row(f"{place}: box {k}", token, box) for k, box in enumerate(boxes)]
    names = [interned.setdefault(box["detection_name"], box["detection_name"]) for box in boxes]
    numbers = np.array(rows, dtype=np.float64).reshape(-1, _NUMBERS)
    _check_sizes(place, numbers)
    return MapBoxes(place, numbers, names)


def _check_sizes(place: str, numbers: np.ndarray) -> None:
    """Raise DataError if a width, length or height is not positive."""
    flat = (numbers[:, 3:6] <= 0).any(axis=1)
    if flat.any():
        k = int(np.argmax(flat))
        raise DataError(
            f"{place}: box {k}: length, width or height is not positive: its size is "
            f"{numbers[k, 3:6].tolist()}"
        )


def _row(place: str, token: str, box: Any) -> list[float]:
    """Return the eleven numbers of a box."""
    missing = [key for key in _KEYS if not isinstance(box, Mapping) or key not in box]
    if missing:
        raise DataError(f"{place}: no {', '.join(missing)}; expected {', '.join(_KEYS)}")
    if box.get("sample_token", token) != token:
        other = _shortened(box["sample_token"])
        raise DataError(
            f"{place}: its sample_token is {other}, but it is listed under {_shortened(token)}"
        )
    if not isinstance(box["detection_name"], str):
        raise DataError(f"{place}: its detection_name is not text")
    parts = [box[key] for key in ("translation", "size", "rotation")]
    lengths = [len(part) if isinstance(part, list) else 0 for part in parts]
    try:
        numbers = [float(number) for part in parts for number in part]
        numbers.append(float(box["detection_score"]))
    except (OverflowError, TypeError, ValueError):
        numbers = []
    if lengths != [3, 3, 4] or not (np.abs(numbers) <= _LARGEST).all() or len(numbers) != _NUMBERS:
        raise DataError(
            f"{place}: translation, size, rotation and detection_score are not 3, 3, 4 and 1 "
            "finite numbers"
        )
    return numbers


def _shortened(text: Any) -> str:
    """Return a text from the file, short enough for a message."""
    return " ".join(text.split())[:80] if isinstance(text, str) else f"a {type(text).__name__}"


def _check_rotations(found: MapBoxes) -> None:
    """Raise DataError if a rotation is not a unit quaternion or tilts its box too far."""
    rotations = found.numbers[:, 6:10]
    lengths = np.linalg.norm(rotations, axis=1)
    if (np.abs(lengths - 1) > _UNIT_TOLERANCE).any():
        k = int(np.argmax(np.abs(lengths - 1)))
        raise DataError(
            f"{found.place}: box {k}: rotation {rotations[k].tolist()} is not a unit quaternion "
            f"(w, x, y, z), its length is {lengths[k]:.3f}"
        )
    cos_tilt = rotation_matrices(rotations)[:, 2, 2]
    if (cos_tilt < _MIN_COS_TILT).any():
        k = int(np.argmin(cos_tilt))
        angle = np.degrees(np.arccos(np.clip(cos_tilt[k], -1, 1)))
        raise DataError(
            f"{found.place}: box {k} would be tilted by {angle:.0f} degrees: rotation "
            f"{rotations[k].tolist()} must be w, x, y, z, not x, y, z, w"
        )
