"""Points in boxes, one point and one box at a time."""

import cmath
import math


def contains(box, point):
    """Return whether the closed box contains the point."""
    x, y, z, length, width, height, yaw = map(float, box)
    turned = complex(float(point[0]) - x, float(point[1]) - y) * cmath.rect(1, -yaw)
    away = (abs(turned.real), abs(turned.imag), abs(float(point[2]) - z))
    halves = (length / 2, width / 2, height / 2)
    return all(
        math.isfinite(distance) and distance <= half
        for distance, half in zip(away, halves, strict=True)
    )


def first_box(boxes, point):
    """Return the index of the first box that contains the point, -1 if there is none."""
    return next((index for index, box in enumerate(boxes) if contains(box, point)), -1)
