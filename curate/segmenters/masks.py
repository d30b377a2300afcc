"""Masks of objects in COCO's forms: run lengths, compressed run lengths, and polygons.

Source: COCO's data format. Runs go down the columns, left to right, and begin with the pixels that
are not of the object; pixel (row r, column c) covers the square from (c, r) to (c + 1, r + 1).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from curate.errors import DataError

# Pixels from the image's corner; no annotator goes so far.
_FARTHEST = 1e7


def decode_mask(segmentation: Any, size: tuple[int, int]) -> np.ndarray:
    """Return the pixels of an object.

    Args:
        segmentation: `{"size": [height, width], "counts": str | list}` or a list of polygons
            [x0, y0, x1, y1, ...] in pixels, whose areas are united.
        size: (width, height) of the image in pixels.

    Returns:
        (height, width) bool.

    Raises:
        DataError: if it is neither, or its size is another one.
    """
    width, height = size
    if isinstance(segmentation, dict):
        own = segmentation.get("size")
        if own != [height, width]:
            match own:
                case [int(rows), int(columns)]:
                    shown = f"{columns:.6g} x {rows:.6g} pixels"
                case _:
                    shown = "without a size"
            raise DataError(f"the mask is {shown}, the image {width} x {height}")
        counts = segmentation.get("counts")
        return runs_to_mask(decompress(counts) if isinstance(counts, str) else counts, size)
    if not isinstance(segmentation, list):
        raise DataError("a segmentation is run lengths {size, counts} or a list of polygons")
    mask = np.zeros((height, width), dtype=bool)
    for polygon in segmentation:
        mask |= fill_polygon(polygon, size)
    return mask


def decompress(text: str) -> list[int]:
    """Return the run lengths in COCO's compressed string.

    Each character holds 5 bits, lowest first, and in its sixth whether more follow; the last one's
    fifth bit is the sign. From the fourth run on, the difference to the run before the last is
    written.

    Raises:
        DataError: if a character is none of "0" to "o", or the last number is cut off.
    """
    runs: list[int] = []
    value = shift = 0
    for character in text:
        code = ord(character) - 48
        if not 0 <= code < 64:
            raise DataError(f"{character!r} is no character of compressed run lengths")
        value |= (code & 31) << shift
        shift += 5
        if code & 32:
            continue
        if code & 16:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    if shift:
        raise DataError("the compressed run lengths are cut off")
    return runs


def runs_to_mask(runs: Any, size: tuple[int, int]) -> np.ndarray:
    """Return the (height, width) bool mask of run lengths.

    Raises:
        DataError: if they are no whole numbers, or do not add up to the image.
    """
    width, height = size
    whole = isinstance(runs, list) and all(
        isinstance(run, int) and 0 <= run <= width * height for run in runs
    )
    if not whole or sum(runs) != width * height:
        shown = f"{sum(runs)}" if whole else "no whole numbers"
        raise DataError(
            f"the run lengths are {shown}, not {width * height} pixels for an image of "
            f"{width} x {height}"
        )
    values = np.arange(len(runs)) % 2 == 1
    mask: np.ndarray = np.repeat(values, runs).reshape(width, height).T
    return mask


def fill_polygon(polygon: Any, size: tuple[int, int]) -> np.ndarray:
    """The (height, width) bool mask of the pixels whose centre lies in a polygon (even-odd rule).

    A centre on the left or upper edge is inside, on the right or lower edge outside, so that
    polygons that share an edge share no pixel.

    Args:
        polygon: [x0, y0, x1, y1, ...] in pixels, at least three corners.
        size: (width, height) of the image in pixels.

    Raises:
        DataError: if it is no polygon.
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
    """Return (n, 2) x, y."""
    try:
        corners = np.asarray(polygon, dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        corners = np.zeros(0)
    near = (np.abs(corners) < _FARTHEST).all()
    if corners.ndim != 1 or len(corners) < 6 or len(corners) % 2 or not near:
        raise DataError("a polygon is a list of at least three corners, x0, y0, x1, y1, ...")
    return corners.reshape(-1, 2)
