"""KITTI's rules on which objects count: categories, difficulties and ignored objects.

Source: the KITTI object development kit (Geiger et al., CVPR 2012), readme.txt and evaluation
program. An ignored object is neither a true positive if it is found nor a miss if it is not.
"""

from collections.abc import Collection, Mapping
from types import MappingProxyType

import numpy as np

from curate.errors import ConfigError
from curate.spelling import did_you_mean

DIFFICULTIES = ("easy", "moderate", "hard")
MIN_HEIGHTS = (40.0, 25.0, 25.0)
"""2D box heights in pixels, per difficulty: labels must be higher, results at least as high."""
MAX_OCCLUSIONS = (0, 1, 2)
MAX_TRUNCATIONS = (0.15, 0.3, 0.5)

MIN_OVERLAPS = MappingProxyType({"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5})
"""KITTI's IoU thresholds: the overlap that a true positive must exceed, in image, BEV and 3D."""

OTHER_OVERLAP = 0.5
"""IoU threshold of the categories that KITTI does not evaluate, unless another one is given."""

NEIGHBOURS = MappingProxyType({"Car": "Van", "Pedestrian": "Person_sitting"})
"""The neighbour category of a category: its objects look alike and are ignored."""

COUNTED, IGNORED, ABSENT = 0, 1, -1
"""States of an object in the evaluation of one category and difficulty; ABSENT takes no part."""


def overlaps_of(
    categories: Collection[str], given: Mapping[str, float] | None = None
) -> dict[str, float]:
    """Return the IoU threshold of each category: the given one, KITTI's, or `OTHER_OVERLAP`.

    Args:
        categories: the evaluated categories.
        given: IoU thresholds by category; None for none.

    Raises:
        ConfigError: if a threshold is given for a category that is not evaluated, or is not above 0
            and below 1.
    """
    given = given or {}
    for category, overlap in given.items():
        if category not in categories:
            meant = did_you_mean(category, categories)
            raise ConfigError(
                f"{category!r} is not one of the evaluated categories "
                f"({', '.join(categories)}){meant}"
            )
        if not 0 < overlap < 1:
            raise ConfigError(f"the IoU of {category} must be above 0 and below 1, not {overlap:g}")
    return {
        category: float(given.get(category, MIN_OVERLAPS.get(category, OTHER_OVERLAP)))
        for category in categories
    }


def relaxed(overlaps: Mapping[str, float]) -> dict[str, float]:
    """Return relaxed IoU thresholds, for detectors trained on few labels with imprecise boxes.

    0.7 becomes 0.5 and 0.5 becomes 0.25, as is usual for KITTI; other thresholds are interpolated
    between these, 0 and 1.
    """
    known = ((0.0, 0.5, 0.7, 1.0), (0.0, 0.25, 0.5, 1.0))
    return {category: float(np.interp(overlap, *known)) for category, overlap in overlaps.items()}


RELAXED_OVERLAPS = MappingProxyType(relaxed(MIN_OVERLAPS))
"""Relaxed IoU thresholds of KITTI's categories."""


def neighbours_of(categories: Collection[str]) -> dict[str, str]:
    """Return the neighbour of each category that has one, unless it is itself evaluated."""
    return {
        category: neighbour
        for category, neighbour in NEIGHBOURS.items()
        if category in categories and neighbour not in categories
    }
