"""Comparison of the headings of detections with those of the ground truth, for `curate doctor`.

Points cannot show which end of a box is its front, and hardly whether the yaw of boxes along a
straight street is negated.
"""

from collections.abc import Callable, Sequence

import numpy as np

from curate.detections import Annotations, Detections
from curate.evaluation.examination import Finding
from curate.geometry.similarity import wrap_angle

_NEAR_METRES = 1.0
_MIN_PAIRS = 10
# The headings are wrong if another convention at least halves a mean difference above this one.
_MIN_DIFFERENCE = np.radians(3)
_HALVED = 0.5

_CONVENTIONS: tuple[tuple[str, Callable[[np.ndarray], np.ndarray]], ...] = (
    ("yaw + pi (the front is the rear)", lambda yaws: yaws + np.pi),
    ("-yaw (it grows clockwise)", lambda yaws: -yaws),
    ("pi - yaw", lambda yaws: np.pi - yaws),
    ("yaw + pi/2", lambda yaws: yaws + np.pi / 2),
    ("yaw - pi/2", lambda yaws: yaws - np.pi / 2),
    ("-yaw - pi/2 (it is KITTI's rotation_y)", lambda yaws: -yaws - np.pi / 2),
)


def examine_headings(pairs: Sequence[tuple[Detections, Annotations]]) -> list[Finding]:
    """Compare the yaw of detections with that of the nearest object of the same category.

    Args:
        pairs: detections and ground truth of some frames.

    Returns:
        One finding; none if there are too few pairs to decide.
    """
    found = np.concatenate([np.zeros((0, 2)), *(_paired_yaws(*each) for each in pairs)])
    if len(found) < _MIN_PAIRS:
        return []
    yaws, true = found.T
    difference = _mean_difference(yaws, true)
    summary = f"{len(found)} boxes differ from the heading of a labeled object by"
    best, name = min((_mean_difference(change(yaws), true), name) for name, change in _CONVENTIONS)
    if difference > _MIN_DIFFERENCE and best < _HALVED * difference:
        message = (
            f"{summary} {np.degrees(difference):.0f} degrees, and by {np.degrees(best):.0f} "
            f"degrees if their yaw is {name}"
        )
        return [Finding("headings", "wrong", message)]
    return [Finding("headings", "ok", f"{summary} {np.degrees(difference):.0f} degrees (mean)")]


def _paired_yaws(found: Detections, truth: Annotations) -> np.ndarray:
    """Return (n, 2) yaws of detections and of the objects at the same place."""
    objects = truth.select(~np.isnan(truth.boxes).any(axis=1))
    distances = np.linalg.norm(
        found.boxes[:, None, :2].astype(np.float64) - objects.boxes[None, :, :2], axis=2
    )
    distances[found.categories[:, None] != objects.categories[None, :]] = np.inf
    rows = np.flatnonzero(distances.min(axis=1, initial=np.inf) < _NEAR_METRES)
    if not len(rows):
        return np.zeros((0, 2))
    return np.column_stack([found.boxes[rows, 6], objects.boxes[distances[rows].argmin(axis=1), 6]])


def _mean_difference(yaws: np.ndarray, true: np.ndarray) -> float:
    return float(np.abs(wrap_angle(yaws - true)).mean())
