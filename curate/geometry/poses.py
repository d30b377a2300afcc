"""Rigid poses from quaternions, and boxes in a frame of reference that is turned in all three axes.

Quaternions are (w, x, y, z), scalar first, of unit length.
"""

import numpy as np

from curate.geometry.similarity import wrap_angle
from curate.shapes import Float, Num


def rotation_matrices(quaternions: Num[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Return (n, 3, 3) rotations of (n, 4) unit quaternions w, x, y, z."""
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
    """(4, 4) from the frame of reference that stands at `translation`, turned by `quaternion`."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrices(np.reshape(quaternion, (1, 4)))[0]
    pose[:3, 3] = translation
    return pose


def invert_pose(pose: Num[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Inverse of a (4, 4) rigid pose."""
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
    """Boxes of an outer frame of reference (a map's) in the one that stands at `pose` (a LiDAR's).

    A box keeps its yaw about the inner z: the direction of its length, seen from above. What it is
    tilted besides, a few degrees where the ground or the sensor is, has no place in seven numbers.

    Args:
        centres: (n, 3) in the outer frame, metres.
        sizes: (n, 3) length, width, height.
        quaternions: (n, 4) w, x, y, z in the outer frame.
        pose: (4, 4) inner frame to outer frame.

    Returns:
        (n, 7) x, y, z, length, width, height, yaw in the inner frame.
    """
    inverse = invert_pose(pose)
    ahead = rotation_matrices(quaternions)[:, :, 0] @ inverse[:3, :3].T
    return np.column_stack(
        [
            np.reshape(centres, (-1, 3)) @ inverse[:3, :3].T + inverse[:3, 3],
            np.reshape(sizes, (-1, 3)),
            wrap_angle(np.arctan2(ahead[:, 1], ahead[:, 0])),
        ]
    )
