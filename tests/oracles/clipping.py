"""Overlap of rotated boxes: by Sutherland-Hodgman clipping, and by counting random points.

Not shapely: its overlay finds no common area for some rectangles that differ by micrometres.
"""

import math
from itertools import pairwise

import numpy as np


def footprint(box):
    """Return the corners of the box in BEV, counter-clockwise, as complex numbers."""
    turn = complex(math.cos(box[6]), math.sin(box[6]))
    ahead, left = turn * box[3] / 2, turn * 1j * box[4] / 2
    centre = complex(box[0], box[1])
    return [
        centre + ahead + left,
        centre - ahead + left,
        centre - ahead - left,
        centre + ahead - left,
    ]


def cross(a, b):
    """Return the cross product of two vectors in the plane."""
    return (a.conjugate() * b).imag


def clip(polygon, start, end):
    """Return the part of a convex polygon to the left of the line from start to end."""
    kept = []
    for here, there in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        side_here, side_there = cross(end - start, here - start), cross(end - start, there - start)
        if side_here >= 0:
            kept.append(here)
        if (side_here < 0) != (side_there < 0):
            kept.append(here + (there - here) * side_here / (side_here - side_there))
    return kept


def common_area(a, b):
    """Return the common area of two footprints."""
    polygon, knife = footprint(a), footprint(b)
    for start, end in zip(knife, knife[1:] + knife[:1], strict=True):
        polygon = clip(polygon, start, end)
    centred = [corner - polygon[0] for corner in polygon]
    return sum(cross(one, other) for one, other in pairwise(centred)) / 2


def bev_iou(a, b):
    """Return the IoU of two footprints; 0 if a side is 0."""
    if min(a[3], a[4], b[3], b[4]) <= 0:
        return 0.0
    common = common_area(a, b)
    return common / (a[3] * a[4] + b[3] * b[4] - common)


def iou_3d(a, b):
    """Return the IoU of two upright boxes; 0 if a side is 0."""
    if min(*a[3:6], *b[3:6]) <= 0:
        return 0.0
    low = max(a[2] - a[5] / 2, b[2] - b[5] / 2)
    high = min(a[2] + a[5] / 2, b[2] + b[5] / 2)
    common = common_area(a, b) * max(high - low, 0)
    return common / (math.prod(a[3:6]) + math.prod(b[3:6]) - common)


def bev_iou_by_sampling(a, b, generator, count):
    """Return the share of random points in a or b that are in both."""
    reach = max(math.hypot(*a[3:5]), math.hypot(*b[3:5])) / 2
    low = np.minimum(a[:2], b[:2]) - reach
    high = np.maximum(a[:2], b[:2]) + reach
    points = generator.uniform(low, high, (count, 2))
    in_a, in_b = _within(points, a), _within(points, b)
    return np.sum(in_a & in_b) / np.sum(in_a | in_b)


def _within(points, box):
    rotation = complex(math.cos(box[6]), -math.sin(box[6]))
    local = (points[:, 0] - box[0] + 1j * (points[:, 1] - box[1])) * rotation
    return (abs(local.real) <= box[3] / 2) & (abs(local.imag) <= box[4] / 2)
