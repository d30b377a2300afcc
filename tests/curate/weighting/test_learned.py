"""Weights from probabilities, by precision or by a bound on the share of wrong labels."""

import numpy as np
import pytest

from curate.calibration.sharpening import sharpen
from curate.detections import as_categories
from curate.errors import ConfigError, DataError
from curate.weighting.base import Age, Evidence, Weights
from curate.weighting.learned import Learned

P = np.random.default_rng(0).beta(0.4, 1.0, 300)


def weighed(probability, p_value=(), **options) -> Weights:
    """Return the weights of labels with these probabilities."""
    n = len(probability)
    labels = Evidence(
        np.zeros(n, int), as_categories([""] * n), np.full(n, np.nan), np.full(n, np.nan),
        probability=np.array(probability, float), p_value=np.array(p_value, float),
    )  # fmt: skip
    return Learned(**options).weigh(labels, Age(1, 3))


@pytest.mark.parametrize("precision", [0.7, 0.8, 0.9])
def test_the_weights_have_the_requested_precision(precision: float):
    """They are p^gamma, in the order of the probabilities, without small ones."""
    found = weighed(P, precision=precision)
    gamma = sharpen(P, precision).gamma
    expected = P**gamma
    assert found.v == pytest.approx(np.where(expected < 0.01, 0, expected))
    assert (P * expected).sum() / expected.sum() == pytest.approx(precision)
    assert found.remark == f"gamma {gamma:.3g}, expected precision {precision:.3g}"
    assert np.isnan(found.lambda_u).all()
    assert not found.dropped.any()


def test_a_precision_out_of_reach_is_reported():
    """With the best that can be."""
    found = weighed([0.1, 0.3, 0.6])
    assert found.v.max() == pytest.approx(0.1)
    assert found.remark.endswith("expected precision 0.587: 0.8 is out of reach")


def test_the_labels_within_the_bound_are_selected():
    """By the step of Benjamini and Hochberg, whatever the probabilities are."""
    found = weighed([0.2, 0.9, 0.5, 0.6], [0.9, 0.01, 0.04, 0.5], max_wrong=0.1)
    assert found.v.tolist() == [0, 1, 1, 0]
    assert found.remark == "at most 0.1 of those with weight 1 are expected to be wrong"


def test_a_bound_out_of_reach_is_reported():
    """With the least one that selects a label."""
    found = weighed([0.9, 0.8], [0.2, 0.9], max_wrong=0.1)
    assert not found.v.any()
    assert found.remark == (
        "max_wrong 0.1 is out of reach; the least bound that selects a label is 0.4"
    )


@pytest.mark.parametrize("options", [{}, {"max_wrong": 0.2}])
def test_labels_without_an_estimate_are_rejected(options):
    """The calibration is missing."""
    with pytest.raises(ConfigError, match="1 of 2 labels have no probability; run `curate cal"):
        weighed([0.5, np.nan], [0.1, 0.1], **options)


def test_a_bound_needs_p_values():
    """The policy says so before it runs."""
    assert Learned().reads == ("probability",)
    assert Learned(max_wrong=0.1).reads == ("probability", "p_value")
    with pytest.raises(ConfigError, match="2 of 2 labels have no p_value"):
        weighed([0.5, 0.6], max_wrong=0.2)


@pytest.mark.parametrize("setting", ["precision", "max_wrong"])
@pytest.mark.parametrize("value", [0, 1, -0.1, 1.5, float("nan")])
def test_settings_outside_their_range_are_rejected(setting, value):
    with pytest.raises(ConfigError, match=f"policy learned: {setting} must be above 0"):
        Learned(**{setting: value})


def test_no_labels_have_no_remark():
    for options in ({}, {"max_wrong": 0.1}):
        found = weighed([], **options)
        assert (len(found.v), found.remark) == (0, "")


def test_probabilities_outside_0_and_1_are_rejected():
    with pytest.raises(DataError, match=r"probability of label 1 is 1\.5"):
        weighed([0.5, 1.5])
