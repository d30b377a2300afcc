"""What is wrong with the data of a frame, or with the convention of a detector's boxes on it.

Each usual mistake in the convention of boxes is tried: the boxes are read as it would have them,
and where they gain more points than right boxes would, against those that they lose, it is named.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from curate.detections import Detections
from curate.frames import Calibration, Frame
from curate.geometry.points_in_boxes import count_points_in_boxes, points_in_box_mask
from curate.geometry.projection import image_rectangles, in_view
from curate.geometry.similarity import wrap_angle

# A suspect gains some points and loses others. On 24 KITTI frames, for a weak detector's boxes in
# the right convention, the ratio stayed below these limits; in the wrong one it was above the first
# in all frames, above the second in nine of ten, above the third in three of four (the ground under
# a car speaks for lowering it), above the last in about a third.
_TURNED_LIMIT, _RAISED_LIMIT, _LOWERED_LIMIT, _NEGATED_LIMIT = 1.0, 0.75, 2.25, 2.5
_CERTAIN = 1.3
# Added to both, so that a handful of points is no ratio.
_DOUBT = 3
_FEWEST_POINTS = 20
# A near box alone must not decide.
_MOST_PER_BOX = 100
_SURE_BOXES = 20

_Reading = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Finding:
    """What one check says.

    Attributes:
        check: its name.
        state: "ok", "suspect" (may be right) or "wrong".
        message: one line.
    """

    check: str
    state: str
    message: str


def examine_frame(frame: Frame) -> list[Finding]:
    """Check of points, calibration and image.

    Args:
        frame: with all its points.
    """
    count = len(frame.points)
    if count == 0:
        return [Finding("points", "wrong", "the sweep holds no points")]
    low, high = frame.points[:, :3].min(axis=0), frame.points[:, :3].max(axis=0)
    ranges = ", ".join(
        f"{axis} {a:.1f}..{b:.1f}" for axis, a, b in zip("xyz", low, high, strict=True)
    )
    tall = np.ptp(frame.points[:, 2]) > max(np.ptp(frame.points[:, 0]), np.ptp(frame.points[:, 1]))
    bright = float(frame.points[:, 3].max())
    seen = float(in_view(frame.points, frame.calibration, frame.image_size).mean())
    return [
        Finding("points", "ok", f"{count} points, {ranges} m")
        if not tall
        else Finding("points", "suspect", f"higher than wide ({ranges} m): is z up?"),
        Finding("intensity", "ok", f"up to {bright:.2f}")
        if 0 < bright <= 1
        else Finding("intensity", "suspect", f"up to {bright:.2f}: expected in [0, 1], not all 0"),
        Finding("calibration", "ok", f"{seen:.0%} of the points appear in the image")
        if seen > 0.02
        else Finding(
            "calibration", "wrong", f"{seen:.1%} of the points appear in the image: is x forward, "
            "and does the calibration belong to these sensors?",
        ),
    ]  # fmt: skip


def examine_detections(frame: Frame, found: Detections, categories: Sequence[str]) -> list[Finding]:
    """Check of a detector's answer.

    Args:
        frame: with the points that the detector saw.
        found: all that it answers, before names and scores are sorted out.
        categories: that the workspace asks for.
    """
    if len(found) == 0:
        return [Finding("detections", "suspect", "the detector finds nothing in this frame")]
    low, high = found.scores.min(), found.scores.max()
    return [
        Finding("detections", "ok", f"{len(found)} boxes, scores {low:.2f} to {high:.2f}"),
        _names(found, categories),
        _points(frame, found),
        _projections(frame, found),
        _convention(frame, found),
    ]


def _names(found: Detections, categories: Sequence[str]) -> Finding:
    names, counts = np.unique(found.categories, return_counts=True)
    told = ", ".join(f"{name} {n}" for name, n in zip(names, counts.tolist(), strict=True))
    unknown = sorted(set(names.tolist()) - set(categories))
    if len(unknown) == len(names):
        wanted = ", ".join(categories)
        return Finding("names", "wrong", f"{told}: none is in dataset.categories ({wanted})")
    if unknown:
        return Finding("names", "suspect", f"{told}: {', '.join(unknown)} will be left out")
    return Finding("names", "ok", told)


def _points(frame: Frame, found: Detections) -> Finding:
    empty = int(np.sum(count_points_in_boxes(frame.points, found.boxes) == 0))
    told = f"{empty} of {len(found)} boxes hold no points"
    if empty == len(found):
        return Finding("boxes", "wrong", f"{told}: they are not in the frame of the points")
    return Finding("boxes", "suspect" if empty > len(found) / 2 else "ok", told)


def _projections(frame: Frame, found: Detections) -> Finding:
    rectangles = image_rectangles(found.boxes, frame.calibration, frame.image_size)
    outside = int(np.isnan(rectangles).any(axis=1).sum())
    told = f"{outside} of {len(found)} boxes project outside the image"
    if outside == len(found):
        return Finding("image", "wrong", told)
    return Finding("image", "suspect" if outside > len(found) / 2 else "ok", told)


def _convention(frame: Frame, found: Detections) -> Finding:
    """The suspect that explains the points best, where it does so as no right boxes let it."""
    sure = found.boxes[np.argsort(-found.scores, kind="stable")[:_SURE_BOXES]]
    held = sum(int(_inside(frame.points, box).sum()) for box in sure)
    told = f"{held} points in the {len(sure)} surest boxes"
    best, likely = "", 0.0
    for what, (read, limit) in _suspects(frame.calibration).items():
        gained, lost = _exchanged(frame.points, sure, read(sure))
        ratio = (gained + _DOUBT) / (lost + _DOUBT) / limit
        if gained >= _FEWEST_POINTS and ratio > max(likely, 1):
            best, likely = f"{told}; {gained} more and {lost} fewer if {what}", ratio
    if best:
        return Finding("convention", "wrong" if likely > _CERTAIN else "suspect", best)
    if held < _FEWEST_POINTS:
        return Finding("convention", "suspect", f"{told}: too few to tell; try another frame")
    return Finding("convention", "ok", f"{told}; no other convention explains them better")


def _exchanged(points: np.ndarray, boxes: np.ndarray, others: np.ndarray) -> tuple[int, int]:
    """Points that only the other reading of boxes holds, and those that only this one holds."""
    gained = lost = 0
    for box, other in zip(boxes, others, strict=True):
        this, that = _inside(points, box), _inside(points, other)
        gained += min(int((that & ~this).sum()), _MOST_PER_BOX)
        lost += min(int((this & ~that).sum()), _MOST_PER_BOX)
    return gained, lost


def _inside(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(p,) whether points lie in the upper four fifths of a box: the ground under it does not."""
    upper = box + np.array([0, 0, 0.1 * box[5], 0, 0, -0.2 * box[5], 0])
    return points_in_box_mask(points, upper)


