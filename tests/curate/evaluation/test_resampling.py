"""The fast bootstrap against copied labels and draws by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from curate.evaluation.audit import Estimate
from curate.evaluation.reliability import auroc, average_precision
from curate.evaluation.resampling import draw_frames, ranked_replicates


def test_a_draw_has_as_many_frames_as_there_are():
    """With replacement: some twice, some not at all."""
    draws = draw_frames(np.random.default_rng(0), 12, 50)
    assert draws.shape == (50, 12)
    assert set(draws.sum(axis=1)) == {12}
    assert draws.max() > 1
    assert draws.min() == 0


def test_the_same_seed_gives_the_same_draws():
    """Another seed gives others."""
    one, same, other = (draw_frames(np.random.default_rng(seed), 9, 20) for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_multiplicities_by_hand():
    """Frame 0 has correct label 0.9 and wrong label 0.5, frame 1 has correct label 0.2.

    Once each: the pairs are (0.9, 0.5) won and (0.2, 0.5) lost. Frame 1 twice: 1 of 3 pairs won;
    precision is 1 at the first correct label and 3/4 at the other two.
    """
    weights, right = np.array([0.9, 0.5, 0.2]), np.array([True, False, True])
    draws = np.array([[1.0, 1.0], [1.0, 2.0], [0.0, 2.0]])
    found, area = ranked_replicates(weights, right, np.array([0, 0, 1]), draws)
    assert found[:2] == pytest.approx([1 / 2, 1 / 3])
    assert np.isnan(found[2])
    assert area == pytest.approx([(1 + 2 / 3) / 2, (1 + 3 / 4 + 3 / 4) / 3, 1])


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(0, 25))
def test_it_equals_the_values_of_copied_labels(seed, n):
    """Ties, empty frames, draws without a correct or without a wrong label."""
    generator = np.random.default_rng(seed)
    weights = generator.choice([0.0, 0.2, 0.2, 0.7, generator.random()], n)
    right, frame = generator.random(n) < 0.4, generator.integers(6, size=n)
    draws = draw_frames(generator, 6, 10)
    found, area = ranked_replicates(weights, right, frame, draws)
    for replicate, times in enumerate(draws.astype(int)):
        copies = np.repeat(np.arange(n), times[frame])
        expected = (
            auroc(weights[copies], right[copies]),
            average_precision(weights[copies], right[copies]),
        )
        assert (found[replicate], area[replicate]) == pytest.approx(expected, nan_ok=True)


def test_its_interval_is_that_of_the_general_bootstrap():
    """The same statistic over as many draws of another generator, within sampling error."""
    generator = np.random.default_rng(3)
    right, frame = generator.random(300) < 0.5, generator.integers(40, size=300)
    weights = np.clip(0.5 * right + generator.normal(0.3, 0.3, 300), 0, 1)
    fast, _ = ranked_replicates(weights, right, frame, draw_frames(generator, 40, 2000))
    slow = np.empty(2000)
    for replicate in range(2000):
        drawn = generator.integers(40, size=40)
        labels = np.concatenate([np.flatnonzero(frame == each) for each in drawn])
        slow[replicate] = auroc(weights[labels], right[labels])
    ours, theirs = (Estimate.of(0.0, replicates, 0.95) for replicates in (fast, slow))
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=0.01)


def test_no_frames_have_no_values():
    """Every replicate is undefined."""
    draws = draw_frames(np.random.default_rng(0), 0, 5)
    nothing = np.zeros(0)
    found, area = ranked_replicates(nothing, nothing.astype(bool), nothing.astype(int), draws)
    assert np.isnan(found).all()
    assert np.isnan(area).all()
    nowhere = Estimate.of(np.nan, found, 0.95)
    assert np.isnan([nowhere.low, nowhere.high]).all()
