"""Boxes in KITTI's form, computed with scipy's rotations, and the formulas of other frameworks."""

import numpy as np
from scipy.spatial.transform import Rotation

# From a body (x forward, y left, z up) to a camera (x right, y down, z forward) that looks ahead.
LOOKING_AHEAD = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])


def mounted(yaw: float, pitch: float, roll: float) -> Rotation:
    """Return the rotation from LiDAR to camera of a camera turned by yaw, then pitch, then roll."""
    return LOOKING_AHEAD * Rotation.from_euler("ZYX", [yaw, pitch, roll]).inv()


def in_camera(
    boxes: np.ndarray, turn: Rotation, origin: np.ndarray, yaw: float, *, upside_down: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, 3) bottom centres in the camera frame and (n,) rotation_y.

    Args:
        boxes: (n, 7) in the LiDAR frame.
        turn: rotation from LiDAR to camera.
        origin: (3,) the LiDAR in the camera frame.
        yaw: azimuth of the optical axis.
        upside_down: whether the camera's y axis points up.
    """
    bottoms = turn.apply(boxes[:, :3] - boxes[:, 5:6] / 2 * np.array([0, 0, 1])) + origin
    ahead = boxes[:, 6] - yaw  # counter-clockwise from the optical axis
    return bottoms, (ahead if upside_down else -ahead) - np.pi / 2


def projected_rotations_y(boxes: np.ndarray, turn: Rotation) -> np.ndarray:
    """Return (n,) the angles of the headings in the camera's xz plane, as nuScenes exports them."""
    directions = turn.apply(
        np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), 0 * boxes[:, 6]])
    )
    return -np.arctan2(directions[:, 2], directions[:, 0])


def openpcdet_boxes(
    locations: np.ndarray, lengths_first: np.ndarray, rotations_y: np.ndarray, matrix: np.ndarray
) -> np.ndarray:
    """Return (n, 7) LiDAR boxes as OpenPCDet computes them from camera boxes.

    Args:
        locations: (n, 3) bottom centres.
        lengths_first: (n, 3) length, height, width.
        rotations_y: (n,) radians.
        matrix: (4, 4) R0_rect * Tr_velo_to_cam.
    """
    bottoms = (np.linalg.inv(matrix) @ np.column_stack([locations, np.ones(len(locations))]).T).T
    length, height, width = lengths_first.T
    bottoms[:, 2] += height / 2
    return np.column_stack([bottoms[:, :3], length, width, height, -(rotations_y + np.pi / 2)])


def mmdetection3d_boxes(camera_boxes: np.ndarray, lidar2cam: np.ndarray) -> np.ndarray:
    """Return (n, 7) LiDAR boxes at the bottom centre, as mmdetection3d converts camera boxes.

    Args:
        camera_boxes: (n, 7) x, y, z of the bottom centre, length, height, width, yaw.
        lidar2cam: (4, 4).
    """
    to_lidar = np.linalg.inv(lidar2cam)
    corners = np.column_stack([camera_boxes[:, :3], np.ones(len(camera_boxes))]) @ to_lidar.T
    yaw = -camera_boxes[:, 6] - np.pi / 2
    return np.column_stack([corners[:, :3], camera_boxes[:, [3, 5, 4]], yaw])
