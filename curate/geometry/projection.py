"""Projection from the LiDAR frame into the image (KITTI: Geiger et al., IJRR 2013, eq. 8)."""

from collections.abc import Sequence

import numpy as np

from curate.frames import Calibration, Camera, Frame
from curate.geometry.boxes import box_corners
from curate.shapes import Bool, Float, Int, Num

# Depth of the near plane. Parts of a box in front of it are cut off, because the projection is
# unbounded as the depth approaches 0.
_NEAR_METRES = 0.1

# Points closer than this to the border of the view, relative to the terms of their projection, are
# computed again with NumPy, so that the result does not depend on the rounding of the kernel.
_UNDECIDED = 1e-10

# Points along each side of a box, to measure how much of it is in an image.
_GRID = 8

# The twelve edges between the corners of `box_corners`: bottom, top, vertical.
_EDGE_STARTS = np.array([0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3])
_EDGE_ENDS = np.array([1, 2, 3, 0, 5, 6, 7, 4, 4, 5, 6, 7])


def project_points(
    points_lidar: Num[np.ndarray, "n _"], calibration: Calibration
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Return the image coordinates and the depth of points.

    Args:
        points_lidar: (n, >=3) x, y, z in metres in the LiDAR frame.
        calibration: calibration of the frame.

    Returns:
        (n, 2) pixels from the left and from the top, and (n,) depth along the optical axis in
        metres. Pixels of a point with a depth that is not positive are invalid (NaN at depth 0).
    """
    projected = _homogeneous(points_lidar[:, :3], calibration)
    depth = projected[:, 2]
    divisor = np.where(depth == 0, np.nan, depth)
    return projected[:, :2] / divisor[:, None], depth


def in_view(
    points: Num[np.ndarray, "n _"], calibration: Calibration, image_size: tuple[int, int]
) -> Bool[np.ndarray, " n"]:
    """Return whether each LiDAR point is in front of the camera and inside its image.

    Args:
        points: (n, >=3) x, y, z in metres in the LiDAR frame; further columns are ignored.
        calibration: calibration of the frame.
        image_size: (width, height) in pixels.
    """
    from curate.geometry.view_kernel import points_in_view

    width, height = image_size
    columns = np.asarray(points)
    matrix = calibration.lidar_to_image
    # One margin for all points, that of the farthest. A larger margin only costs time: more points
    # are computed again.
    reach = max(1.0, -columns.min(initial=0), columns.max(initial=0))
    margin = np.abs(matrix).sum() * _UNDECIDED * reach * max(width, height)
    # Separate arrays of x, y and z let the compiler vectorise the kernel.
    x, y, z = np.ascontiguousarray(columns[:, :3].T)
    visible, is_undecided = points_in_view(x, y, z, matrix, float(width), float(height), margin)
    undecided = np.flatnonzero(is_undecided)
    if len(undecided):
        pixels, depth = project_points(columns[undecided], calibration)
        inside = (pixels >= 0) & (pixels < np.asarray(image_size))
        visible[undecided] = inside.all(axis=1) & (depth > 0)
    return visible


def in_camera_view(frame: Frame) -> Bool[np.ndarray, " n"]:
    """Return whether any camera of the frame sees each of its points; all True without a camera."""
    if not frame.cameras:
        return np.ones(len(frame.points), dtype=bool)
    seen = [
        in_view(frame.points, camera.calibration, camera.image_size) for camera in frame.cameras
    ]
    visible: np.ndarray = np.logical_or.reduce(seen)
    return visible


def image_rectangles(
    boxes: Num[np.ndarray, "n 7"], calibration: Calibration, image_size: tuple[int, int] | None
) -> Float[np.ndarray, "n 4"]:
    """Return the 2D boxes of 3D boxes: the rectangle around each projected box, within the image.

    A box that reaches behind the camera is cut at the near plane.

    Args:
        boxes: (n, 7) in the LiDAR frame.
        calibration: calibration of the frame.
        image_size: (width, height) in pixels; None if there is no image: nothing is clipped.

    Returns:
        (n, 4) left, top, right, bottom in pixels, within [0, width - 1] and [0, height - 1]; NaN if
        the box is behind the camera or its rectangle outside the image.
    """
    corners = box_corners(boxes)
    projected = _homogeneous(corners.reshape(-1, 3), calibration).reshape(-1, 8, 3)
    outline = _clip_at_near_plane(projected)
    with np.errstate(invalid="ignore"):
        pixels = outline[..., :2] / outline[..., 2:]
    valid = ~np.isnan(pixels)
    low = np.min(pixels, axis=1, where=valid, initial=np.inf)
    high = np.max(pixels, axis=1, where=valid, initial=-np.inf)
    if image_size is None:
        return np.where(valid.any(axis=(1, 2))[:, None], np.hstack([low, high]), np.nan)
    last_pixel = np.asarray(image_size) - 1.0
    rectangles = np.hstack([np.clip(low, 0, last_pixel), np.clip(high, 0, last_pixel)])
    rectangles[~((high > 0) & (low < last_pixel)).all(axis=1)] = np.nan
    return rectangles


def camera_of_boxes(
    boxes: Num[np.ndarray, "n 7"], cameras: Sequence[Camera]
) -> Int[np.ndarray, " n"]:
    """Return (n,) int64 the number of the camera that shows most of each box; -1 if none shows it.

    That is the camera with the largest share of the box's volume in its image. If several have the
    same share, for example the whole box, it is the one with the larger rectangle in pixels.

    Args:
        boxes: (n, 7) in the LiDAR frame.
        cameras: the cameras of the frame.
    """
    chosen = np.full(len(boxes), -1, dtype=np.int64)
    best = np.full((2, len(boxes)), -1.0)
    for number, camera in enumerate(cameras):
        rectangles = image_rectangles(boxes, camera.calibration, camera.image_size)
        areas = np.prod(rectangles[:, 2:] - rectangles[:, :2], axis=1)
        # With a single camera, the shares need not be computed.
        shares = _shares_in_image(boxes, camera) if len(cameras) > 1 else np.ones(len(boxes))
        larger = (shares > best[0]) | ((shares == best[0]) & (areas > best[1]))
        better = ~np.isnan(areas) & larger
        chosen[better] = number
        best[:, better] = shares[better], areas[better]
    return chosen


def box_rectangles(boxes: Num[np.ndarray, "n 7"], frame: Frame) -> Float[np.ndarray, "n 4"]:
    """Return the rectangle of each box in the camera that shows most of it.

    Without a camera, it is the projection by the frame's calibration, without a border.

    Returns:
        (n, 4) left, top, right, bottom in pixels, see `image_rectangles`; NaN for boxes that no
        camera shows.
    """
    if len(frame.cameras) < 2:
        return image_rectangles(boxes, frame.calibration, frame.image_size)
    rectangles = np.full((len(boxes), 4), np.nan)
    chosen = camera_of_boxes(boxes, frame.cameras)
    for number, camera in enumerate(frame.cameras):
        shown = chosen == number
        rectangles[shown] = image_rectangles(boxes[shown], camera.calibration, camera.image_size)
    return rectangles


def _shares_in_image(boxes: np.ndarray, camera: Camera) -> np.ndarray:
    """Return (n,) the share of each box's volume in the image, by a regular grid of points."""
    steps = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    x, y, z = (grid * boxes[:, None, 3:6]).transpose(2, 0, 1)
    cos, sin = np.cos(boxes[:, 6:]), np.sin(boxes[:, 6:])
    places = np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1) + boxes[:, None, :3]
    inside = in_view(places.reshape(-1, 3), camera.calibration, camera.image_size)
    shares: np.ndarray = inside.reshape(len(boxes), -1).mean(axis=1)
    return shares


