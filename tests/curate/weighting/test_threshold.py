"""The plain score threshold."""

import numpy as np
import pytest

from curate.detections import as_categories
from curate.errors import ConfigError
from curate.weighting.base import Age, Evidence
from curate.weighting.threshold import Threshold

LABELS = Evidence(
    np.array([0, 0, 1, 1]),
    as_categories(["Car", "Car", "Cyclist", "Cyclist"]),
    np.array([0.29, 0.3, 0.5, 0.9]),
    np.array([0.1, np.nan, 0.2, 3.0]),
)


@pytest.mark.parametrize("age", [Age(1, 3), Age(3, 3)])
def test_scores_at_or_above_the_threshold_have_weight_1(age):
    """The round, the loss and a missing match do not matter."""
    weights = Threshold().weigh(LABELS, age)
    assert weights.v.tolist() == [0.0, 1.0, 1.0, 1.0]
    assert np.isnan(weights.lambda_u).all()


def test_a_category_can_have_its_own_threshold():
    """Cyclists have their own, cars the common one."""
    policy = Threshold(per_category={"Cyclist": 0.6})
    assert policy.weigh(LABELS, Age(1, 3)).v.tolist() == [0.0, 1.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"threshold": 1.5}, "1.5"), ({"per_category": {"Cyclist": -0.1}}, "Cyclist")],
)
def test_a_threshold_that_is_not_a_score_is_rejected(wrong, message):
    with pytest.raises(ConfigError, match=message):
        Threshold(**wrong)
