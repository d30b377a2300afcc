"""Masks of a model's own size brought into an image.

Source: mask pasting of Mask R-CNN (He et al. 2017) as its published implementations do it: bilinear
between the centres of the mask's cells, less and less beyond them.
"""

import numpy as np

Box = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels; pixel (row r, column c) covers (c, r) to (c + 1, r + 1)."""


def paste_mask(
    mask: np.ndarray,
    covers: Box,
    within: Box,
    size: tuple[int, int],
    threshold: float,
    *,
    extended: bool = False,
) -> tuple[tuple[slice, slice], np.ndarray]:
    """Return the pixels of an object.

    Args:
        mask: (h, w) values of its cells.
        covers: what of the image the mask covers.
        within: pixels whose centre is outside are left out.
        size: (width, height) of the image in pixels.
        threshold: a pixel is the object's where the mask is above it.
        extended: whether beyond the centres of the outermost cells the mask goes on as they are.

    Returns:
        Rows and columns of a part of the image, and which of its pixels are the object's.
    """
    height, width = mask.shape
    columns, across = _sampling(
        covers[0], covers[2], (within[0], within[2]), size[0], width, extended
    )
    rows, down = _sampling(covers[1], covers[3], (within[1], within[3]), size[1], height, extended)
    if (width, height) == size and covers == (0, 0, width, height):
        return (rows, columns), mask[rows, columns] > threshold
    return (rows, columns), down @ mask.astype(np.float32) @ across.T > threshold


def _sampling(
    low: float, high: float, within: tuple[float, float], pixels: int, cells: int, extended: bool
) -> tuple[slice, np.ndarray]:
    """The pixels along one axis, and (pixels, cells) how much each cell counts for each of them."""
    first, end = np.clip(np.ceil(np.array(within) - 0.5), 0, pixels).astype(int).tolist()
    if end <= first or high <= low:
        return slice(0, 0), np.zeros((0, cells), np.float32)
    places = (np.arange(first, end) + 0.5 - low) / (high - low) * cells - 0.5
    if extended:
        places = np.clip(places, 0, cells - 1)
    weights = np.maximum(0, 1 - np.abs(places[:, None] - np.arange(cells)))
    return slice(first, end), weights.astype(np.float32)
