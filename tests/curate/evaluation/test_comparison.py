"""Means, spreads and paired differences against values by hand."""

import numpy as np
import pytest

from curate.evaluation.comparison import paired_difference, spread


def test_spread_is_the_mean_and_the_sample_standard_deviation() -> None:
    """1, 2, 3: mean 2, squared deviations 1 + 0 + 1 over n - 1 = 2."""
    found = spread(np.array([1.0, 2.0, 3.0]))
    assert (found.mean, found.std, found.count) == (2.0, 1.0, 3)


def test_missing_values_are_left_out() -> None:
    """A cell that is not finished; one value has no spread, none has no mean."""
    found = spread(np.array([4.0, np.nan]))
    assert (found.mean, found.count) == (4.0, 1)
    assert np.isnan(found.std)
    assert np.isnan(spread(np.array([np.nan])).mean)


def test_the_interval_of_a_paired_difference_is_students_t() -> None:
    """Differences 1, 2, 3: 2 ± 4.3027 * 1 / sqrt(3), the quantile of the printed t table."""
    found = paired_difference(np.array([11.0, 22.0, 33.0]), np.array([10.0, 20.0, 30.0]))
    assert found.mean == 2.0
    assert found.high - found.mean == pytest.approx(4.3027 / np.sqrt(3), abs=1e-3)
    assert found.mean - found.low == pytest.approx(found.high - found.mean)


def test_the_common_effect_of_a_seed_cancels() -> None:
    """Two methods that differ by 1 on seeds that differ by 100: the interval has no width."""
    seeds = np.array([0.0, 100.0, 200.0])
    found = paired_difference(seeds + 1, seeds)
    assert (found.low, found.mean, found.high) == pytest.approx((1.0, 1.0, 1.0))


def test_only_pairs_count() -> None:
    """A seed that one of the two has not finished is left out; one pair has no interval."""
    found = paired_difference(np.array([3.0, 9.0]), np.array([1.0, np.nan]))
    assert (found.mean, found.count) == (2.0, 1)
    assert np.isnan([found.low, found.high]).all()


def test_the_coverage_of_the_interval_is_its_level() -> None:
    """4,000 experiments of 3 pairs with normally distributed differences around 5."""
    values = np.random.default_rng(0).normal(5, 2, (4000, 3))
    found = [paired_difference(row, np.zeros(3)) for row in values]
    covered = np.mean([each.low <= 5 <= each.high for each in found])
    assert covered == pytest.approx(0.95, abs=0.012)
