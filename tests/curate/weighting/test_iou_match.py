"""Thresholds of score and IoU."""

import numpy as np
import pytest

from curate.detections import as_categories
from curate.errors import ConfigError
from curate.weighting.base import Age, Evidence
from curate.weighting.iou_match import IoUMatch


def labels(*rows):
    """Labels of (category, score, iou)."""
    categories, scores, ious = zip(*rows, strict=True)
    n = len(rows)
    return Evidence(
        np.zeros(n, int), as_categories(categories), np.array(scores), np.full(n, np.nan),
        iou=np.array(ious),
    )  # fmt: skip


def test_both_thresholds_must_be_reached():
    """0.4 and, for cars, 0.5, else 0.25: the thresholds themselves pass."""
    found = labels(
        ("Car", 0.4, 0.5),
        ("Car", 0.39, 0.9),
        ("Car", 0.9, 0.49),
        ("Pedestrian", 0.4, 0.25),
        ("Cyclist", 0.9, 0.24),
    )
    weights = IoUMatch().weigh(found, Age(1, 3))
    assert weights.v.tolist() == [1, 0, 0, 1, 0]
    assert not weights.dropped.any()


def test_categories_can_have_their_own_thresholds():
    """Of either kind."""
    policy = IoUMatch(0.5, 0.5, {"Tram": 0.1}, {"Tram": 0.2})
    found = labels(("Tram", 0.1, 0.2), ("Car", 0.5, 0.5), ("Car", 0.1, 0.9))
    assert policy.weigh(found, Age(1, 1)).v.tolist() == [1, 1, 0]


def test_a_detector_without_estimates_is_refused_in_one_line():
    """It says how many labels lack one, and what to do."""
    with pytest.raises(ConfigError, match="3dioumatch: 1 of 2 labels have no IoU estimate") as info:
        IoUMatch().weigh(labels(("Car", 0.9, 0.9), ("Car", 0.9, np.nan)), Age(1, 1))
    assert "\n" not in str(info.value)


@pytest.mark.parametrize(
    "wrong", [{"score": 1.1}, {"iou": -0.1}, {"iou_per_category": {"Car": 2.0}}]
)
def test_thresholds_that_are_no_shares_are_refused(wrong):
    """The error names policy and setting."""
    with pytest.raises(ConfigError, match=r"3dioumatch: (score|iou) for"):
        IoUMatch(**wrong)
