"""Compiled kernels on rotated rectangles: intersection area, IoU and non-maximum suppression.

The intersection area comes from Green's theorem. In the frame of the smaller rectangle, y dx is
integrated along each edge of the larger one, with x clamped to half the length and y to half the
width of the smaller rectangle:

    smaller a: 4 x 2 at the origin, so x is clamped to [-2, 2] and y to [-1, 1]
    larger b:  a 6 x 6 square with corners (0, -3), (6, -3), (6, 3), (0, 3), counter-clockwise
    bottom edge, x from 0 to 6:   x clamped to 0 .. 2, y to -1:   -1 * 2 = -2
    right edge, x = 6:            clamped to one x:                0
    top edge, x from 6 to 0:      x clamped to 2 .. 0, y to 1:     1 * -2 = -2
    left edge, x = 0:                                              0
    area = minus the sum = 4: the part of a with x > 0, 2 x 2

(The example is aligned to keep it short; the code computes aligned rectangles as below.)

There is no division by a difference that can vanish, so touching, nested and nearly parallel
rectangles need no special case. For exactly aligned rectangles the area is the product of the
common sides: a box has an IoU of exactly 1 with itself.

The first kernels write into arrays that the caller has made: compiling np.zeros would take longer
than compiling the loops.

All kernels are in this one file because numba's cache on disk tracks changes only of the file of a
kernel: a kernel in another file would keep using an old version of the functions here.
"""

import math

import numpy as np
from numba import njit

# Rectangles with a smaller sine or cosine of the angle between them count as aligned: the rest is
# rounding, for example of yaw + pi, wrapped. This changes the area by less than 1e-12 of the
# product of the sides.
_ALIGNED_SINE = 1e-12

# Columns of the table that `fill_rectangle_table` fills.
_X, _Y, _Z, _HALF_LENGTH, _HALF_WIDTH, _HALF_HEIGHT, _COS, _SIN, _RADIUS, _AREA = range(10)

_Pair = tuple[float, float]


@njit(cache=True, nogil=True, error_model="numpy")
def fill_rectangle_table(boxes: np.ndarray, table: np.ndarray) -> None:
    """Fill the (n, 10) table of (n, 7) boxes with the values that the other kernels use.

    A box with a length or width that is not positive gets area 0, and a box with a number that is
    not finite gets a row of zeros: such boxes overlap nothing.

    Args:
        boxes: (n, 7).
        table: (n, 10) zeros.
    """
    for i in range(len(boxes)):
        x, y, z, length, width, height, yaw = boxes[i]
        if not math.isfinite(x + y + z + length + width + height + yaw):
            continue
        table[i, _X], table[i, _Y], table[i, _Z] = x, y, z
        table[i, _HALF_LENGTH], table[i, _HALF_WIDTH] = length / 2, width / 2
        table[i, _HALF_HEIGHT] = height / 2
        table[i, _COS], table[i, _SIN] = math.cos(yaw), math.sin(yaw)
        table[i, _RADIUS] = math.hypot(length, width) / 2
        table[i, _AREA] = length * width if length > 0 and width > 0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _common_length(offset: float, half_a: float, half_b: float) -> float:
    """Return the common length of two intervals with this offset of their centres; symmetric."""
    return max(0.0, min(2 * half_a, 2 * half_b, half_a + half_b - abs(offset)))


@njit(cache=True, nogil=True, error_model="numpy")
def _edge_integral(from_: _Pair, to: _Pair, half_sides: _Pair) -> float:
    """Return the integral of y dx along an edge, x and y clamped to +-half sides."""
    (x0, y0), (x1, y1), (half_x, half_y) = from_, to, half_sides
    start = min(max(x0, -half_x), half_x)
    end = min(max(x1, -half_x), half_x)
    if start == end:
        return 0.0
    slope = (y1 - y0) / (x1 - x0)
    y_start = y0 + slope * (start - x0)
    y_end = y1 + slope * (end - x1)
    low, high = min(y_start, y_end), max(y_start, y_end)
    if low >= -half_y and high <= half_y:
        return (end - start) * (low + high) / 2
    if high <= -half_y:
        return -half_y * (end - start)
    if low >= half_y:
        return half_y * (end - start)
    inner_low, inner_high = max(low, -half_y), min(high, half_y)
    inner = (inner_high - inner_low) * (inner_low + inner_high) / 2
    outer = half_y * ((high - inner_high) - (inner_low - low))
    return (end - start) * (inner + outer) / (high - low)


