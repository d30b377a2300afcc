"""Conformal p-values of labels in units, and the selection with a bound."""

import numpy as np
import pytest

from curate.calibration.conformal import HeldOut, benjamini_hochberg, least_bound, p_values


def held_out(wrong: list[float], units: int) -> HeldOut:
    """Return held-out units with some wrong labels."""
    return HeldOut("frame", units, np.sort(wrong))


def test_p_values_by_hand():
    """Nine held-out frames, and two frames of two labels each: (a + b) / (10 * 2)."""
    found = p_values(
        held_out([0.2, 0.5, 0.5, 0.8], 9), np.array([0.9, 0.5, 0.5, 0.1]), np.array([7, 7, 3, 3])
    )
    # 0.9 in frame 7: no held-out label above, first in its frame. 0.5 there: three, second.
    assert found == pytest.approx(np.array([0 + 1, 3 + 2, 3 + 1, 4 + 2]) / 20)


def test_one_label_per_unit_gives_the_p_value_of_jin_and_candes():
    """(1 + number of wrong ones with at least this probability) / (n + 1)."""
    rng = np.random.default_rng(0)
    p, wrong = rng.random(40), rng.random(15)
    expected = (1 + (wrong[None] >= p[:, None]).sum(axis=1)) / 31
    assert p_values(held_out(wrong.tolist(), 30), p, np.arange(40)) == pytest.approx(expected)


def test_equal_probabilities_count_against_each_other():
    """Two equal labels of a frame have rank 2, both."""
    found = p_values(held_out([], 3), np.array([0.5, 0.5, 0.7]), np.zeros(3, int))
    assert found == pytest.approx(np.array([3, 3, 1]) / 12)


def test_ranks_are_those_of_a_loop():
    """With many ties."""
    rng = np.random.default_rng(1)
    p, unit = rng.integers(0, 6, 200) / 6, rng.integers(0, 15, 200)
    ranks = [((unit == u) & (p >= q)).sum() for q, u in zip(p, unit, strict=True)]
    divisor = (9 + 1) * 200 / len(np.unique(unit))
    assert p_values(held_out([], 9), p, unit) == pytest.approx(np.array(ranks) / divisor)


def test_the_step_of_benjamini_and_hochberg_by_hand():
    """Six p-values, at 0.1: 0.05 <= 0.1 * 3 / 6, though 0.04 > 0.1 * 2 / 6."""
    p = np.array([0.05, 0.04, 0.9, 0.01, 0.07, 0.6])
    assert benjamini_hochberg(p, 0.1).tolist() == [True, True, False, True, False, False]
    assert benjamini_hochberg(p, 0.05).tolist() == [False] * 6
    # 0.01 * 6 / 1 is the least bound that selects a label.
    assert least_bound(p) == pytest.approx(0.06)
    assert benjamini_hochberg(p, 0.0601).any()


def test_nothing_is_selected_without_labels():
    empty = np.zeros(0)
    assert p_values(held_out([0.5], 3), empty, empty.astype(int)).shape == (0,)
    assert benjamini_hochberg(empty, 0.1).shape == (0,)
    assert least_bound(empty) == np.inf


def test_few_held_out_units_allow_no_small_bound():
    """A further frame may be wrong altogether: with nine frames, one of ten."""
    p, unit = np.full(100, 0.99), np.arange(100)
    assert least_bound(p_values(held_out([], 9), p, unit)) == pytest.approx(0.1)
    assert least_bound(p_values(held_out([], 4), p, unit)) == pytest.approx(0.2)


def test_neutral_labels_count_as_labels_of_their_unit():
    """A frame with neither a correct nor a wrong label is a unit all the same."""
    found = HeldOut.of_labels(
        "sequence", np.array([1, 1, 2]), np.array([0.9, 0.2, 0.3]), np.array([False, True, False])
    )
    assert (found.unit, found.units, found.wrong.tolist()) == ("sequence", 2, [0.2])


SPLITS = 300
BOUND = 0.1