def _homogeneous(points_lidar: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Return (n, 3) homogeneous image points (u * depth, v * depth, depth)."""
    matrix = calibration.lidar_to_image
    points = np.asarray(points_lidar, dtype=np.float64)
    projected: np.ndarray = points @ matrix[:, :3].T + matrix[:, 3]
    return projected


def _clip_at_near_plane(corners: np.ndarray) -> np.ndarray:
    """Return the vertices of the boxes after clipping at the near plane.

    Args:
        corners: (n, 8, 3) homogeneous image points in the order of `box_corners`.

    Returns:
        (n, 20, 3): the 8 corners, and the intersections of the 12 edges with the near plane; NaN
        for corners with less depth than the plane and for edges that do not cross it.
    """
    starts, ends = corners[:, _EDGE_STARTS], corners[:, _EDGE_ENDS]
    depth_start, depth_end = starts[..., 2], ends[..., 2]
    crosses = (depth_start < _NEAR_METRES) != (depth_end < _NEAR_METRES)
    fraction = np.where(crosses, _NEAR_METRES - depth_start, np.nan)
    fraction = fraction / np.where(crosses, depth_end - depth_start, 1.0)
    intersections = starts + fraction[..., None] * (ends - starts)
    intersections[..., 2] = np.where(crosses, _NEAR_METRES, np.nan)
    visible = np.where((corners[..., 2] >= _NEAR_METRES)[..., None], corners, np.nan)
    return np.concatenate([visible, intersections], axis=1)
