"""What a camera sees of ground truth that has no 2D boxes."""

from collections.abc import Sequence

import numpy as np

from curate.detections import Annotations
from curate.frames import Calibration, Camera
from curate.geometry.mounting import observation_angles
from curate.geometry.projection import camera_of_boxes, image_rectangles

# Margin around the image for truncation, in image widths and heights. It bounds the 2D box of an
# object that is partly behind the camera.
_MARGIN = 10


def seen_objects(
    boxes: np.ndarray, categories: np.ndarray, occluded: np.ndarray, cameras: Sequence[Camera]
) -> Annotations:
    """Return the objects that any of the cameras sees, in their order.

    An object's truncation, alpha and 2D box are those in the camera that shows most of it.

    Args:
        boxes: (n, 7) in the LiDAR frame.
        categories: (n,) str.
        occluded: (n,) int64, KITTI's occlusion levels.
        cameras: the cameras of the frame, at least one.
    """
    truncated, alpha = np.ones(len(boxes)), np.zeros(len(boxes))
    rectangles = np.full((len(boxes), 4), np.nan)
    shown_by = camera_of_boxes(boxes, cameras)
    for number, camera in enumerate(cameras):
        shown = shown_by == number
        calibration, size = camera.calibration, camera.image_size
        rectangles[shown] = image_rectangles(boxes[shown], calibration, size)
        truncated[shown] = truncation(boxes[shown], rectangles[shown], calibration, size)
        alpha[shown] = observation_angles(boxes[shown], calibration)
    objects = Annotations(boxes, categories, truncated, occluded, alpha, rectangles)
    return objects.select(shown_by >= 0)


def truncation(
    boxes: np.ndarray, rectangles: np.ndarray, calibration: Calibration, size: tuple[int, int]
) -> np.ndarray:
    """Return (n,) the fraction of each projected box outside the image; 1 if nothing is inside.

    The full 2D box is the projection into a larger image, with a margin on all sides. For example,
    a 2D box of 100 x 50 pixels of which 40 x 50 lie in the image has truncation 0.6.

    Args:
        boxes: (n, 7) in the LiDAR frame.
        rectangles: (n, 4) projected boxes, clipped to the image.
        calibration: calibration of the frame.
        size: (width, height) of the image in pixels.
    """
    margin = np.array(size) * _MARGIN
    shift = np.eye(3)
    shift[:2, 2] = margin
    wider = Calibration(shift @ calibration.projection, calibration.lidar_to_camera)
    width, height = (np.array(size) + 2 * margin).tolist()
    full = image_rectangles(boxes, wider, (width, height))
    inside = _areas(rectangles) / np.maximum(_areas(full), 1e-9)
    outside: np.ndarray = np.clip(1 - np.nan_to_num(inside), 0, 1)
    return outside


def _areas(rectangles: np.ndarray) -> np.ndarray:
    """Return (n,) areas in pixels of left, top, right, bottom."""
    areas: np.ndarray = np.prod(rectangles[:, 2:] - rectangles[:, :2], axis=1)
    return areas