@njit(cache=True, nogil=True, error_model="numpy")
def _precedes(a: np.ndarray, i: int, b: np.ndarray, j: int) -> bool:
    """Return whether a[i] is the frame of reference: the smaller one, ties by the other columns.

    The choice is the same for (a, b) and (b, a), so the order of the arguments does not change the
    area.
    """
    if a[i, _AREA] != b[j, _AREA]:
        return bool(a[i, _AREA] < b[j, _AREA])
    for column in range(_RADIUS):
        if a[i, column] != b[j, column]:
            return bool(a[i, column] < b[j, column])
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _area_in_frame_of(a: np.ndarray, i: int, b: np.ndarray, j: int) -> float:
    """Return the common area of rectangles a[i] and b[j], computed in the frame of a[i]."""
    half_x, half_y = a[i, _HALF_LENGTH], a[i, _HALF_WIDTH]
    away_x, away_y = b[j, _X] - a[i, _X], b[j, _Y] - a[i, _Y]
    x = a[i, _COS] * away_x + a[i, _SIN] * away_y
    y = a[i, _COS] * away_y - a[i, _SIN] * away_x
    cos = a[i, _COS] * b[j, _COS] + a[i, _SIN] * b[j, _SIN]
    sin = a[i, _COS] * b[j, _SIN] - a[i, _SIN] * b[j, _COS]
    length, width = b[j, _HALF_LENGTH], b[j, _HALF_WIDTH]
    if abs(sin) < _ALIGNED_SINE:
        return _common_length(x, half_x, length) * _common_length(y, half_y, width)
    if abs(cos) < _ALIGNED_SINE:
        return _common_length(x, half_x, width) * _common_length(y, half_y, length)
    forward_x, forward_y = cos * length, sin * length
    left_x, left_y = -sin * width, cos * width
    front_left = (x + forward_x + left_x, y + forward_y + left_y)
    rear_left = (x - forward_x + left_x, y - forward_y + left_y)
    rear_right = (x - forward_x - left_x, y - forward_y - left_y)
    front_right = (x + forward_x - left_x, y + forward_y - left_y)
    half_sides = (half_x, half_y)
    # The edges run counter-clockwise, so the area is minus the integral.
    return -(
        _edge_integral(front_left, rear_left, half_sides)
        + _edge_integral(rear_left, rear_right, half_sides)
        + _edge_integral(rear_right, front_right, half_sides)
        + _edge_integral(front_right, front_left, half_sides)
    )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _near(a: np.ndarray, i: int, b: np.ndarray, j: int) -> bool:
    """Return whether the circumscribed circles of a[i] and b[j] intersect."""
    reach = a[i, _RADIUS] + b[j, _RADIUS]
    away_x, away_y = b[j, _X] - a[i, _X], b[j, _Y] - a[i, _Y]
    return bool(away_x * away_x + away_y * away_y < reach * reach)


@njit(cache=True, nogil=True, error_model="numpy")
def _common_area(a: np.ndarray, i: int, b: np.ndarray, j: int) -> float:
    """Return the common area of rectangles a[i] and b[j]; 0 if one has no area."""
    smaller = min(a[i, _AREA], b[j, _AREA])
    if not smaller > 0:
        return 0.0
    a_first = _precedes(a, i, b, j)
    area = _area_in_frame_of(a, i, b, j) if a_first else _area_in_frame_of(b, j, a, i)
    return float(min(max(area, 0.0), smaller))


@njit(cache=True, nogil=True, error_model="numpy")
def _bev_iou(a: np.ndarray, i: int, b: np.ndarray, j: int) -> float:
    """Return the intersection over union of the footprints a[i] and b[j]."""
    common = _common_area(a, i, b, j)
    if common == 0:
        return 0.0
    return float(common / (a[i, _AREA] + b[j, _AREA] - common))


@njit(cache=True, nogil=True, error_model="numpy")
def _iou_3d(a: np.ndarray, i: int, b: np.ndarray, j: int) -> float:
    """Return the intersection over union of the cuboids a[i] and b[j]."""
    height_a, height_b = 2 * a[i, _HALF_HEIGHT], 2 * b[j, _HALF_HEIGHT]
    if not (height_a > 0 and height_b > 0):
        return 0.0
    offset = b[j, _Z] - a[i, _Z]
    shared = _common_length(offset, a[i, _HALF_HEIGHT], b[j, _HALF_HEIGHT])
    common = shared * _common_area(a, i, b, j) if shared > 0 else 0.0
    if common == 0:
        return 0.0
    return float(common / (a[i, _AREA] * height_a + b[j, _AREA] * height_b - common))


@njit(cache=True, nogil=True, error_model="numpy")
def iou_matrix(a: np.ndarray, b: np.ndarray, order: np.ndarray, with_height: bool) -> np.ndarray:
    """Return the (n, m) IoU of the rectangle tables a and b, of cuboids or of footprints.

    Only pairs with ranges of x that can overlap are tested.

    Args:
        a: (n, 10) rectangle table.
        b: (m, 10) rectangle table, sorted by x.
        order: (m,) int64 column of the result for each row of b.
        with_height: true for the IoU of volumes, false for that of footprints.
    """
    matrix = np.zeros((len(a), len(b)))
    largest_radius = 0.0
    for j in range(len(b)):
        largest_radius = max(largest_radius, b[j, _RADIUS])
    for i in range(len(a)):
        reach = a[i, _RADIUS] + largest_radius
        for j in range(np.searchsorted(b[:, _X], a[i, _X] - reach), len(b)):
            if b[j, _X] > a[i, _X] + reach:
                break
            if _near(a, i, b, j):
                overlap = _iou_3d(a, i, b, j) if with_height else _bev_iou(a, i, b, j)
                matrix[i, order[j]] = overlap
    return matrix


