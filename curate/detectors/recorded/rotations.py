"""Check of quaternions that were read from a file of results."""

import numpy as np

from curate.errors import DataError
from curate.geometry.poses import rotation_matrices

# Minimum cosine of a box's tilt. A misread quaternion tilts boxes more than any real object.
_MIN_COS_TILT = 0.7
_UNIT_TOLERANCE = 0.01


def check_rotations(place: str, rotations: np.ndarray) -> None:
    """Raise DataError if a rotation is not a unit quaternion or tilts its box too far.

    Args:
        place: file and frame, for messages.
        rotations: (n, 4) w, x, y, z.
    """
    lengths = np.linalg.norm(rotations, axis=1)
    wrong = ~(np.abs(lengths - 1) <= _UNIT_TOLERANCE)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DataError(
            f"{place}: box {k}: rotation {rotations[k].tolist()} is not a unit quaternion "
            f"(w, x, y, z), its length is {lengths[k]:.3f}"
        )
    cos_tilt = rotation_matrices(rotations)[:, 2, 2]
    if (cos_tilt < _MIN_COS_TILT).any():
        k = int(np.argmin(cos_tilt))
        angle = np.degrees(np.arccos(np.clip(cos_tilt[k], -1, 1)))
        raise DataError(
            f"{place}: box {k} would be tilted by {angle:.0f} degrees: rotation "
            f"{rotations[k].tolist()} must be w, x, y, z, not x, y, z, w"
        )
