"""Training on X_l only."""

import numpy as np

from curate.detections import as_categories
from curate.weighting.base import Age, Evidence
from curate.weighting.baseline import Baseline


def test_all_labels_have_weight_0_and_no_unlabeled_frame_is_used():
    """Not even a perfect label."""
    labels = Evidence(np.array([0]), as_categories(["Car"]), np.array([1.0]), np.array([0.0]))
    weights = Baseline().weigh(labels, Age(3, 3))
    assert weights.v.tolist() == [0.0]
    assert np.isnan(weights.lambda_u).all()
    assert not Baseline().uses_unlabeled