@njit(cache=True, nogil=True, error_model="numpy")
def fill_pair_ious(
    a: np.ndarray, rows_a: np.ndarray, b: np.ndarray, rows_b: np.ndarray, ious: np.ndarray
) -> None:
    """Write the BEV IoU and the 3D IoU of pairs of rows of the rectangle tables a and b.

    Args:
        a: (n, 10) rectangle table.
        rows_a: (pairs,) int64 rows of a.
        b: (m, 10) rectangle table.
        rows_b: (pairs,) int64 rows of b.
        ious: (2, pairs) zeros.
    """
    for k in range(len(rows_a)):
        i, j = rows_a[k], rows_b[k]
        if _near(a, i, b, j):
            ious[0, k] = _bev_iou(a, i, b, j)
            if ious[0, k] > 0:
                ious[1, k] = _iou_3d(a, i, b, j)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _may_exceed(a: np.ndarray, i: int, b: np.ndarray, j: int, threshold: float) -> bool:
    """Return whether the BEV IoU can exceed the threshold; cheaper than the IoU itself.

    The test bounds the common area by that of a[i] and b[j]'s bounding rectangle in a[i]'s frame.
    """
    away_x, away_y = b[j, _X] - a[i, _X], b[j, _Y] - a[i, _Y]
    cos = abs(a[i, _COS] * b[j, _COS] + a[i, _SIN] * b[j, _SIN])
    sin = abs(a[i, _COS] * b[j, _SIN] - a[i, _SIN] * b[j, _COS])
    upper_bound = _common_length(
        a[i, _COS] * away_x + a[i, _SIN] * away_y,
        a[i, _HALF_LENGTH],
        cos * b[j, _HALF_LENGTH] + sin * b[j, _HALF_WIDTH],
    ) * _common_length(
        a[i, _COS] * away_y - a[i, _SIN] * away_x,
        a[i, _HALF_WIDTH],
        sin * b[j, _HALF_LENGTH] + cos * b[j, _HALF_WIDTH],
    )
    upper_bound = min(upper_bound, a[i, _AREA], b[j, _AREA])
    # IoU > threshold is equivalent to common * (1 + threshold) > threshold * (area_a + area_b).
    # The margin of 1e-9 covers rounding: a pair is never skipped because of it.
    areas = a[i, _AREA] + b[j, _AREA]
    return bool(upper_bound * (1 + threshold) * (1 + 1e-9) > threshold * areas)


@njit(cache=True, nogil=True, error_model="numpy")
def _cell(value: float, low: float, cell: float, count: int) -> int:
    """Return the index of the grid cell of a coordinate; the outer cells extend to infinity."""
    position = (value - low) / cell
    if not position > 0:  # NaN too
        return 0
    return min(int(min(position, 1e9)), count - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def greedy_nms(table: np.ndarray, order: np.ndarray, iou_threshold: float) -> np.ndarray:
    """Return the boxes that greedy non-maximum suppression on BEV IoU keeps.

    The boxes are sorted into a grid with cells at least as wide as the diagonal of the largest box.
    Each box is compared only with the kept boxes of its own cell and the eight neighbouring ones.
    The kept boxes of a cell form a linked list: `newest` is the last kept box of a cell, `older`
    the one kept before it in the same cell.

    Args:
        table: (n, 10) rectangle table.
        order: (n,) int64, the rows from the highest to the lowest score.
        iou_threshold: a box is dropped if its IoU with a kept box is above this.

    Returns:
        (k,) int64 kept rows, in `order`.
    """
    low_x, low_y, high_x, high_y, cell = np.inf, np.inf, -np.inf, -np.inf, 1e-6
    for i in range(len(table)):
        low_x, high_x = min(low_x, table[i, _X]), max(high_x, table[i, _X])
        low_y, high_y = min(low_y, table[i, _Y]), max(high_y, table[i, _Y])
        cell = max(cell, 2 * table[i, _RADIUS])
    cell = max(cell, (high_x - low_x) / 256, (high_y - low_y) / 256)
    count_x = _cell(high_x, low_x, cell, 258) + 1
    count_y = _cell(high_y, low_y, cell, 258) + 1
    newest = np.full((count_x, count_y), -1)
    older = np.full(len(table), -1)
    kept = np.empty(len(table), np.int64)
    number = 0
    for i in order:
        cell_x = _cell(table[i, _X], low_x, cell, count_x)
        cell_y = _cell(table[i, _Y], low_y, cell, count_y)
        suppressed = False
        for near_x in range(max(cell_x - 1, 0), min(cell_x + 2, count_x)):
            for near_y in range(max(cell_y - 1, 0), min(cell_y + 2, count_y)):
                j = newest[near_x, near_y]
                while j >= 0 and not suppressed:
                    if _near(table, i, table, j) and _may_exceed(table, i, table, j, iou_threshold):
                        suppressed = _bev_iou(table, i, table, j) > iou_threshold
                    j = older[j]
        if not suppressed:
            older[i] = newest[cell_x, cell_y]
            newest[cell_x, cell_y] = i
            kept[number] = i
            number += 1
    return kept[:number]