def _suspects(calibration: Calibration) -> Mapping[str, tuple[_Reading, float]]:
    """Readings of boxes, and their limits, by what would be the case if they were right."""
    to_lidar = np.linalg.inv(calibration.lidar_to_camera)

    def turned(boxes: np.ndarray) -> np.ndarray:
        return _with(boxes, yaw=boxes[:, 6] + np.pi / 2)

    def mirrored(boxes: np.ndarray) -> np.ndarray:
        return _with(boxes, yaw=-boxes[:, 6])

    def rotation_y(boxes: np.ndarray) -> np.ndarray:
        return _with(boxes, yaw=-boxes[:, 6] - np.pi / 2)

    def raised(boxes: np.ndarray) -> np.ndarray:
        return _with(boxes, centres=boxes[:, :3] + np.outer(boxes[:, 5] / 2, [0, 0, 1]))

    def lowered(boxes: np.ndarray) -> np.ndarray:
        return _with(boxes, centres=boxes[:, :3] - np.outer(boxes[:, 5] / 2, [0, 0, 1]))

    def from_camera(boxes: np.ndarray) -> np.ndarray:
        centres = boxes[:, :3] - np.outer(boxes[:, 5] / 2, [0, 1, 0])
        return _with(rotation_y(boxes), centres=centres @ to_lidar[:3, :3].T + to_lidar[:3, 3])

    return {
        "turned by 90 degrees: yaw counts from y, or length and width are swapped": (
            turned,
            _TURNED_LIMIT,
        ),
        "yaw is negated: it grows clockwise": (mirrored, _NEGATED_LIMIT),
        "yaw is KITTI's rotation_y: ours is -rotation_y - pi/2": (rotation_y, _TURNED_LIMIT),
        "raised by half their height: z is that of the bottom": (raised, _RAISED_LIMIT),
        "lowered by half their height: their centre was taken for where they stand": (
            lowered,
            _LOWERED_LIMIT,
        ),
        "taken from the camera's frame of reference, as in KITTI's label files": (
            from_camera,
            _TURNED_LIMIT,
        ),
    }


def _with(
    boxes: np.ndarray, yaw: np.ndarray | None = None, centres: np.ndarray | None = None
) -> np.ndarray:
    """Return the boxes with another yaw or other centres."""
    changed = boxes.copy()
    if yaw is not None:
        changed[:, 6] = wrap_angle(yaw)
    if centres is not None:
        changed[:, :3] = centres
    return changed
