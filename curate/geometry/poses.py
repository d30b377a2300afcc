"""Rigid poses from quaternions, and transforms of boxes between frames with any 3D rotation.

Quaternions are (w, x, y, z), scalar first, of unit length.
"""

import numpy as np

from curate.geometry.similarity import wrap_angle
from curate.shapes import Float, Num


def rotation_matrices(quaternions: Num[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Return (n, 3, 3) rotation matrices of (n, 4) unit quaternions w, x, y, z."""
    w, x, y, z = np.asarray(quaternions, dtype=np.float64).reshape(-1, 4).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


def pose_matrix(
    translation: Num[np.ndarray, " 3"], quaternion: Num[np.ndarray, " 4"]
) -> Float[np.ndarray, "4 4"]:
    """Return the (4, 4) pose of an inner frame of reference: it maps inner to outer coordinates.

    Args:
        translation: (3,) origin of the inner frame in the outer frame, metres.
        quaternion: (4,) rotation w, x, y, z of the inner frame in the outer frame.
    """
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrices(np.reshape(quaternion, (1, 4)))[0]
    pose[:3, 3] = translation
    return pose


def invert_pose(pose: Num[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the inverse of a (4, 4) rigid pose."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def boxes_in_frame(
    centres: Num[np.ndarray, "n 3"],
    sizes: Num[np.ndarray, "n 3"],
    quaternions: Num[np.ndarray, "n 4"],
    pose: Num[np.ndarray, "4 4"],
) -> Float[np.ndarray, "n 7"]:
    """Return boxes of an outer frame of reference, such as a map, in an inner one, such as a LiDAR.

    The yaw is the direction of the box's length about the inner z axis. A remaining tilt of a few
    degrees, from sloped ground or a tilted sensor, is dropped: seven numbers cannot store it.

    Args:
        centres: (n, 3) in the outer frame, metres.
        sizes: (n, 3) length, width, height.
        quaternions: (n, 4) w, x, y, z in the outer frame.
        pose: (4, 4) inner frame to outer frame.

    Returns:
        (n, 7) x, y, z, length, width, height, yaw in the inner frame.
    """
    inverse = invert_pose(pose)
    heading = rotation_matrices(quaternions)[:, :, 0] @ inverse[:3, :3].T
    return np.column_stack(
        [
            np.reshape(centres, (-1, 3)) @ inverse[:3, :3].T + inverse[:3, 3],
            np.reshape(sizes, (-1, 3)),
            wrap_angle(np.arctan2(heading[:, 1], heading[:, 0])),
        ]
    )
