"""Ray casting of all pixels with less than half of the rays.

Pixels with even row and column (A) are cast first. Another pixel (.) gets no ray of its own if its
neighbours A hit the same triangle; it takes that triangle and their mean distance. The remaining
pixels are cast in a second step:

    A . A . A
    . . . . .
    A . A . A

Parts of objects that are thinner than two pixels may be missed, as in any image without
anti-aliasing.
"""

import numpy as np
from numba import njit

from curate.simulation.rig import IMAGE_SIZE, CameraRig
from curate.simulation.scene import Caster, Hits

_STEP = 2
_UNDECIDED = -2
_WIDTH, _HEIGHT = IMAGE_SIZE
_GRID = (np.arange(0, _HEIGHT, _STEP)[:, None] * _WIDTH + np.arange(0, _WIDTH, _STEP)).ravel()


def cast_pixels(caster: Caster, rig: CameraRig) -> Hits:
    """Return the first hit of each pixel's ray, in row-major order."""
    distance = np.empty(_WIDTH * _HEIGHT, dtype=np.float32)
    triangle = np.full(_WIDTH * _HEIGHT, _UNDECIDED, dtype=np.int32)
    coarse = caster.first_hits(rig.rays(_GRID))
    distance[_GRID], triangle[_GRID] = coarse.distance, coarse.triangle
    _fill_between(distance.reshape(_HEIGHT, _WIDTH), triangle.reshape(_HEIGHT, _WIDTH))
    rest = np.flatnonzero(triangle == _UNDECIDED)
    fine = caster.first_hits(rig.rays(rest))
    distance[rest], triangle[rest] = fine.distance, fine.triangle
    return Hits(distance, triangle)


@njit(cache=True, nogil=True)
def _fill_between(distance: np.ndarray, triangle: np.ndarray) -> None:
    """Fill each pixel between equal neighbours with their triangle and their mean distance."""
    height, width = triangle.shape
    for row in range(height):
        above, below = row - row % 2, row + row % 2
        for column in range(width):
            left, right = column - column % 2, column + column % 2
            if (above == below and left == right) or below >= height or right >= width:
                continue
            first = triangle[above, left]
            same = first == triangle[above, right]
            same &= first == triangle[below, left]
            same &= first == triangle[below, right]
            if same:
                triangle[row, column] = first
                distance[row, column] = (
                    distance[above, left]
                    + distance[above, right]
                    + distance[below, left]
                    + distance[below, right]
                ) / 4
