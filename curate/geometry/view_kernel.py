"""Compiled kernel that tests which points are inside the image of a camera."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def points_in_view(
    x: np.ndarray,
    y: np.ndarray,
    z: np.ndarray,
    matrix: np.ndarray,
    width: float,
    height: float,
    margin: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each point is in view, and whether rounding leaves it undecided.

    The kernel of `in_view`. It has no branches, because the result is too irregular for branch
    prediction.

    Args:
        x: (n,) metres in the LiDAR frame.
        y: (n,) metres in the LiDAR frame.
        z: (n,) metres in the LiDAR frame.
        matrix: (3, 4) projection from the LiDAR frame to homogeneous image points.
        width: width of the image in pixels.
        height: height of the image in pixels.
        margin: points closer than this to the border of the view are undecided.

    Returns:
        (n,) bool in view, false if undecided, and (n,) bool undecided.
    """
    visible = np.empty(len(x), np.bool_)
    undecided = np.empty(len(x), np.bool_)
    m00, m01, m02, m03 = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]
    m10, m11, m12, m13 = matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]
    m20, m21, m22, m23 = matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]
    for i in range(len(x)):
        px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
        u = m00 * px + m01 * py + m02 * pz + m03
        v = m10 * px + m11 * py + m12 * pz + m13
        depth = m20 * px + m21 * py + m22 * pz + m23
        right, below = width * depth - u, height * depth - v
        inside = (
            (depth > margin) & (u > margin) & (v > margin) & (right > margin) & (below > margin)
        )
        outside = (
            (depth < -margin)
            | (u < -margin)
            | (v < -margin)
            | (right < -margin)
            | (below < -margin)
        )
        visible[i] = inside
        undecided[i] = not (inside | outside)  # NaN too
    return visible, undecided
