"""Evidence, age and weights, which policies share."""

import numpy as np
import pytest

from curate.detections import as_categories
from curate.errors import ConfigError, DataError
from curate.weighting.base import Age, Evidence, Weights


def evidence(**changes):
    """Return two labels with valid evidence, except for the changes."""
    columns = {
        "frame_index": np.array([0, 4]),
        "category": as_categories(["Car", "Cyclist"]),
        "score": np.array([0.1, 0.9]),
        "loss": np.array([0.5, np.nan]),
        "rho": {"rho_diff": np.array([0.5, 1.0]), "rho_anno": np.array([0.4, 0.3])},
    }
    return Evidence(**columns | changes)


def test_rho_det_is_the_product_of_the_priors():
    """Of both, of any number, and 1 without a prior."""
    assert evidence().rho_det == pytest.approx([0.2, 0.3])
    third = evidence().rho | {"rho_third": np.array([0.5, 0.5])}
    assert evidence(rho=third).rho_det == pytest.approx([0.1, 0.15])
    assert evidence(rho={}).rho_det.tolist() == [1.0, 1.0]


def test_rho_det_leaves_out_a_prior_that_has_not_scored():
    """NaN neither raises nor lowers the product."""
    half = {"rho_diff": np.array([0.5, np.nan]), "rho_anno": np.array([np.nan, np.nan])}
    assert evidence(rho=half).rho_det.tolist() == [0.5, 1.0]


def test_labels_with_a_loss_are_matched():
    """NaN means that no reprediction matched."""
    assert evidence().matched.tolist() == [True, False]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"score": np.array([0.1])}, "score"),
        ({"frame_index": np.zeros((2, 1))}, "frame_index"),
        ({"category": as_categories(["Car"])}, "category"),
        ({"rho": {"rho_diff": np.array([0.1, 0.2, 0.3])}}, "rho_diff"),
        ({"score": np.array([0.1, 1.1])}, r"score of label 1 is 1\.1"),
        ({"loss": np.array([-0.1, 0.0])}, r"loss of label 0 is -0\.1"),
        ({"loss": np.array([0.1, np.inf])}, "loss of label 1 is inf"),
        ({"rho": {"rho_anno": np.array([-1.0, 0.5])}}, "rho_anno of label 0"),
    ],
)
def test_evidence_out_of_shape_or_range_is_rejected(changes, message):
    """The error contains the column and the label."""
    with pytest.raises(DataError, match=message):
        evidence(**changes)


def test_age_is_the_share_of_rounds():
    """The share e/E reaches 1 in the last round."""
    assert Age(1, 4).share == 0.25
    assert Age(4, 4).share == 1.0


@pytest.mark.parametrize(("e", "rounds"), [(0, 3), (4, 3), (-1, 3), (1, 0)])
def test_rounds_that_do_not_exist_are_rejected(e, rounds):
    """Rounds count from 1 to E."""
    with pytest.raises(ConfigError, match=f"round {e} of {rounds}"):
        Age(e, rounds)


def test_weights_without_age_have_no_lambda():
    """NaN, so that the database stores null."""
    weights = Weights.without_age(np.array([0.0, 1.0]))
    assert np.isnan(weights.lambda_u).all()
    assert weights.lambda_u.shape == (2,)
