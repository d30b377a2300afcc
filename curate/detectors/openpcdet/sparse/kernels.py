"""Compiled kernels of the sparse convolution, for the CPU.

`rulebook.py` has a version in torch of each of them, for other devices.
Keys are those of `Sites`: sorted, and with free cells at the end of each row, so that a neighbour
outside the grid has a key that no site has.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def pairs_at_distances(
    keys: np.ndarray, distances: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pairs of keys that lie each distance apart.

    Both members of the pairs of a distance ascend, so each list takes one pass with two fingers:

        keys 3 5 6 9, distance 3    3 finds 6, 5 passes 6 and stops at 9, 6 finds 9, 9 finds none

    Args:
        keys: (n,) int64, ascending, without repetition.
        distances: (d,) int64, positive.

    Returns:
        (p,) int64 rows of the lower keys and of the higher keys, in the order of the distances, and
        (d + 1,) int64 where the pairs of each distance start.
    """
    count = len(keys)
    low = np.empty(count * len(distances), np.int64)
    high = np.empty(count * len(distances), np.int64)
    starts = np.zeros(len(distances) + 1, np.int64)
    found = 0
    for k in range(len(distances)):
        distance, j = distances[k], 0
        for i in range(count):
            wanted = keys[i] + distance
            while j < count and keys[j] < wanted:
                j += 1
            if j == count:
                break
            if keys[j] == wanted:
                low[found], high[found] = i, j
                found += 1
        starts[k + 1] = found
    return low[:found].copy(), high[:found].copy(), starts


@njit(cache=True, nogil=True)
def strided_pairs(
    places: np.ndarray, geometry: np.ndarray, pitches: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the outputs of a strided convolution that each input contributes to.

    Args:
        places: (n, 4) int64 frame, z, y, x of the inputs, in the order of their keys.
        geometry: (4, 3) int64 kernel, stride, padding and size of the output grid along z, y, x.
        pitches: (4,) int64 steps of an output key along frame, z, y, x.

    Returns:
        (p,) int64 rows of the inputs and keys of the outputs, in the order of the kernel's cells,
        and (cells + 1,) int64 where the pairs of each cell start.
    """
    kernel, stride, padding, shape = geometry
    cells = kernel[0] * kernel[1] * kernel[2]
    inputs = np.empty(len(places) * cells, np.int64)
    outputs = np.empty(len(places) * cells, np.int64)
    starts = np.zeros(cells + 1, np.int64)
    found = 0
    cell = np.empty(3, np.int64)
    for k in range(cells):
        cell[0], cell[1] = k // (kernel[1] * kernel[2]), k // kernel[2] % kernel[1]
        cell[2] = k % kernel[2]
        for i in range(len(places)):
            key, inside = places[i, 0] * pitches[0], True
            for axis in range(3):
                shifted = places[i, axis + 1] + padding[axis] - cell[axis]
                place = shifted // stride[axis]
                if shifted % stride[axis] != 0 or place < 0 or place >= shape[axis]:
                    inside = False
                    break
                key += place * pitches[axis + 1]
            if inside:
                inputs[found], outputs[found] = i, key
                found += 1
        starts[k + 1] = found
    return inputs[:found].copy(), outputs[:found].copy(), starts
