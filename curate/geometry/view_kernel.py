"""Compiled kernel: which points appear in the image of a camera."""

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
    """Return the kernel of `in_view`: (n,) bool, and (n,) whether it leaves a point undecided.

    It has no branches: which points are seen is too irregular to be foretold.
    """
    seen = np.empty(len(x), np.bool_)
    doubtful = np.empty(len(x), np.bool_)
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
        seen[i] = inside
        doubtful[i] = not (inside | outside)  # NaN too
    return seen, doubtful
