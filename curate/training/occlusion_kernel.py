"""Compiled kernel of the object bank: which points of a scene an object would hide."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def hide_behind(
    view: np.ndarray, visible: np.ndarray, outline: np.ndarray, most_in_front: float
) -> bool:
    """Hide the points behind an object; return False, and hide none, if the object is hidden.

    Args:
        view: (3, n) float32 azimuth in radians, slope, and horizontal distance in metres.
        visible: (n,) bool, changed in place.
        outline: (6,) lowest and highest azimuth, lowest and highest slope, distance of the object,
            and the slope above which a point in front of it is not ground.
        most_in_front: the object is hidden if more points than this are in front of it.
    """
    azimuths, slopes, distances = view
    behind = np.empty(len(visible), np.int64)
    number, in_front = 0, 0
    for i in range(len(visible)):
        if not (visible[i] and outline[0] <= azimuths[i] <= outline[1]):
            continue
        if not outline[2] <= slopes[i] <= outline[3]:
            continue
        if not distances[i] < outline[4]:
            behind[number] = i
            number += 1
        elif slopes[i] > outline[5]:
            in_front += 1
    if in_front > most_in_front:
        return False
    for j in range(number):
        visible[behind[j]] = False
    return True
