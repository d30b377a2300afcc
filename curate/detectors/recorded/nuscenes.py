"""nuScenes' results of the detection task: boxes in the frame of a map, by sample token.

Source: nuScenes' detection task (nuscenes.org). A JSON object with `meta` and `results`, of which
the latter maps each sample token to a list of boxes: translation (centre), size (width, length,
height), rotation (w, x, y, z), detection_name, detection_score; velocity and attribute_name are
left out. The well-known mistakes are refused by name: sizes in another order, a quaternion that
begins with x, boxes in the LiDAR's frame of reference.
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
# Whose length exceeds the width, whatever the detector.
_LONG = ("car", "truck", "bus", "trailer", "bicycle", "motorcycle")
# So many boxes, and so many of them wider than long, are no accident.
_FEWEST_LONG, _MOST_WIDE = 10, 0.9
# No box stands so far from upright, as the cosine of the angle; a misread quaternion does.
_UPRIGHT = 0.7
_UNIT_SLACK = 0.01
# No LiDAR sees so far, metres; vehicles are hundreds of metres from their map's origin.
_FARTHEST = 200.0
# Metres; further products of numbers stay finite.
_LARGEST = 1e7


@dataclass(frozen=True)
class MapBoxes:
    """The boxes of one frame in the frame of a map, waiting for the LiDAR's pose.

    Attributes:
        place: file and frame, for messages.
        numbers: (n, 11) translation, size (width, length, height), rotation (w, x, y, z), score.
        names: (n,) names of the task's classes.
    """

    place: str
    numbers: np.ndarray
    names: Sequence[str]

    def in_lidar(self, calibration: Calibration) -> Detections:
        """Return the boxes in the LiDAR's frame of reference, under our categories.

        Raises:
            DataError: if they are not where the vehicle is, or no detector can have answered them.
            ConfigError: if the data set has no poses.
        """
        centres, sizes, turns = self.numbers[:, :3], self.numbers[:, 3:6], self.numbers[:, 6:10]
        pose = calibration.pose_in_map()
        away = np.linalg.norm(centres - pose[:3, 3], axis=1)
        if len(away) and away.min() > _FARTHEST:
            place = np.round(centres[0], 1).tolist()
            near = np.linalg.norm(centres, axis=1).max() < _FARTHEST
            guess = "they are in the frame of the LiDAR or vehicle" if near else "is it their frame"
            raise DataError(
                f"{self.place}: boxes such as {place} are {away.min():.0f} m and more from the "
                f"vehicle, which is at {np.round(pose[:2, 3], 1).tolist()} in the map; results are "
                f"in the frame of the map: {guess}?"
            )
        boxes = boxes_in_frame(centres, sizes[:, [1, 0, 2]], turns, pose)
        names = [CATEGORIES.get(name, name) for name in self.names]
        return as_detections(self.place, boxes, self.numbers[:, 10], as_categories(names))


def read_nuscenes(path: Path, results: Iterable[tuple[str, Any]]) -> Mapping[str, MapBoxes]:
    """Return the results of each frame; in memory are eleven numbers and a name per box.

    Args:
        path: the file, for messages.
        results: sample token and list of boxes of each frame, which are let go one by one.

    Raises:
        DataError: a result lacks a key or cannot be, or the file shows one of the usual mistakes.
    """
    found: dict[str, MapBoxes] = {}
    names: dict[str, str] = {}
    long = wide = 0
    for token, boxes in results:
        one = _frame(path, token, boxes, names)
        _check_rotations(one)
        own = one.numbers[np.isin(one.names, _LONG), 3:5]
        long += len(own)
        wide += int(np.sum(own[:, 0] > own[:, 1]))
        found[token] = one
    if long >= _FEWEST_LONG and wide > _MOST_WIDE * long:
        raise DataError(
            f"{path}: {wide} of {long} boxes of {', '.join(_LONG)} would be wider than long: "
            "nuScenes' size is width, length, height; swap the first two"
        )
    return found


def _frame(path: Path, token: str, boxes: Any, known: dict[str, str]) -> MapBoxes:
    """Return the boxes of a frame; a name that many of them have is kept once, in `known`."""
    place = f"{path}: results of {_words(token)}"
    if not isinstance(boxes, list):
        raise DataError(f"{place}: expected a list of boxes, not {type(boxes).__name__}")
    rows = [_row(f"{place}: box {k}", token, box) for k, box in enumerate(boxes)]
    names = [known.setdefault(box["detection_name"], box["detection_name"]) for box in boxes]
    return MapBoxes(place, np.array(rows, dtype=np.float64).reshape(-1, _NUMBERS), names)


def _row(place: str, token: str, box: Any) -> list[float]:
    """Return the eleven numbers of a box."""
    missing = [key for key in _KEYS if not isinstance(box, Mapping) or key not in box]
    if missing:
        raise DataError(f"{place}: no {', '.join(missing)}; expected {', '.join(_KEYS)}")
    if box.get("sample_token", token) != token:
        other = _words(box["sample_token"])
        raise DataError(f"{place}: its sample_token is {other}, another frame's")
    if not isinstance(box["detection_name"], str):
        raise DataError(f"{place}: its detection_name is no text")
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


def _words(text: Any) -> str:
    """Return a foreign text as a message may repeat it."""
    return " ".join(text.split())[:80] if isinstance(text, str) else f"a {type(text).__name__}"


def _check_rotations(found: MapBoxes) -> None:
    """DataError at the first rotation that is no upright box's."""
    turns = found.numbers[:, 6:10]
    lengths = np.linalg.norm(turns, axis=1)
    if (np.abs(lengths - 1) > _UNIT_SLACK).any():
        k = int(np.argmax(np.abs(lengths - 1)))
        raise DataError(
            f"{found.place}: box {k}: rotation {turns[k].tolist()} is no unit quaternion "
            f"(w, x, y, z), its length is {lengths[k]:.3f}"
        )
    upright = rotation_matrices(turns)[:, 2, 2]
    if (upright < _UPRIGHT).any():
        k = int(np.argmin(upright))
        angle = np.degrees(np.arccos(np.clip(upright[k], -1, 1)))
        raise DataError(
            f"{found.place}: box {k} would be tilted by {angle:.0f} degrees: rotation "
            f"{turns[k].tolist()} must be w, x, y, z, not x, y, z, w"
        )
