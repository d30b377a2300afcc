"""The exponent that gives weights a precision."""

import numpy as np
import pytest

from curate.calibration.sharpening import Sharpening, sharpen

P = np.random.default_rng(0).beta(0.3, 1.2, 2000)


@pytest.mark.parametrize("precision", [0.6, 0.7, 0.8, 0.9])
def test_gamma_is_that_of_a_search(precision: float):
    """Over a fine grid, the first that reaches the precision."""
    grid = np.arange(1.0, 20.0, 0.005)
    reached = np.array([(P ** (g + 1)).sum() / (P**g).sum() for g in grid])
    found = sharpen(P, precision)
    assert found.gamma == pytest.approx(grid[np.argmax(reached >= precision)], abs=0.006)
    assert found.precision == pytest.approx(precision)


def test_two_labels_by_hand():
    """For p = 1/2 and 1: (1 + 2^-(g+1)) / (1 + 2^-g) = 0.9 at 2^-g = 1/4."""
    p = np.array([0.5, 1.0])
    found = sharpen(p, 0.9)
    assert found.gamma == pytest.approx(2)
    assert found.weights(p) == pytest.approx([0.25, 1])


def test_gamma_is_at_least_1():
    """Weights p that are more precise than requested stay as they are."""
    p = np.array([0.9, 0.95])
    found = sharpen(p, 0.5)
    assert (found.gamma, found.precision) == (1, pytest.approx((p**2).sum() / p.sum()))


def test_a_precision_out_of_reach_leaves_the_best_label_a_weight():
    """The greatest precision with a weight of 0.1 for the most probable label."""
    p = np.array([0.1, 0.3, 0.6])
    found = sharpen(p, 0.8)
    assert 0.6**found.gamma == pytest.approx(0.1)
    assert 0.5 < found.precision < 0.6
    assert found.weights(p)[-1] == pytest.approx(0.1)
    assert sharpen(np.full(3, 0.2), 0.8).precision == pytest.approx(0.2)


@pytest.mark.parametrize("p", [[], [0.0], [1.0], [0.0, 1.0], [1e-300, 1e-200], [1 - 1e-16, 0.3]])
def test_extreme_probabilities(p: list[float]):
    """Weights stay in [0, 1]."""
    weights = sharpen(np.array(p), 0.8).weights(np.array(p))
    assert ((weights >= 0) & (weights <= 1)).all()


def test_small_weights_become_0():
    """Below 0.01."""
    weights = Sharpening(2.0, 0.8).weights(np.array([0.0999, 0.1001, 0.5]))
    assert weights == pytest.approx([0, 0.01002, 0.25], abs=1e-5)
