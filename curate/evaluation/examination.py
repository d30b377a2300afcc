"""Checks of a frame's data, of its labels and of a detector's boxes, for `curate doctor`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.detections import Annotations, Detections
from curate.evaluation.box_conventions import BoxesInSweep, suspect_convention
from curate.frames import Frame
from curate.geometry.ground import GroundMap
from curate.geometry.mounting import Mounting, defines_headings
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.projection import box_rectangles, image_rectangles, in_camera_view

_TOP_BOXES = 20
# The height of the sensors is measured on the ground this near, by the points up to this height
# above the lowest ones.
_NEAR_METRES, _GROUND_METRES = 15.0, 0.3
# A principal point is near the middle of the image. If it is off by the first factor on both axes,
# the image may have another scale than the calibration; the second factor leaves no doubt.
_SCALE_LIMIT, _CERTAIN_SCALE = 1.2, 1.4
# Shares of boxes without points that are suspect. Labels of KITTI and of simulated frames have
# 1 in 70 or less.
_EMPTY_SHARE, _EMPTY_LABELS_SHARE = 0.5, 0.25
# 2D boxes of labels may exceed the image by rounding; smaller ones say little about the scale.
_BORDER_PIXELS, _MIN_HEIGHT_PIXELS = 2.0, 10.0
_MIN_RECTANGLES = 3
_RECTANGLE_LIMIT = 1.25
_RESIZED = "was the image resized, but not the calibration's projection?"
# Share of boxes outside the image above which they are reported: some are cut by its border.
_OUTSIDE_LIMIT = 0.1


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
        *(finding for view in frame.views() for finding in (_mounting(view), _scale(view))),
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
    return Finding("boxes", "suspect" if empty > _EMPTY_SHARE * len(found) else "ok", summary)


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
    top = found.select(np.argsort(-found.scores, kind="stable")[:_TOP_BOXES])
    sweep = BoxesInSweep(frame.points, top.boxes, top.categories, frame.calibration)
    where = f"the {len(top)} boxes with the highest scores"
    return _judged("convention", [sweep], where, labels=False)


def _judged(check: str, sweeps: Sequence[BoxesInSweep], where: str, *, labels: bool) -> Finding:
    """Return the finding on the convention of boxes."""
    found = suspect_convention(sweeps, labels=labels)
    summary = f"{found.inside} points in {where}"
    if found.mistake:
        state = "wrong" if found.certain else "suspect"
        return Finding(check, state, f"{summary}; {found.mistake}")
    if found.undecided:
        state = "ok" if labels else "suspect"
        return Finding(check, state, f"{summary}: too few to decide; try another frame")
    return Finding(check, "ok", f"{summary}; no other convention explains them better")


def examine_labels(labeled: Sequence[tuple[Frame, Annotations]]) -> list[Finding]:
    """Check the ground truth of some frames together.

    Args:
        labeled: frames with all their points, and their ground truth.
    """
    sweeps = []
    for frame, truth in labeled:
        objects = truth.select(~np.isnan(truth.boxes).any(axis=1))
        sweeps.append(
            BoxesInSweep(frame.points, objects.boxes, objects.categories, frame.calibration)
        )
    count = sum(len(each.boxes) for each in sweeps)
    names = f"{len(labeled)} frames" if len(labeled) > 1 else f"frame {labeled[0][0].frame_id}"
    where = f"the {count} labeled boxes of {names}"
    # With several cameras, 2D boxes are projections.
    pictured = [(frame, truth) for frame, truth in labeled if len(frame.cameras) == 1]
    if count == 0:
        return [Finding("labels", "ok", f"no labeled objects in {names}")]
    return [
        _label_points(sweeps, count, names),
        _judged("label boxes", sweeps, where, labels=True),
        *([_label_rectangles(pictured)] if pictured else []),
    ]


def _label_points(sweeps: Sequence[BoxesInSweep], count: int, names: str) -> Finding:
    empty = sum(int(np.sum(count_points_in_boxes(each.points, each.boxes) == 0)) for each in sweeps)
    summary = f"{empty} of {count} labeled boxes contain no points ({names})"
    if empty == count:
        return Finding("labels", "wrong", f"{summary}: do labels and calibration belong together?")
    suspect = empty > max(1, _EMPTY_LABELS_SHARE * count)
    return Finding("labels", "suspect" if suspect else "ok", summary)


def _label_rectangles(labeled: Sequence[tuple[Frame, Annotations]]) -> Finding:
    """Compare the 2D boxes of labels with the image and with the projected 3D boxes."""
    ratios: list[float] = []
    for frame, truth in labeled:
        size = np.asarray(frame.image_size)
        reach = truth.boxes_2d[:, 2:].max(axis=0, initial=0)
        if (reach > size + _BORDER_PIXELS).any():
            message = (
                f"frame {frame.frame_id}: 2D boxes reach x {reach[0]:.0f}, y {reach[1]:.0f}, the "
                f"image is {size[0]} x {size[1]}: was it resized after it was labeled?"
            )
            return Finding("label image", "wrong", message)
        ratios += _height_ratios(frame, truth)
    if len(ratios) < _MIN_RECTANGLES:
        return Finding("label image", "ok", "2D boxes lie within the image")
    ratio = float(np.median(ratios))
    summary = f"2D boxes are {ratio:.2f} times as high as the projected 3D boxes (median)"
    if max(ratio, 1 / ratio) > _RECTANGLE_LIMIT:
        return Finding(
            "label image", "suspect", f"{summary}: do labels and calibration belong to this image?"
        )
    return Finding("label image", "ok", summary)


def _height_ratios(frame: Frame, truth: Annotations) -> list[float]:
    """Return height of the 2D box / height of the projected 3D box, of objects with both."""
    objects = truth.select(~np.isnan(truth.boxes).any(axis=1) & (truth.truncated <= 0))
    if len(np.unique(objects.boxes_2d, axis=0)) < len(objects):
        return []  # placeholders of a data set without 2D boxes
    rectangles = image_rectangles(objects.boxes, frame.calibration, frame.image_size)
    heights = np.nan_to_num(rectangles[:, 3] - rectangles[:, 1])
    labeled = objects.boxes_2d[:, 3] - objects.boxes_2d[:, 1]
    both = (heights > _MIN_HEIGHT_PIXELS) & (labeled > _MIN_HEIGHT_PIXELS)
    found: list[float] = (labeled[both] / heights[both]).tolist()
    return found


def _mounting(frame: Frame) -> Finding:
    """Describe how the camera of a view is mounted, and how high the sensors are."""
    found = Mounting.of(frame.calibration)
    angles = np.rad2deg([found.yaw_rad, found.pitch_rad, found.roll_rad]) + 0.0
    yaw, pitch, roll = (f"{angle:.1f}" for angle in angles)
    name = f"{frame.camera}: " if frame.camera else ""
    message = f"{name}yaw {yaw}, pitch {pitch}, roll {roll} degrees against the LiDAR"
    ground = _ground_height(frame.points)
    if np.isfinite(ground):
        camera = np.linalg.inv(frame.calibration.lidar_to_camera)[2, 3]
        message += f"; {camera - ground:.2f} m above the ground, the LiDAR {-ground:.2f} m"
    else:
        message += "; no ground found near it"
    if not defines_headings(frame.calibration):
        return Finding("camera", "suspect", f"{message}: KITTI's rotation_y is undefined under it")
    return Finding("camera", "ok", message)


def _ground_height(points: np.ndarray) -> float:
    """Return z of the ground around the LiDAR, the median of the lowest points; NaN if none."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < _NEAR_METRES]
    heights = GroundMap.of(near).lowered(near)[:, 2]
    ground = near[heights < _GROUND_METRES, 2]
    return float(np.median(ground)) if len(ground) else np.nan


def _scale(frame: Frame) -> Finding:
    """Compare the principal point of a view with the middle of its image."""
    width, height = frame.cameras[0].image_size
    projection = frame.calibration.projection
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = (projection[:2, 2] / projection[2, 2]).tolist()
    summary = f"principal point ({x:.0f}, {y:.0f}) in an image of {width} x {height}"
    factors = np.array([x / (width / 2), y / (height / 2)])
    larger = float(factors.min())
    smaller = float(1 / np.maximum(factors.max(), 1e-9))
    off = max(larger, smaller)
    inside = ((factors > 0) & (factors < 2)).all()
    if off < _SCALE_LIMIT and inside:
        return Finding("scale", "ok", summary)
    state = "wrong" if off > _CERTAIN_SCALE else "suspect"
    middle = f"expected near ({width / 2:.0f}, {height / 2:.0f})"
    return Finding("scale", state, f"{summary}, {middle}: {_RESIZED}")
