"""Checks of the calibrated camera of a frame, for `curate doctor`."""

import numpy as np

from curate.evaluation.examination import Finding
from curate.frames import Frame
from curate.geometry.ground import GroundMap
from curate.geometry.mounting import Mounting, defines_headings

# The height of the sensors is measured on the ground this near, by the points up to this height
# above the lowest ones.
_NEAR_METRES, _GROUND_METRES = 15.0, 0.3
# A principal point is near the middle of the image. If it is off by the first factor on both axes,
# the image may have another scale than the calibration; the second factor leaves no doubt.
_SCALE_LIMIT, _CERTAIN_SCALE = 1.2, 1.4
_RESIZED = "was the image resized, but not the calibration's projection?"


def examine_camera(frame: Frame) -> list[Finding]:
    """Describe the mounting of each camera, and check that calibration and image fit.

    Args:
        frame: a frame with all its points.
    """
    return [
        finding
        for view in frame.views()
        for finding in (_mounting(view), _scale(view, view.cameras[0].image_size))
    ]


def _mounting(frame: Frame) -> Finding:
    """Describe how the camera is mounted, and how high the sensors are above the ground."""
    found = Mounting.of(frame.calibration)
    angles = np.rad2deg([found.yaw_rad, found.pitch_rad, found.roll_rad]) + 0.0
    yaw, pitch, roll = (f"{angle:.1f}" for angle in angles)
    message = f"yaw {yaw}, pitch {pitch}, roll {roll} degrees against the LiDAR"
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


def _scale(frame: Frame, image_size: tuple[int, int]) -> Finding:
    """Compare the principal point with the middle of the image."""
    width, height = image_size
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
