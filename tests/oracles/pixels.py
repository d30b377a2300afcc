"""Pixels of a rectangle, one at a time."""

from fractions import Fraction
from math import floor


def count(rectangle, class_ids, classes):
    """Return (S, A): the pixels of `classes`, and all pixels, that the rectangle touches.

    The square of pixel (row, column) is [column - 1/2, column + 1/2) x [row - 1/2, row + 1/2).
    """
    left, top, right, bottom = (floor(Fraction(side) + Fraction(1, 2)) for side in rectangle)
    mask = box = 0
    for row, line in enumerate(class_ids):
        for column, value in enumerate(line):
            if left <= column <= right and top <= row <= bottom:
                box += 1
                mask += value in classes
    return mask, box
