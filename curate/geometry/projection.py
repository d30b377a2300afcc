"""Projection from the LiDAR frame into the image (KITTI: Geiger et al., IJRR 2013, eq. 8)."""

import numpy as np

from curate.frames import Calibration
from curate.geometry.boxes import box_corners
from curate.shapes import Bool, Float, Num

# Depth of the near plane. Parts of a box in front of it are cut off, because the projection is
# unbounded as the depth approaches 0.
_NEAR_METRES = 0.1

# Points closer than this to the border of the view, relative to the terms of their projection, are
# computed again with NumPy, so that the result does not depend on the rounding of the kernel.
_UNDECIDED = 1e-10

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


def image_rectangles(
    boxes: Num[np.ndarray, "n 7"], calibration: Calibration, image_size: tuple[int, int]
) -> Float[np.ndarray, "n 4"]:
    """Return the 2D boxes of 3D boxes: the rectangle around each projected box, within the image.

    A box that reaches behind the camera is cut at the near plane.

    Args:
        boxes: (n, 7) in the LiDAR frame.
        calibration: calibration of the frame.
        image_size: (width, height) in pixels.

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
    last_pixel = np.asarray(image_size) - 1.0
    rectangles = np.hstack([np.clip(low, 0, last_pixel), np.clip(high, 0, last_pixel)])
    rectangles[~((high > 0) & (low < last_pixel)).all(axis=1)] = np.nan
    return rectangles


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
