"""Checks of a frame's data and of the conventions of a detector's boxes, for `curate doctor`.

To find a wrong box convention, the boxes are converted as each common mistake would require. If the
converted boxes contain more LiDAR points than can be expected of correct boxes, compared with the
points that they lose, the mistake is reported.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from curate.detections import Detections
from curate.frames import Calibration, Frame
from curate.geometry.points_in_boxes import count_points_in_boxes, points_in_box_mask
from curate.geometry.projection import box_rectangles, in_camera_view
from curate.geometry.similarity import wrap_angle

# Limits of the ratio gained points / lost points, above which a conversion is reported. Measured on
# 24 KITTI frames with the boxes of a weak detector: in the correct convention the ratio stayed
# below these limits; in a wrong one it exceeded the first limit in all frames, the second in 90 %,
# the third in 75 % (lowered boxes gain points of the ground), and the last in about a third.
_TURNED_LIMIT, _RAISED_LIMIT, _LOWERED_LIMIT, _NEGATED_LIMIT = 1.0, 0.75, 2.25, 2.5
# At this multiple of the limit the finding is "wrong", not only "suspect".
_CERTAIN = 1.3
# Added to gained and lost points, because the ratio of a few points is noise.
_PRIOR_POINTS = 3
_MIN_POINTS = 20
# Limits the influence of a single near box.
_MAX_POINTS_PER_BOX = 100
_TOP_BOXES = 20
# Share of boxes outside the image above which they are reported: some are cut by its border.
_OUTSIDE_LIMIT = 0.1

_Conversion = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        check: name of the check.
        state: "ok", "suspect" (may be correct) or "wrong".
        message: one line.
    """

    check: str
    state: str
    message: str


def examine_frame(frame: Frame) -> list[Finding]:
    """Check the points, the calibration and the image of a frame.

    Args:
        frame: a frame with all its points.
    """
    count = len(frame.points)
    if count == 0:
        return [Finding("points", "wrong", "the sweep has no points")]
    low, high = frame.points[:, :3].min(axis=0), frame.points[:, :3].max(axis=0)
    ranges = ", ".join(
        f"{axis} {a:.1f}..{b:.1f}" for axis, a, b in zip("xyz", low, high, strict=True)
    )
    tall = np.ptp(frame.points[:, 2]) > max(np.ptp(frame.points[:, 0]), np.ptp(frame.points[:, 1]))
    intensity = float(frame.points[:, 3].max())
    seen = float(in_camera_view(frame).mean())
    return [
        Finding("points", "ok", f"{count} points, {ranges} m")
        if not tall
        else Finding("points", "suspect", f"higher than wide ({ranges} m): is z up?"),
        Finding("intensity", "ok", f"up to {intensity:.2f}")
        if 0 < intensity <= 1
        else Finding(
            "intensity", "suspect", f"up to {intensity:.2f}: expected in [0, 1], not all 0"
        ),
        Finding("camera", "ok", "none: nothing is compared with images")
        if not frame.cameras
        else Finding("calibration", "ok", f"{seen:.0%} of the points appear in the image")
        if seen > 0.02
        else Finding(
            "calibration", "wrong", f"{seen:.1%} of the points appear in the image: is x forward, "
            "and does the calibration belong to these sensors?",
        ),
    ]  # fmt: skip


def examine_detections(frame: Frame, found: Detections, categories: Sequence[str]) -> list[Finding]:
    """Check the output of a detector.

    Args:
        frame: the frame with the points that the detector was given.
        found: the complete output, before it is filtered by category and score.
        categories: the configured categories of the workspace.
    """
    if len(found) == 0:
        return [Finding("detections", "suspect", "the detector finds nothing in this frame")]
    low, high = found.scores.min(), found.scores.max()
    return [
        Finding("detections", "ok", f"{len(found)} boxes, scores {low:.2f} to {high:.2f}"),
        _names(found, categories),
        _points(frame, found),
        *([_projections(frame, found)] if frame.cameras else []),
        _convention(frame, found),
    ]


def _names(found: Detections, categories: Sequence[str]) -> Finding:
    names, counts = np.unique(found.categories, return_counts=True)
    summary = ", ".join(f"{name} {n}" for name, n in zip(names, counts.tolist(), strict=True))
    unknown = sorted(set(names.tolist()) - set(categories))
    if len(unknown) == len(names):
        expected = ", ".join(categories)
        return Finding("names", "wrong", f"{summary}: none is in dataset.categories ({expected})")
    if unknown:
        return Finding("names", "suspect", f"{summary}: {', '.join(unknown)} will be dropped")
    return Finding("names", "ok", summary)


def _points(frame: Frame, found: Detections) -> Finding:
    empty = int(np.sum(count_points_in_boxes(frame.points, found.boxes) == 0))
    summary = f"{empty} of {len(found)} boxes contain no points"
    if empty == len(found):
        return Finding("boxes", "wrong", f"{summary}: they are not in the LiDAR frame")
    return Finding("boxes", "suspect" if empty > len(found) / 2 else "ok", summary)


def _projections(frame: Frame, found: Detections) -> Finding:
    rectangles = box_rectangles(found.boxes, frame)
    outside = int(np.isnan(rectangles).any(axis=1).sum())
    summary = f"{outside} of {len(found)} boxes project outside the image"
    if outside == len(found):
        return Finding("image", "wrong", summary)
    if outside > _OUTSIDE_LIMIT * len(found):
        evidence = "no image evidence can confirm or refute them (semantic.outside)"
        return Finding("image", "suspect", f"{summary}: {evidence}")
    return Finding("image", "ok", summary)


def _convention(frame: Frame, found: Detections) -> Finding:
    """Return the mistake that explains the points best, if its ratio is above its limit."""
    top = found.boxes[np.argsort(-found.scores, kind="stable")[:_TOP_BOXES]]
    inside = sum(int(_inside(frame.points, box).sum()) for box in top)
    summary = f"{inside} points in the {len(top)} boxes with the highest scores"
    best, best_ratio = "", 0.0
    for mistake, (convert, limit) in _conversions(frame.calibration).items():
        gained, lost = _exchanged(frame.points, top, convert(top))
        ratio = (gained + _PRIOR_POINTS) / (lost + _PRIOR_POINTS) / limit
        if gained >= _MIN_POINTS and ratio > max(best_ratio, 1):
            best, best_ratio = f"{summary}; {gained} more and {lost} fewer if {mistake}", ratio
    if best:
        return Finding("convention", "wrong" if best_ratio > _CERTAIN else "suspect", best)
    if inside < _MIN_POINTS:
        return Finding("convention", "suspect", f"{summary}: too few to decide; try another frame")
    return Finding("convention", "ok", f"{summary}; no other convention explains them better")


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


def _conversions(calibration: Calibration) -> Mapping[str, tuple[_Conversion, float]]:
    """Return the conversion that corrects each common mistake, and its limit."""
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
        "turned by 90 degrees: yaw is measured from y, or length and width are swapped": (
            turned,
            _TURNED_LIMIT,
        ),
        "yaw is negated: it grows clockwise": (mirrored, _NEGATED_LIMIT),
        "yaw is KITTI's rotation_y, but must be -rotation_y - pi/2": (rotation_y, _TURNED_LIMIT),
        "raised by half their height: z is the bottom of the box, not its centre": (
            raised,
            _RAISED_LIMIT,
        ),
        "lowered by half their height: z is the top of the box, not its centre": (
            lowered,
            _LOWERED_LIMIT,
        ),
        "converted from the camera frame, as in KITTI's label files": (
            from_camera,
            _TURNED_LIMIT,
        ),
    }


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
