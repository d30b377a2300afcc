"""Colours that carry meaning: the weight scale, ground truth, and what surrounds them.

The weight scale runs through a few anchors whose lightness rises evenly from dim violet to bright
yellow (in the manner of viridis, but light enough at its low end for a dark ground), so that a
higher weight is also a lighter colour, in print and to the colour-blind.
"""

import numpy as np

BACKGROUND = (13, 16, 21)
PANEL = (22, 26, 33)
GRID = (44, 51, 62)
TEXT = (226, 231, 238)
FAINT_TEXT = (139, 150, 165)
GROUND_TRUTH = (255, 255, 255)
HUMAN = (255, 96, 208)
ZERO_WEIGHT = (128, 134, 146)
UNWEIGHTED = (236, 128, 84)

_ANCHORS = np.array(
    [(116, 82, 190), (76, 124, 205), (32, 168, 186), (66, 201, 140), (158, 222, 88), (253, 231, 37)]
)


def weight_colours(weights: np.ndarray) -> np.ndarray:
    """(n, 3) uint8 RGB of (n,) weights in [0, 1].

    Weight 0 is grey; NaN means that nobody weighted the box and is orange.
    """
    unknown = np.isnan(weights)
    place = np.clip(np.where(unknown, 0, weights), 0, 1) * (len(_ANCHORS) - 1)
    channels = [np.interp(place, np.arange(len(_ANCHORS)), channel) for channel in _ANCHORS.T]
    colours: np.ndarray = np.rint(np.stack(channels, axis=-1)).astype(np.uint8)
    colours[np.asarray(weights) <= 0] = ZERO_WEIGHT
    colours[unknown] = UNWEIGHTED
    return colours


def height_shades(heights: np.ndarray) -> np.ndarray:
    """(n, 3) uint8 RGB of LiDAR points by their z in metres: dim ground, lighter above it."""
    share = np.clip((np.asarray(heights) + 2.0) / 4.0, 0, 1)[:, None]
    low, high = np.array([74, 88, 108]), np.array([186, 199, 215])
    shades: np.ndarray = np.rint(low + share * (high - low)).astype(np.uint8)
    return shades
