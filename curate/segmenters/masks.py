"""Decoding of COCO's object masks: run lengths, compressed run lengths, and polygons.

Source: COCO's data format. Runs go down the columns, from the left column to the right one, and
alternate between background and object, background first. The mask of an image 2 pixels wide and
3 high with runs [1, 3, 2]:

    . #      column 0: 1 background, 2 object
    # .      column 1: 1 object, 2 background
    # .

Pixel (row r, column c) covers the square from (c, r) to (c + 1, r + 1).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from curate.errors import DataError

# Largest accepted coordinate in pixels, far beyond any image.
_MAX_COORDINATE = 1e7

# Sides of masks that are shown in messages.
_MAX_SIDE = 10**9


def decode_mask(segmentation: Any, size: tuple[int, int]) -> np.ndarray:
    """Return the mask of an object.

    Args:
        segmentation: `{"size": [height, width], "counts": str | list}` or a list of polygons
            [x0, y0, x1, y1, ...] in pixels; the mask is the union of the polygons.
        size: (width, height) of the image in pixels.

    Returns:
        (height, width) bool.

    Raises:
        DataError: if the segmentation is neither, or has another size than the image.
    """
    width, height = size
    if isinstance(segmentation, dict):
        mask_size = segmentation.get("size")
        if mask_size != [height, width]:
            match mask_size:
                case [int(rows), int(columns)] if max(abs(rows), abs(columns)) < _MAX_SIDE:
                    shown = f"is {columns:.6g} x {rows:.6g} pixels"
                case _:
                    shown = "has no valid size"
            raise DataError(f"the mask {shown}, the image is {width} x {height}")
        counts = segmentation.get("counts")
        return runs_to_mask(decompress(counts) if isinstance(counts, str) else counts, size)
    if not isinstance(segmentation, list):
        raise DataError("a segmentation must be run lengths {size, counts} or a list of polygons")
    mask = np.zeros((height, width), dtype=bool)
    for polygon in segmentation:
        mask |= fill_polygon(polygon, size)
    return mask


def decompress(text: str) -> list[int]:
    """Return the run lengths of COCO's compressed string.

    Each character, minus 48, holds six bits: the lower five are the next five bits of a number,
    lowest first, and the sixth says whether the number continues. In its last character, the fifth
    bit is the sign. From the fourth number on, each is the difference to the run two before. So
    "1331" is 1, 3, 3 and 1 + 3 = 4, and "nO" is (62 - 32) + 32 * (31 - 32) = -2.

    Raises:
        DataError: if a character is not one of "0" to "o", or the last number is truncated.
    """
    runs: list[int] = []
    value = shift = 0
    for character in text:
        code = ord(character) - 48
        if not 0 <= code < 64:
            raise DataError(f"{character!r} is not a character of compressed run lengths")
        value |= (code & 31) << shift
        shift += 5
        if code & 32:
            continue
        if code & 16:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    if shift:
        raise DataError("the compressed run lengths are truncated")
    return runs


def runs_to_mask(runs: Any, size: tuple[int, int]) -> np.ndarray:
    """Return the (height, width) bool mask of run lengths; `size` is (width, height) in pixels.

    Raises:
        DataError: if they are not integers, or their sum is not the number of pixels.
    """
    width, height = size
    valid = isinstance(runs, list) and all(
        isinstance(run, int) and 0 <= run <= width * height for run in runs
    )
    if not valid or sum(runs) != width * height:
        shown = f"add up to {sum(runs)}" if valid else "are not valid integers"
        raise DataError(
            f"the run lengths {shown}; an image of {width} x {height} has {width * height} pixels"
        )
    values = np.arange(len(runs)) % 2 == 1
    mask: np.ndarray = np.repeat(values, runs).reshape(width, height).T
    return mask


def fill_polygon(polygon: Any, size: tuple[int, int]) -> np.ndarray:
    """Return the (height, width) bool mask of pixels with centres in a polygon (even-odd rule).

    A centre on the left or upper edge is inside, a centre on the right or lower edge is outside.
    Two polygons with a common edge therefore share no pixel.

    For every edge and row, the first pixel centre to the right of the edge is marked. A pixel is
    inside if the number of marks up to it in its row is odd.

    Args:
        polygon: [x0, y0, x1, y1, ...] in pixels, at least three corners.
        size: (width, height) of the image in pixels.

    Raises:
        DataError: if the polygon is malformed.
    """
    width, height = size
    corners = _corners(polygon)
    crossings = np.zeros((height, width + 1), dtype=np.int64)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        top, bottom = sorted((y0, y1))
        first, last = np.clip(np.ceil((top - 0.5, bottom - 0.5)), 0, height).astype(np.int64)
        rows = np.arange(first, last)
        if len(rows):
            x = x0 + (rows + 0.5 - y0) * (x1 - x0) / (y1 - y0)
            columns = np.clip(np.ceil(x - 0.5), 0, width).astype(np.int64)
            crossings[rows, columns] += 1
    inside: np.ndarray = np.cumsum(crossings, axis=1)[:, :width] % 2 == 1
    return inside


def _corners(polygon: Sequence[float] | Any) -> np.ndarray:
    """Return the (n, 2) corners x, y of a polygon."""
    try:
        corners = np.asarray(polygon, dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        corners = np.zeros(0)
    in_range = (np.abs(corners) < _MAX_COORDINATE).all()
    if corners.ndim != 1 or len(corners) < 6 or len(corners) % 2 or not in_range:
        raise DataError("a polygon must be a list of at least three corners, x0, y0, x1, y1, ...")
    return corners.reshape(-1, 2)
