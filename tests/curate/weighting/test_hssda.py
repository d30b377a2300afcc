"""Two thresholds from the data."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curate.detections import as_categories
from curate.errors import ConfigError
from curate.weighting.base import Age, Evidence
from curate.weighting.hssda import HSSDA, two_centres

NAN = float("nan")


def labels(scores, losses, category=None):
    """Return labels of one frame, by default cars."""
    n = len(scores)
    return Evidence(
        np.zeros(n, int), as_categories(category or ["Car"] * n), np.array(scores, dtype=float),
        np.array(losses, dtype=float),
    )  # fmt: skip


def test_two_clusters_by_hand():
    """0.1, 0.2 | 0.8, 0.9, 1.0: their means; one value more moves the border."""
    assert two_centres(np.array([0.9, 0.1, 1.0, 0.2, 0.8])) == pytest.approx((0.15, 0.9))
    assert two_centres(np.array([0.0, 0.0, 0.0, 1.0])) == pytest.approx((0.0, 1.0))
    assert two_centres(np.full(7, 0.1)) == (0.1, 0.1)
    assert two_centres(np.array([0.5, 0.6])) == (-np.inf, np.inf)


@given(st.lists(st.floats(0, 1), min_size=3, max_size=12))
def test_no_other_split_has_less_variance_within(values):
    """Against all splits of the sorted values."""
    ordered = np.sort(values)

    def within(split):
        return sum(((part - part.mean()) ** 2).sum() for part in split)

    splits = [(ordered[:i], ordered[i:]) for i in range(1, len(ordered))]
    low, high = two_centres(np.array(values))
    assert ordered[0] <= low <= high <= ordered[-1]
    nearest = np.minimum((ordered - low) ** 2, (ordered - high) ** 2).sum()
    assert nearest <= min(map(within, splits)) + 1e-9


def test_certain_ambiguous_and_poor_labels():
    """The scores cluster at 0.2 and 0.8, the agreements exp(-L) at 0.25 and 0.75."""
    agreement = np.array([0.80, 0.80, 0.70, 0.70, 0.30, 0.30, 0.20, 0.20])
    scores = np.array([0.85, 0.75, 0.85, 0.75, 0.25, 0.15, 0.25, 0.15])
    weights = HSSDA().weigh(labels(scores, -np.log(agreement)), Age(1, 3))
    # Above both centres; below one of the high ones; below one of the low ones.
    assert weights.v == pytest.approx([1.0, 0.75, 0.85, 0.75, 0.25, 0, 0, 0])
    assert weights.dropped.tolist() == [False] * 5 + [True] * 3
    ignored = HSSDA("ignore").weigh(labels(scores, -np.log(agreement)), Age(1, 3))
    assert ignored.v.tolist() == [1, 0, 0, 0, 0, 0, 0, 0]
    assert ignored.dropped.tolist() == weights.dropped.tolist()


def test_unmatched_labels_are_dropped_and_do_not_move_thresholds():
    """However high their score."""
    matched = labels([0.9, 0.8, 0.2, 0.1], [0.1, 0.2, 1.0, 2.0])
    more = labels([0.9, 0.8, 0.2, 0.1, 1.0, 1.0], [0.1, 0.2, 1.0, 2.0, NAN, NAN])
    alone, together = (HSSDA().weigh(of, Age(1, 3)) for of in (matched, more))
    assert together.v[:4].tolist() == alone.v.tolist()
    assert together.dropped[4:].all()


def test_categories_have_their_own_thresholds():
    """The thresholds of pedestrians do not depend on cars."""
    scores, losses = [0.9, 0.9, 0.8, 0.3, 0.3, 0.2], [0.1, 0.1, 0.2, 0.5, 0.5, 0.9]
    names = ["Car"] * 3 + ["Pedestrian"] * 3
    weights = HSSDA().weigh(labels(scores, losses, names), Age(1, 3))
    assert weights.v[3] == weights.v[4] == 1.0
    assert all(one >= other for one, other in pairwise(weights.v[:3]))


def test_labels_of_a_rare_category_are_ambiguous():
    """Two matched labels give no clusters: their weight is the score.

    An unmatched one is dropped.
    """
    weights = HSSDA().weigh(labels([0.9, 0.4, 0.5], [0.1, 0.2, NAN]), Age(1, 3))
    assert weights.v.tolist() == [0.9, 0.4, 0.0]
    assert weights.dropped.tolist() == [False, False, True]


def test_an_unknown_setting_is_rejected():
    """The error lists the known ones."""
    with pytest.raises(ConfigError, match=r"hssda.*hard.*soft or ignore"):
        HSSDA("hard")
