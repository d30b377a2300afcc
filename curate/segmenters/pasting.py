"""Mask pasting: resampling a mask of the model's resolution to the pixels of an image.

Source: mask pasting of Mask R-CNN (He et al. 2017), as in its published implementations. Values are
interpolated bilinearly between the centres of the mask's cells, and fade to 0 beyond the outermost
centres.
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
    """Return the image pixels that belong to an object.

    Args:
        mask: (h, w) values of the mask's cells.
        covers: the part of the image that the mask covers.
        within: pixels with their centre outside this box are excluded.
        size: (width, height) of the image in pixels.
        threshold: a pixel belongs to the object if the mask value is above this.
        extended: whether the outermost cells keep their value beyond their centres, instead of
            fading to 0.

    Returns:
        The rows and columns of a part of the image, and a bool mask of its pixels.
    """
    height, width = mask.shape
    columns, x_weights = _sampling(
        covers[0], covers[2], (within[0], within[2]), size[0], width, extended
    )
    rows, y_weights = _sampling(
        covers[1], covers[3], (within[1], within[3]), size[1], height, extended
    )
    if (width, height) == size and covers == (0, 0, width, height):
        return (rows, columns), mask[rows, columns] > threshold
    return (rows, columns), y_weights @ mask.astype(np.float32) @ x_weights.T > threshold


def _sampling(
    low: float, high: float, within: tuple[float, float], pixels: int, cells: int, extended: bool
) -> tuple[slice, np.ndarray]:
    """Return the pixels along one axis, and the (pixels, cells) interpolation weights.

    For example, two cells that cover pixels 0 to 4 have their centres at 1 and 3. The weights of
    the pixel with its centre at 1.5 are 0.75 and 0.25.
    """
    first, end = np.clip(np.ceil(np.array(within) - 0.5), 0, pixels).astype(int).tolist()
    if end <= first or high <= low:
        return slice(0, 0), np.zeros((0, cells), np.float32)
    positions = (np.arange(first, end) + 0.5 - low) / (high - low) * cells - 0.5
    if extended:
        positions = np.clip(positions, 0, cells - 1)
    weights = np.maximum(0, 1 - np.abs(positions[:, None] - np.arange(cells)))
    return slice(first, end), weights.astype(np.float32)
