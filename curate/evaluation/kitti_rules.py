"""KITTI's rules on which objects count: categories, difficulties, and what is left out.

Source: the KITTI object development kit (Geiger et al., CVPR 2012), readme.txt and its evaluation
program. An object that is left out ("ignored") may be found without reward and missed without
penalty.
"""

from types import MappingProxyType

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.shapes import Int

DIFFICULTIES = ("easy", "moderate", "hard")
MIN_HEIGHTS = (40.0, 25.0, 25.0)
"""Height of the 2D box in pixels, per difficulty: labels must exceed it, results reach it."""
MAX_OCCLUSIONS = (0, 1, 2)
MAX_TRUNCATIONS = (0.15, 0.3, 0.5)

MIN_OVERLAPS = MappingProxyType({"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5})
"""Overlap that a detection must exceed to find an object; the same in image, BEV and 3D."""

LOOSE_OVERLAPS = MappingProxyType({"Car": 0.5, "Pedestrian": 0.25, "Cyclist": 0.25})
"""For detectors of few labels, which find objects before they measure them to KITTI's overlaps."""

NEIGHBOURS = MappingProxyType({"Car": "Van", "Pedestrian": "Person_sitting"})
"""Categories that are alike: their objects are ignored, not counted as background."""

COUNTED, IGNORED, ABSENT = 0, 1, -1
"""States of an object in the evaluation of one category at one difficulty."""


def label_states(labels: KittiObjects, category: str, difficulty: int) -> Int[np.ndarray, " n"]:
    """Return (n,) int8 state of each labelled object.

    Args:
        labels: n objects.
        category: that is being evaluated.
        difficulty: index into `DIFFICULTIES`.
    """
    heights = labels.boxes_2d[:, 3] - labels.boxes_2d[:, 1]
    too_hard = (
        (labels.occluded > MAX_OCCLUSIONS[difficulty])
        | (labels.truncated > MAX_TRUNCATIONS[difficulty])
        | (heights <= MIN_HEIGHTS[difficulty])
    )
    states = np.full(len(labels), ABSENT, dtype=np.int8)
    states[labels.categories == NEIGHBOURS.get(category, category)] = IGNORED
    states[labels.categories == category] = COUNTED
    states[(labels.categories == category) & too_hard] = IGNORED
    return states


def result_states(results: KittiObjects, category: str, difficulty: int) -> Int[np.ndarray, " n"]:
    """Return (n,) int8 state of each detection.

    A detection that is too low in the image is ignored whatever its category, so that a low
    detection of another category can take an object out of the count; this is KITTI's own rule.

    Args:
        results: n detections.
        category: that is being evaluated.
        difficulty: index into `DIFFICULTIES`.
    """
    heights = np.abs(results.boxes_2d[:, 3] - results.boxes_2d[:, 1])
    states = np.where(results.categories == category, COUNTED, ABSENT).astype(np.int8)
    states[heights < MIN_HEIGHTS[difficulty]] = IGNORED
    return states
