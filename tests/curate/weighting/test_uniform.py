"""Unfiltered pseudo-labels."""

import numpy as np

from curate.detections import as_categories
from curate.weighting.base import Age, Evidence
from curate.weighting.uniform import Uniform


def test_every_label_has_weight_1():
    """Even one with a low score that did not match."""
    labels = Evidence(
        np.array([0, 1]),
        as_categories(["Car", "Car"]),
        np.array([0.9, 0.1]),
        np.array([0.1, np.nan]),
        {"rho_diff": np.zeros(2)},
    )
    weights = Uniform().weigh(labels, Age(1, 3))
    assert weights.v.tolist() == [1.0, 1.0]
    assert np.isnan(weights.lambda_u).all()
    assert Uniform().uses_unlabeled
