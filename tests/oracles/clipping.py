"""Overlap of rotated boxes: by polygon clipping in shapely, and by counting random points."""

import math

import numpy as np
from shapely.geometry import Polygon


def footprint(box):
    """The box seen from above, as a polygon built side by side from its centre."""
    x, y, _, length, width, _, yaw = map(float, box)
    ahead = np.array([math.cos(yaw), math.sin(yaw)]) * length / 2
    left = np.array([-math.sin(yaw), math.cos(yaw)]) * width / 2
    centre = np.array([x, y])
    return Polygon(
        [centre + ahead + left, centre - ahead + left, centre - ahead - left, centre + ahead - left]
    )


def bev_iou(a, b):
    """IoU of two footprints; 0 where a side is 0."""
    if min(a[3], a[4], b[3], b[4]) <= 0:
        return 0.0
    common = footprint(a).intersection(footprint(b)).area
    return common / (a[3] * a[4] + b[3] * b[4] - common)


def iou_3d(a, b):
    """IoU of two upright boxes; 0 where a side is 0."""
    if min(*a[3:6], *b[3:6]) <= 0:
        return 0.0
    low = max(a[2] - a[5] / 2, b[2] - b[5] / 2)
    high = min(a[2] + a[5] / 2, b[2] + b[5] / 2)
    common = footprint(a).intersection(footprint(b)).area * max(high - low, 0)
    return common / (math.prod(a[3:6]) + math.prod(b[3:6]) - common)


def bev_iou_by_sampling(a, b, generator, count):
    """Share of random points in a or b that lie in both."""
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
