"""Weighted precision at equal weighted recall, against values by hand and a slow search."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from curate.evaluation.equal_recall import (
    equal_recall_power,
    equal_recall_precision,
    equal_recall_replicates,
    power_sums,
)
from curate.evaluation.resampling import draw_frames

WEIGHTS, CORRECT = np.array([0.9, 0.5, 0.4, 0.1]), np.array([True, True, False, False])


def precision(weights, correct, target):
    """Return the precision at the power that gives the correct labels the target."""
    return equal_recall_precision(weights, correct, equal_recall_power(weights, correct, target))


def by_bisection(weights, correct, target):
    """Return the precision after 200 halvings of the range of powers."""
    low, high = 0.0, 1e6
    for _ in range(200):
        middle = (low + high) / 2
        above = (weights[correct] ** middle).sum() > target
        low, high = (middle, high) if above else (low, middle)
    sharpened = weights**low
    return sharpened[correct].sum() / sharpened.sum()


def random_labels(seed, n, correct=0.4):
    """Return weights in (0, 1), correctness and frames of n labels."""
    generator = np.random.default_rng(seed)
    right = generator.random(n) < correct
    weights = np.clip(0.4 * right + 0.6 * generator.random(n), 0.001, 0.999)
    return weights, right, generator.integers(8, size=n)


def test_the_power_and_the_precision_by_hand():
    """At power 1 the correct labels have 0.9 + 0.5, at power 2 they have 0.81 + 0.25."""
    assert equal_recall_power(WEIGHTS, CORRECT, 1.4) == pytest.approx(1)
    assert precision(WEIGHTS, CORRECT, 1.4) == pytest.approx(1.4 / 1.9)
    assert equal_recall_power(WEIGHTS, CORRECT, 1.06) == pytest.approx(2)
    assert precision(WEIGHTS, CORRECT, 1.06) == pytest.approx(1.06 / (1.06 + 0.16 + 0.01))


def test_sharper_weights_of_the_same_ranking_are_no_better():
    """v, v^2 and v^0.3 have different precisions, and the same one at equal recall."""
    weights, right, _ = random_labels(0, 50)
    found = [precision(weights**power, right, 3.0) for power in (1, 2, 0.3)]
    assert found == pytest.approx([found[0]] * 3)
    plain = [(w := weights**power)[right].sum() / w.sum() for power in (1, 2, 0.3)]
    assert np.ptp(plain) > 0.1


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.floats(0.01, 0.99))
def test_the_recall_is_that_of_the_reference(seed, n, share):
    """For every target within the range; the precision equals that of a slow search."""
    weights, right, _ = random_labels(seed, n)
    assume(right.any())
    target = share * right.sum()
    power = equal_recall_power(weights, right, target)
    assert (weights[right] ** power).sum() == pytest.approx(target)
    expected = by_bisection(weights, right, target)
    assert equal_recall_precision(weights, right, power) == pytest.approx(expected)


def test_steps_keep_their_precision_below_their_recall_and_have_none_above():
    """Two of three labels of weight 1 are correct, one correct label has no weight."""
    steps, right = np.array([1.0, 1, 1, 0, 0]), np.array([True, True, False, True, False])
    assert equal_recall_power(steps, right, 1.5) == np.inf
    assert precision(steps, right, 1.5) == pytest.approx(2 / 3)
    assert precision(steps, right, 2.0) == pytest.approx(2 / 3)
    assert np.isnan(precision(steps, right, 2.1))


def test_the_largest_recall_counts_every_label_with_weight():
    """At power 0, four of five labels have weight, and half of them are correct."""
    weights = np.append(WEIGHTS, 0.0)
    right = np.append(CORRECT, True)
    assert equal_recall_power(weights, right, 2.0) == pytest.approx(0, abs=1e-9)
    assert precision(weights, right, 2.0) == pytest.approx(1 / 2)


@pytest.mark.parametrize("target", [0.0, 2.5, np.nan])
def test_targets_that_cannot_be_reached_are_undefined(target):
    assert np.isnan(precision(WEIGHTS, CORRECT, target))


def test_weights_that_were_not_measured_are_undefined():
    assert np.isnan(precision(np.full(4, np.nan), CORRECT, 1.0))


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(100, 200), st.floats(0.2, 0.8))
def test_replicates_equal_those_of_copied_labels(seed, n, share):
    """Each draw is solved again for its own target; 0.002 off in the mean, 0.02 at most."""
    weights, right, frame = random_labels(seed, n)
    reference = weights**2 * share
    power = equal_recall_power(weights, right, reference[right].sum())
    assume(np.isfinite(power))
    draws = draw_frames(np.random.default_rng(seed), 8, 20)
    target = draws @ np.bincount(frame, reference * right, 8)
    found = equal_recall_replicates(draws @ power_sums(weights, right, frame, 8, power), target)
    copies = [np.repeat(np.arange(n), times[frame]) for times in draws.astype(int)]
    expected = [precision(weights[k], right[k], of) for k, of in zip(copies, target, strict=True)]
    assert found == pytest.approx(expected, abs=0.02, nan_ok=True)
    assert np.nanmean(np.abs(found - expected)) < 0.002


def test_the_replicate_of_the_sample_itself_is_exact():
    """Every frame once; also for steps, whose power is infinite."""
    weights, right, frame = random_labels(3, 60)
    once = np.ones((1, 8))
    for v in (weights, (weights > 0.5).astype(float)):
        target = 0.3 * v[right].sum()
        power = equal_recall_power(v, right, target)
        sums = once @ power_sums(v, right, frame, 8, power)
        [found] = equal_recall_replicates(sums, np.array([target]))
        assert found == pytest.approx(precision(v, right, target))


def test_draws_outside_the_range_are_undefined_or_at_the_limit():
    """No correct label drawn, a target above the range, and one below the weights of 1."""
    sums = power_sums(np.array([1.0, 1.0, 0.5]), np.array([True, False, True]), np.zeros(3, int),
                      1, 1.0)  # fmt: skip
    found = equal_recall_replicates(
        np.stack([sums[0] * 0, sums[0], sums[0], sums[0]]), np.array([1.0, 2.1, 0.5, 0.0])
    )
    assert np.isnan(found[[0, 1, 3]]).all()
    assert found[2] == pytest.approx(1 / 2)
