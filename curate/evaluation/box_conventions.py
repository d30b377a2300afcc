"""Detection of a wrong convention of boxes, from the LiDAR points in them and from their sizes.

The boxes are converted as each common mistake would require. If the converted boxes contain more
LiDAR points than can be expected of correct boxes, compared with the points that they lose, the
mistake is reported. Boxes of cars that are wider than long need no points.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from curate.frames import Calibration, RotationY
from curate.geometry.mounting import (
    Mounting,
    bottom_centres_in_camera,
    defines_headings,
    rotations_y_of_yaws,
    yaws_of_rotations_y,
)
from curate.geometry.points_in_boxes import points_in_box_mask
from curate.geometry.similarity import wrap_angle
from curate.shapes import Float, Num, Shaped

# Limits of the ratio gained points / lost points, above which a conversion is reported. Measured on
# 24 KITTI frames with the boxes of a weak detector: in the correct convention the ratio stayed
# below these limits; in a wrong one it exceeded the first limit in all frames, the second in 90 %,
# the third in 75 % (lowered boxes gain points of the ground), and the last in about a third. The
# ground truth of these frames and of 24 simulated ones stayed below half of the last three.
_TURNED_LIMIT, _RAISED_LIMIT, _LOWERED_LIMIT, _NEGATED_LIMIT = 1.0, 0.75, 2.25, 2.5
# Points cannot show a smaller turn of a box, in radians.
_VISIBLE_TURN = np.radians(3)
# At this multiple of the limit the mistake is certain.
_CERTAIN = 1.3
# Added to gained and lost points, because the ratio of a few points is noise.
_PRIOR_POINTS = 3
_MIN_POINTS = 20
# Limits the influence of a single near box.
_MAX_POINTS_PER_BOX = 100
# Objects of these categories are longer than wide.
_LONG_CATEGORIES = frozenset(
    {"car", "van", "truck", "bus", "tram", "vehicle", "cyclist", "bicycle", "motorcycle"}
)
# Objects of these categories are higher than wide.
_HIGH_CATEGORIES = frozenset({"pedestrian", "person", "cyclist", "bicycle", "motorcycle"})
# Sizes that would be swapped, categories, and the indices in (length, width, height) of the size
# that is larger in a median object of these categories, and of the smaller one.
_EXPECTED_SIZES = (
    ("length and width", _LONG_CATEGORIES, 0, 1),
    ("height and width", _HIGH_CATEGORIES, 2, 1),
    ("height and length", frozenset({"pedestrian", "person"}), 2, 0),
)
_SWAPPED_RATIO = 1.1
_LEAST_CAMERA_YAW_RAD = np.deg2rad(5)

_Conversion = Callable[[np.ndarray, Calibration], np.ndarray]


@dataclass(frozen=True)
class _Mistake:
    """A common mistake.

    Attributes:
        change: what would correct the boxes.
        cause: what is probably wrong with boxes of a detector.
        convert: returns the corrected boxes.
        limit: of the ratio of gained and lost points.
        label_cause: what is probably wrong with labels; the same if empty.
        of: "labels" or "results" if only these are examined for it.
    """

    change: str
    cause: str
    convert: _Conversion
    limit: float
    label_cause: str = ""
    of: str = ""


@dataclass(frozen=True)
class BoxesInSweep:
    """Boxes of one sweep.

    Attributes:
        points: the points of the sweep in the LiDAR frame.
        boxes: (n, 7) in the LiDAR frame, in the convention to examine.
        categories: (n,) category names.
        calibration: calibration of the frame.
    """

    points: Num[np.ndarray, "p _"]
    boxes: Float[np.ndarray, "n 7"]
    categories: Shaped[np.ndarray, " n"]
    calibration: Calibration


@dataclass(frozen=True)
class Suspicion:
    """The mistake that explains points or sizes best.

    Attributes:
        mistake: the conversion that would correct it, in words; "" if there is none.
        certain: whether points or sizes leave no doubt.
        inside: points in the boxes, without those at their bottom.
    """

    mistake: str
    certain: bool
    inside: int

    @property
    def undecided(self) -> bool:
        """Whether the boxes contain too few points to decide."""
        return not self.mistake and self.inside < _MIN_POINTS


def suspect_convention(sweeps: Sequence[BoxesInSweep], *, labels: bool) -> Suspicion:
    """Return the mistake in the convention of all boxes together.

    Args:
        sweeps: the boxes.
        labels: whether they are labels, not boxes of a detector; for the words.
    """
    inside = sum(int(_inside(each.points, box).sum()) for each in sweeps for box in each.boxes)
    swapped = _swapped_sizes(sweeps)
    if swapped:
        return Suspicion(swapped, certain=True, inside=inside)
    best, best_ratio = "", 0.0
    for mistake in _MISTAKES:
        if mistake.of not in ("", "labels" if labels else "results"):
            continue
        exchanged = [
            _exchanged(each.points, each.boxes, mistake.convert(each.boxes, each.calibration))
            for each in sweeps
        ]
        gained, lost = np.sum(exchanged, axis=0).tolist() if exchanged else (0, 0)
        ratio = (gained + _PRIOR_POINTS) / (lost + _PRIOR_POINTS) / mistake.limit
        if gained >= _MIN_POINTS and ratio > max(best_ratio, 1):
            cause = (labels and mistake.label_cause) or mistake.cause
            best = f"{gained} more and {lost} fewer if {mistake.change}: {cause}"
            best_ratio = ratio
    return Suspicion(best, certain=best_ratio > _CERTAIN, inside=inside)


def _swapped_sizes(sweeps: Sequence[BoxesInSweep]) -> str:
    """Return the finding for categories with sizes in another order, "" if there are none."""
    boxes = np.concatenate([each.boxes for each in sweeps]) if sweeps else np.zeros((0, 7))
    names = [name for each in sweeps for name in each.categories.tolist()]
    for pair, categories, larger, smaller in _EXPECTED_SIZES:
        chosen = np.array([name.casefold() in categories for name in names], dtype=bool)
        if not chosen.any():
            continue
        sizes = np.median(boxes[chosen, 3:6], axis=0)
        if sizes[smaller] >= _SWAPPED_RATIO * sizes[larger]:
            kinds = ", ".join(
                sorted({name for name, one in zip(names, chosen, strict=True) if one})
            )
            length, width, height = sizes
            return (
                f"{pair} are swapped: {kinds} boxes are {length:.1f} m long, {width:.1f} m wide "
                f"and {height:.1f} m high (median)"
            )
    return ""


def _exchanged(points: np.ndarray, boxes: np.ndarray, others: np.ndarray) -> tuple[int, int]:
    """Return how many points are only in `others` (gained) and only in `boxes` (lost)."""
    gained = lost = 0
    for box, other in zip(boxes, others, strict=True):
        before, after = _inside(points, box), _inside(points, other)
        gained += min(int((after & ~before).sum()), _MAX_POINTS_PER_BOX)
        lost += min(int((before & ~after).sum()), _MAX_POINTS_PER_BOX)
    return gained, lost


def _inside(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return (p,) bool, True for points in the upper four fifths of a box, without the ground."""
    upper = box + np.array([0, 0, 0.1 * box[5], 0, 0, -0.2 * box[5], 0])
    return points_in_box_mask(points, upper)


