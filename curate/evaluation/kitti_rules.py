"""KITTI's rules on which objects count: categories, difficulties and ignored objects.

Source: the KITTI object development kit (Geiger et al., CVPR 2012), readme.txt and evaluation
program. An ignored object is neither a true positive if it is found nor a miss if it is not.
"""

from types import MappingProxyType

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.shapes import Int

DIFFICULTIES = ("easy", "moderate", "hard")
MIN_HEIGHTS = (40.0, 25.0, 25.0)
"""2D box heights in pixels, per difficulty: labels must be higher, results at least as high."""
MAX_OCCLUSIONS = (0, 1, 2)
MAX_TRUNCATIONS = (0.15, 0.3, 0.5)

MIN_OVERLAPS = MappingProxyType({"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5})
"""KITTI's IoU thresholds: the overlap that a true positive must exceed, in image, BEV and 3D."""

RELAXED_OVERLAPS = MappingProxyType({"Car": 0.5, "Pedestrian": 0.25, "Cyclist": 0.25})
"""Relaxed IoU thresholds, for detectors trained on few labels with boxes that are not precise."""

NEIGHBOURS = MappingProxyType({"Car": "Van", "Pedestrian": "Person_sitting"})
"""The neighbour category of a category: its objects look alike and are ignored."""

COUNTED, IGNORED, ABSENT = 0, 1, -1
"""States of an object in the evaluation of one category and difficulty; ABSENT takes no part."""


def label_states(labels: KittiObjects, category: str, difficulty: int) -> Int[np.ndarray, " n"]:
    """Return (n,) int8 state of each labeled object.

    Args:
        labels: n objects.
        category: the evaluated category.
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

    A detection with a 2D box that is too low is ignored, whatever its category. It can therefore
    match an object of another category, which is then not counted. KITTI's program does the same.

    Args:
        results: n detections.
        category: the evaluated category.
        difficulty: index into `DIFFICULTIES`.
    """
    heights = np.abs(results.boxes_2d[:, 3] - results.boxes_2d[:, 1])
    states = np.where(results.categories == category, COUNTED, ABSENT).astype(np.int8)
    states[heights < MIN_HEIGHTS[difficulty]] = IGNORED
    return states
