"""Compiled kernels: points to voxels, and the voxels near the grid points of proposals."""

import numpy as np
from numba import njit

# Multiplier of the hash of a cell's number (Knuth, "The Art of Computer Programming", 6.4). The
# bits of the product from `_SHIFT` depend on all lower bits of the number.
_MULTIPLIER = 2654435761
_SHIFT = 12


@njit(cache=True, nogil=True)
def group_points(
    points: np.ndarray,
    limits: np.ndarray,
    size: np.ndarray,
    grid: np.ndarray,
    max_points: int,
    max_voxels: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Return the voxels of a sweep in the order in which their first points appear.

    All arithmetic is in float32, as in OpenPCDet: the cell of a point on a boundary depends on it.
    The table `slots` is a hash table with linear probing from the cell's number to the voxel.

    Args:
        points: (n, c) float32.
        limits: (2, 3) float32 lowest and highest x, y, z; the end of x and y is part of the range,
            as far as there are cells.
        size: (3,) float32 edges of a voxel.
        grid: (3,) int64 cells along x, y, z.
        max_points: points of a voxel that are kept.
        max_voxels: voxels that are kept; later points still enter them.

    Returns:
        (voxels, max_points, c) float32 points, with zeros behind the last one; (voxels, 3) int64
        cells z, y, x; (voxels,) int64 number of points; number of further voxels, left out.
    """
    bits = 1
    while (1 << bits) < 2 * len(points) + 2:
        bits += 1
    mask = (1 << bits) - 1
    slots = np.full(1 << bits, -1, np.int64)
    numbers = np.empty(1 << bits, np.int64)
    room = min(len(points), max_voxels)
    grouped = np.zeros((room, max_points, points.shape[1]), np.float32)
    cells = np.empty((room, 3), np.int64)
    counts = np.zeros(room, np.int64)
    voxels, left_out = 0, 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not (limits[0, 0] <= x <= limits[1, 0] and limits[0, 1] <= y <= limits[1, 1]):
            continue
        cell_x = int(np.floor((x - limits[0, 0]) / size[0]))
        cell_y = int(np.floor((y - limits[0, 1]) / size[1]))
        height = np.floor((z - limits[0, 2]) / size[2])
        if not (cell_x < grid[0] and cell_y < grid[1] and 0 <= height < grid[2]):
            continue
        number = (int(height) * grid[1] + cell_y) * grid[0] + cell_x
        slot = (number * _MULTIPLIER >> _SHIFT) & mask
        while slots[slot] != -1 and numbers[slot] != number:
            slot = (slot + 1) & mask
        voxel = slots[slot]
        if voxel == -1:
            numbers[slot] = number
            if voxels == room:
                slots[slot] = -2  # a voxel beyond the cap
                left_out += 1
                continue
            voxel = voxels
            slots[slot] = voxel
            cells[voxel, 0], cells[voxel, 1], cells[voxel, 2] = int(height), cell_y, cell_x
            voxels += 1
        if voxel >= 0 and counts[voxel] < max_points:
            grouped[voxel, counts[voxel]] = points[i]
            counts[voxel] += 1
    return grouped[:voxels], cells[:voxels], counts[:voxels], left_out


@njit(cache=True, nogil=True)
def near_voxels(
    places: np.ndarray,
    centres: np.ndarray,
    shape: np.ndarray,
    cells: np.ndarray,
    points: np.ndarray,
    reach: np.ndarray,
    radius: float,
    most: int,
) -> np.ndarray:
    """Return the first voxels within a radius of each grid point, by z, y, x of the voxel.

    `first` holds where each row of voxels along x starts; most rows are empty.

    Args:
        places: (n, 4) int64 frame, z, y, x of the voxels, sorted.
        centres: (n, 3) float32 x, y, z of their centres, metres.
        shape: (3,) int64 frames, cells along z and y.
        cells: (m, 4) int64 frame and cell z, y, x of the grid points.
        points: (m, 3) float32 x, y, z of the grid points, metres.
        reach: (3,) int64 how many cells away along z, y, x a voxel may be.
        radius: in metres.
        most: number of voxels to return.

    Returns:
        (m, most) int64 rows of voxels; the first one fills the places that are left. -1 if there is
        none.
    """
    frames, height, depth = shape
    first = np.zeros(frames * height * depth + 1, np.int64)
    for i in range(len(places)):
        first[(places[i, 0] * height + places[i, 1]) * depth + places[i, 2] + 1] += 1
    for row in range(len(first) - 1):
        first[row + 1] += first[row]
    found = np.full((len(points), most), -1, np.int64)
    squared = np.float32(radius) * np.float32(radius)
    for i in range(len(points)):
        frame, x = cells[i, 0], cells[i, 3]
        # The cell of a proposal far away or NaN may be any integer; the sums must not overflow.
        z = min(max(cells[i, 1], -reach[0] - 1), height + reach[0])
        y = min(max(cells[i, 2], -reach[1] - 1), depth + reach[1])
        low_y, high_y = max(y - reach[1], 0), min(y + reach[1] + 1, depth)
        count = 0
        for near_z in range(max(z - reach[0], 0), min(z + reach[0] + 1, height)):
            for row in range(
                (frame * height + near_z) * depth + low_y,
                (frame * height + near_z) * depth + high_y,
            ):
                for j in range(first[row], first[row + 1]):
                    if count < most and abs(places[j, 3] - x) <= reach[2]:
                        away_x = centres[j, 0] - points[i, 0]
                        away_y = centres[j, 1] - points[i, 1]
                        away_z = centres[j, 2] - points[i, 2]
                        if away_x * away_x + away_y * away_y + away_z * away_z <= squared:
                            found[i, count] = j
                            count += 1
        for k in range(max(count, 1), most):
            found[i, k] = found[i, 0]
    return found


@njit(cache=True, nogil=True)
def match_rectangles(
    rectangles: np.ndarray, objects: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the best object of each rectangle, and whether it is the best of an object.

    All arithmetic is in float32, as in OpenPCDet: overlaps are often equal, and all equal ones are
    the best of an object.

    Args:
        rectangles: (a, 4) float32 lowest x, y and highest x, y.
        objects: (m, 4) float32, the same; m > 0.

    Returns:
        (a,) int64 first object with the largest IoU, (a,) float32 its IoU, and (a,) whether no
        rectangle has a larger IoU with some object.
    """
    best = np.zeros(len(rectangles), np.int64)
    most = np.zeros(len(rectangles), np.float32)
    highest = np.zeros(len(objects), np.float32)
    for i in range(len(rectangles)):
        for j in range(len(objects)):
            overlap = _iou(rectangles[i], objects[j])
            if overlap > most[i]:
                best[i], most[i] = j, overlap
            highest[j] = max(highest[j], overlap)
    is_highest = np.zeros(len(rectangles), np.bool_)
    for i in range(len(rectangles)):
        if most[i] == 0:
            continue
        for j in range(len(objects)):
            if highest[j] > 0 and _iou(rectangles[i], objects[j]) == highest[j]:
                is_highest[i] = True
    return best, most, is_highest


@njit(cache=True, nogil=True)
def _iou(a: np.ndarray, b: np.ndarray) -> np.float32:
    """Return the IoU of two rectangles in float32."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return np.float32(0)
    common = width * height
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common
    return np.float32(common / max(union, np.float32(1e-6)))