def _turned(boxes: np.ndarray, _calibration: Calibration) -> np.ndarray:
    return _with(boxes, yaw=boxes[:, 6] + np.pi / 2)


def _mirrored(boxes: np.ndarray, _calibration: Calibration) -> np.ndarray:
    return _with(boxes, yaw=-boxes[:, 6])


def _rotation_y(boxes: np.ndarray, _calibration: Calibration) -> np.ndarray:
    return _with(boxes, yaw=-boxes[:, 6] - np.pi / 2)


def _other_rotation_y(boxes: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Return the boxes as they are if rotation_y of their label file has the other meaning."""
    if not defines_headings(calibration):
        return boxes
    other: RotationY = "openpcdet" if calibration.rotation_y == "calibration" else "calibration"
    rotations_y = rotations_y_of_yaws(boxes[:, 6], calibration)
    yaws = yaws_of_rotations_y(rotations_y, calibration, other)
    if np.abs(wrap_angle(yaws - boxes[:, 6])).max(initial=0) < _VISIBLE_TURN:
        return boxes
    return _with(boxes, yaw=yaws)


def _turned_camera(boxes: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Return what `_other_rotation_y` does, but boxes as they are if the camera looks forward.

    The boxes of a detector are not precise enough to show a difference of a degree.
    """
    if abs(Mounting.of(calibration).yaw_rad) < _LEAST_CAMERA_YAW_RAD:
        return boxes
    return _other_rotation_y(boxes, calibration)


def _raised(boxes: np.ndarray, _calibration: Calibration) -> np.ndarray:
    return _with(boxes, centres=boxes[:, :3] + np.outer(boxes[:, 5] / 2, [0, 0, 1]))


def _lowered(boxes: np.ndarray, _calibration: Calibration) -> np.ndarray:
    return _with(boxes, centres=boxes[:, :3] - np.outer(boxes[:, 5] / 2, [0, 0, 1]))


def _from_camera(boxes: np.ndarray, calibration: Calibration) -> np.ndarray:
    to_lidar = np.linalg.inv(calibration.lidar_to_camera)
    centres = boxes[:, :3] @ to_lidar[:3, :3].T + to_lidar[:3, 3]
    centres[:, 2] += boxes[:, 5] / 2
    return _with(_rotation_y(boxes, calibration), centres=centres)


def _from_lidar(boxes: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Return the boxes with the numbers of their file as centre and yaw in the LiDAR frame."""
    if not defines_headings(calibration):
        return boxes
    return _with(
        boxes,
        yaw=rotations_y_of_yaws(boxes[:, 6], calibration),
        centres=bottom_centres_in_camera(boxes, calibration),
    )


_MISTAKES = (
    _Mistake(
        "turned by the yaw of the camera",
        "rotation_y has another meaning, set dataset.options.rotation_y",
        _other_rotation_y, _TURNED_LIMIT, of="labels",
    ),
    _Mistake(
        "turned by the yaw of the camera",
        "rotation_y of KITTI's result files has another meaning, set detector.options.rotation_y",
        _turned_camera, _TURNED_LIMIT, of="results",
    ),
    _Mistake(
        "turned by 90 degrees", "yaw is measured from y, or length and width are swapped",
        _turned, _TURNED_LIMIT,
    ),
    _Mistake(
        "their yaw is negated",
        "seen from above, yaw must grow counter-clockwise, and KITTI's rotation_y clockwise",
        _mirrored, _NEGATED_LIMIT,
    ),
    _Mistake(
        "their yaw is converted",
        "KITTI's rotation_y stands for the yaw in the LiDAR frame, which is -rotation_y - pi/2, or "
        "the other way round",
        _rotation_y, _TURNED_LIMIT,
    ),
    _Mistake(
        "raised by half their height", "z is the bottom of the box, not its centre",
        _raised, _RAISED_LIMIT,
        "their location is too low; in KITTI's files it is the bottom of the box",
    ),
    _Mistake(
        "lowered by half their height",
        "z is the top of the box, not its centre (location in KITTI's files: the centre, not the "
        "bottom)",
        _lowered, _LOWERED_LIMIT,
        "their location is the centre of the box; in KITTI's files it is the bottom",
    ),
    _Mistake(
        "converted from the camera frame", "their numbers are those of KITTI's label files",
        _from_camera, _TURNED_LIMIT,
    ),
    _Mistake(
        "read in the LiDAR frame",
        "location and rotation_y of their files are in the LiDAR frame; in KITTI's files they are "
        "in the camera frame",
        _from_lidar, _TURNED_LIMIT,
    ),
)  # fmt: skip


def _with(
    boxes: np.ndarray, yaw: np.ndarray | None = None, centres: np.ndarray | None = None
) -> np.ndarray:
    """Return a copy of the boxes with another yaw or other centres."""
    changed = boxes.copy()
    if yaw is not None:
        changed[:, 6] = wrap_angle(yaw)
    if centres is not None:
        changed[:, :3] = centres
    return changed