def dependent(rng: np.random.Generator, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frame, probability and truth of labels: each frame has an effect that p misses."""
    frame = np.repeat(np.arange(frames), rng.poisson(8, frames))
    z = 3.0 * rng.normal(size=len(frame)) - 2.0 + 1.5 * rng.normal(size=frames)[frame]
    effect = 2.0 * rng.normal(size=frames)[frame]
    correct = rng.random(len(frame)) < 1 / (1 + np.exp(-z - effect))
    return frame, 1 / (1 + np.exp(-z)), correct


def clustered(rng: np.random.Generator, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return labels of which all in a frame are equal: the strongest dependence."""
    frame = np.repeat(np.arange(frames), rng.poisson(8, frames))
    z = 4.0 * rng.normal(size=frames)
    correct = rng.random(frames) < 1 / (1 + np.exp(-z))
    return frame, (1 / (1 + np.exp(-z)))[frame], correct[frame]


def confident(rng: np.random.Generator, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return labels of which a frame in thirty has many that are confident, and all wrong."""
    odd = rng.random(frames) < 1 / 30
    frame = np.repeat(np.arange(frames), np.where(odd, 30, rng.poisson(6, frames)))
    z = 3.0 * rng.normal(size=len(frame)) + np.where(odd[frame], 2.0, 0.0)
    correct = (rng.random(len(frame)) < 1 / (1 + np.exp(-z))) & ~odd[frame]
    return frame, 1 / (1 + np.exp(-z)), correct


@pytest.mark.parametrize("draw", [dependent, clustered, confident])
@pytest.mark.parametrize(("calibration", "unlabeled"), [(25, 50), (60, 100)])
def test_the_mean_share_of_wrong_labels_stays_below_the_bound(draw, calibration, unlabeled):
    """Over random splits of frames, whose labels depend on each other, within its error."""
    rng = np.random.default_rng(calibration)
    shares = np.zeros(SPLITS)
    for split in range(SPLITS):
        frame, p, correct = draw(rng, calibration + unlabeled)
        known = frame < calibration
        reference = HeldOut.of_labels("frame", frame[known], p[known], ~correct[known])
        values = p_values(reference, p[~known], frame[~known])
        selected = benjamini_hochberg(values, BOUND)
        shares[split] = (~correct[~known] & selected).sum() / max(selected.sum(), 1)
    assert shares.mean() <= BOUND + 2 * shares.std() / np.sqrt(SPLITS)


def test_labels_of_a_frame_are_not_independent():
    """With a unit per label, as if they were, the bound does not hold for equal labels."""
    rng = np.random.default_rng(0)
    shares = np.zeros(SPLITS)
    for split in range(SPLITS):
        frame, p, correct = clustered(rng, 75)
        known = frame < 25
        each = np.arange(len(frame))
        reference = HeldOut.of_labels("frame", each[known], p[known], ~correct[known])
        selected = benjamini_hochberg(p_values(reference, p[~known], each[~known]), BOUND)
        shares[split] = (~correct[~known] & selected).sum() / max(selected.sum(), 1)
    assert shares.mean() > BOUND + 2 * shares.std() / np.sqrt(SPLITS)


def test_the_power_approaches_that_of_a_threshold_tuned_on_truth():
    """With a hundred frames of independent labels, at least three quarters of it."""
    rng = np.random.default_rng(3)
    found, best = [], []
    for _ in range(50):
        frame = np.repeat(np.arange(300), 8)
        z = 3.0 * rng.normal(size=len(frame)) - 2.0
        p = 1 / (1 + np.exp(-z))
        correct = rng.random(len(frame)) < p
        known = frame < 100
        reference = HeldOut.of_labels("frame", frame[known], p[known], ~correct[known])
        selected = benjamini_hochberg(p_values(reference, p[~known], frame[~known]), BOUND)
        truth = correct[~known][np.argsort(-p[~known])]
        allowed = np.flatnonzero(np.cumsum(~truth) <= BOUND * np.arange(1, len(truth) + 1))
        found.append((selected & correct[~known]).sum() / truth.sum())
        best.append(truth[: allowed[-1] + 1].sum() / truth.sum())
    assert np.mean(found) > 0.75 * np.mean(best)
