"""The curriculum over unfiltered pseudo-labels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curate.detections import as_categories
from curate.weighting.base import Age, Evidence
from curate.weighting.uda_cl import UDACurriculum

NAN = float("nan")


def taken(losses, e, rounds):
    """Return the weights of labels with these losses."""
    n = len(losses)
    labels = Evidence(np.zeros(n, int), as_categories(["Car"] * n), np.ones(n), np.array(losses))
    return UDACurriculum().weigh(labels, Age(e, rounds)).v.tolist()


def test_the_easiest_third_then_two_thirds_then_all():
    """Six labels over three rounds: the two, then four of least loss, then also the unmatched."""
    losses = [0.5, 0.1, NAN, 0.3, 2.0, NAN]
    assert taken(losses, 1, 3) == [0, 1, 0, 1, 0, 0]
    assert taken(losses, 2, 3) == [1, 1, 0, 1, 1, 0]
    assert taken(losses, 3, 3) == [1, 1, 1, 1, 1, 1]


def test_equal_losses_are_added_together():
    """Half of four includes one label of loss 0.1, but not the three of loss 0.2."""
    assert taken([0.2, 0.1, 0.2, 0.2], 1, 2) == [0, 1, 0, 0]
    assert taken([0.1, 0.1, 0.2, 0.2], 1, 2) == [1, 1, 0, 0]


def test_unmatched_labels_are_added_in_the_last_round():
    """They count as hardest, even if there are no others."""
    assert taken([NAN, NAN, NAN], 2, 3) == [0, 0, 0]
    assert taken([NAN, NAN, NAN], 3, 3) == [1, 1, 1]


@given(
    st.lists(st.one_of(st.just(NAN), st.floats(0, 5)), max_size=30),
    st.integers(1, 7).flatmap(lambda rounds: st.tuples(st.integers(1, rounds), st.just(rounds))),
)
def test_never_more_than_the_share_and_never_a_harder_one_first(losses, age):
    """For any losses; the last round takes all."""
    e, rounds = age
    weights = np.array(taken(losses, e, rounds))
    assert weights.sum() * rounds <= len(losses) * e
    hard = np.nan_to_num(np.array(losses), nan=np.inf)
    if weights.any() and not weights.all():
        assert hard[weights == 1].max() < hard[weights == 0].min()
    if e == rounds:
        assert weights.all()


@pytest.mark.parametrize("rounds", [3, 7, 49])
def test_the_share_is_exact_despite_rounding(rounds):
    """Round e of E takes exactly e of E labels with different losses."""
    losses = np.random.default_rng(0).permutation(rounds).astype(float)
    for e in range(1, rounds + 1):
        assert sum(taken(losses, e, rounds)) == e
