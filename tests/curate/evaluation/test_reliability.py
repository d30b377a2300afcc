"""Reliability: correct and wrong labels, and how well weights separate them."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracles import ranking

from curate.detections import Annotations, Detections, as_categories
from curate.errors import ConfigError
from curate.evaluation.reliability import (
    MatchSettings,
    auroc,
    average_precision,
    chance_calibration_errors,
    expected_calibration_error,
    match_to_ground_truth,
    reliability_bins,
    weighted_precision,
    weighted_recall,
)


def car_at(x, y=0.0, length=4.0, z=0.0):
    """Return a box of that length, 2 m wide."""
    return [x, y, z, length, 2.0, 1.5, 0.0]


def labels(boxes, scores=None, categories=None):
    """Return labels of cars by default, with falling scores."""
    n = len(boxes)
    return Detections(
        np.reshape(np.array(boxes, dtype=np.float64), (n, 7)),
        np.linspace(0.9, 0.5, n) if scores is None else np.array(scores),
        as_categories(["Car"] * n if categories is None else categories),
    )


def truth(boxes, categories=None, boxes_2d=None):
    """Return ground truth of cars by default."""
    n = len(boxes)
    return Annotations(
        np.reshape(np.array(boxes, dtype=np.float64), (n, 7)),
        as_categories(["Car"] * n if categories is None else categories),
        np.zeros(n),
        np.zeros(n, dtype=np.int64),
        np.zeros(n),
        np.zeros((n, 4)) if boxes_2d is None else np.array(boxes_2d, dtype=np.float64),
    )


def test_a_label_is_correct_above_the_minimum_iou_of_its_category():
    """A shift of 0.8 m along 4 m is an IoU of 2/3: enough for a cyclist, not for a car."""
    shifted = [car_at(0.8), car_at(20.8)]
    found = match_to_ground_truth(
        labels(shifted, categories=["Car", "Cyclist"]),
        truth([car_at(0), car_at(20)], ["Car", "Cyclist"]),
    )
    assert found.correct.tolist() == [False, True]
    assert found.matched.tolist() == [-1, 1]
    assert found.iou == pytest.approx([2 / 3, 2 / 3])
    assert found.counted.tolist() == [True, True]
    assert found.ground_truths == {"Car": 1, "Pedestrian": 0, "Cyclist": 1}


def test_an_iou_equal_to_the_minimum_is_wrong():
    """The IoU must exceed it."""
    settings_ = MatchSettings(minimum_iou={"Car": 1.0})
    assert not match_to_ground_truth(labels([car_at(0)]), truth([car_at(0)]), settings_).correct[0]


def test_height_counts_only_in_3d():
    """The same footprint 0.5 m higher: correct in BEV, wrong in 3D."""
    lifted = labels([car_at(0, z=0.5)])
    assert match_to_ground_truth(lifted, truth([car_at(0)]), MatchSettings(overlap="bev")).correct[
        0
    ]
    assert not match_to_ground_truth(
        lifted, truth([car_at(0)]), MatchSettings(overlap="3d")
    ).correct[0]


def test_a_second_label_on_the_same_object_is_wrong():
    """The higher score takes the object, whatever the order of the labels."""
    twice = labels([car_at(0), car_at(0.2)], scores=[0.4, 0.6])
    found = match_to_ground_truth(twice, truth([car_at(0)]))
    assert found.correct.tolist() == [False, True]
    assert found.counted.tolist() == [True, True]


def test_a_label_takes_the_object_that_fits_best():
    """Two objects qualify; the larger overlap wins and leaves the other free."""
    objects = truth([car_at(0.4), car_at(0.0)])
    found = match_to_ground_truth(labels([car_at(0.05), car_at(0.35)]), objects)
    assert found.matched.tolist() == [1, 0]


def test_another_category_is_not_a_match():
    """A perfect box with the wrong name is wrong."""
    found = match_to_ground_truth(labels([car_at(0)], categories=["Cyclist"]), truth([car_at(0)]))
    assert not found.correct[0]
    assert found.counted[0]


def test_a_label_on_a_neighbour_category_is_neutral_or_correct():
    """A car label on a van is neutral; with an option it counts as a car."""
    van = truth([car_at(0), car_at(20)], ["Van", "Car"])
    twice = labels([car_at(0), car_at(0.1), car_at(20)])
    neutral = match_to_ground_truth(twice, van)
    assert neutral.correct.tolist() == [False, False, True]
    assert neutral.counted.tolist() == [False, False, True]
    assert neutral.ground_truths["Car"] == 1
    right = match_to_ground_truth(twice, van, MatchSettings(neighbors_are="correct"))
    assert right.correct.tolist() == [True, False, True]
    assert right.counted.all()
    assert right.ground_truths["Car"] == 2


def test_labels_in_dont_care_regions_are_neutral():
    """By the share of their own rectangle; invisible labels and correct ones are counted."""
    regions = truth(
        [[np.nan] * 7, car_at(0)],
        ["DontCare", "Car"],
        [[0, 0, 10, 10], [0, 0, 0, 0]],
    )
    rectangles = np.array(
        [[0, 0, 4, 4], [6, 0, 14, 10], [5, 0, 14, 10], [np.nan] * 4, [0, 0, 4, 4]]
    )
    found = match_to_ground_truth(
        labels([car_at(0), car_at(30), car_at(40), car_at(50), car_at(60)]),
        regions,
        rectangles=rectangles,
    )
    assert found.correct.tolist() == [True, False, False, False, False]
    # 4 of 8 pixels of width are exactly half, which is not more than half.
    assert found.counted.tolist() == [True, True, False, True, False]


@pytest.mark.parametrize("n", [0, 2])
@pytest.mark.parametrize("m", [0, 2])
def test_empty_frames_are_evaluated(n, m):
    """No labels, no objects, or neither."""
    boxes = [car_at(0), car_at(20)]
    found = match_to_ground_truth(labels(boxes[:n]), truth(boxes[:m]), rectangles=np.zeros((n, 4)))
    assert found.correct.tolist() == [m > 0] * n
    assert found.counted.all()
    assert found.ground_truths["Car"] == m


def test_a_category_without_minimum_iou_is_reported():
    with pytest.raises(ConfigError, match="Tram"):
        match_to_ground_truth(labels([car_at(0)], categories=["Tram"]), truth([]))


@pytest.mark.parametrize("wrong", [{"overlap": "image"}, {"neighbors_are": "wrong"}])
def test_unknown_options_are_rejected(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        MatchSettings(**wrong)


@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.integers(0, 12), st.sampled_from([0.2, 0.5, 0.9])), max_size=8),
    st.lists(st.integers(0, 12), max_size=6),
    st.randoms(use_true_random=False),
)
def test_matching_is_one_to_one_and_independent_of_order(rows, places, random):
    """Each object makes one label correct at most; shuffled labels get the same results."""
    detections = labels([car_at(x / 4) for x, _ in rows], [score for _, score in rows])
    objects = truth([car_at(x / 4) for x in places])
    found = match_to_ground_truth(detections, objects)
    taken = found.matched[found.correct]
    assert len(set(taken)) == len(taken)
    order = np.array(random.sample(range(len(rows)), len(rows)), dtype=np.int64)
    again = match_to_ground_truth(detections.select(order), objects)
    outcome = sorted(zip(rows, found.correct, strict=True))
    assert outcome == sorted(zip([rows[i] for i in order], again.correct, strict=True))


WEIGHTED = st.lists(
    st.tuples(st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.9, 1.0]) | st.floats(0, 1), st.booleans()),
    min_size=1,
    max_size=25,
)


def columns(rows):
    """Return weights and correctness as arrays."""
    return np.array([row[0] for row in rows]), np.array([row[1] for row in rows], dtype=bool)


@given(WEIGHTED)
def test_auroc_is_the_share_of_ordered_pairs(rows):
    """Against every pair, ties counted half."""
    weights, right = columns(rows)
    assume(right.any() and not right.all())
    assert auroc(weights, right) == pytest.approx(ranking.auroc(weights, right))
    assert auroc(-weights, ~right) == pytest.approx(auroc(weights, right))


@given(WEIGHTED)
def test_average_precision_steps_over_distinct_weights(rows):
    """Against the definition, threshold by threshold; independent of the order of ties."""
    weights, right = columns(rows)
    assume(right.any())
    expected = ranking.average_precision(weights.tolist(), right.tolist())
    assert average_precision(weights, right) == pytest.approx(expected)
    assert average_precision(weights[::-1], right[::-1]) == pytest.approx(expected)


def test_weighted_precision_and_recall_worked_out():
    """Weight on correct labels over all weight, and over all objects."""
    weights, right = np.array([1.0, 0.5, 0.5, 0.0]), np.array([True, True, False, False])
    assert weighted_precision(weights, right) == 0.75
    assert weighted_recall(weights, right, 3) == 0.5


def test_a_perfect_weighting_scores_one():
    """Weights that separate correct from wrong labels, and weights that cannot."""
    right = np.array([True, True, False, False, False])
    assert auroc(np.array([0.9, 0.8, 0.7, 0.1, 0.0]), right) == 1.0
    assert average_precision(np.array([0.9, 0.8, 0.7, 0.1, 0.0]), right) == 1.0
    assert auroc(np.full(5, 0.3), right) == 0.5
    assert average_precision(np.full(5, 0.3), right) == pytest.approx(0.4)


@pytest.mark.parametrize("right", [[], [True, True], [False, False]])
def test_undefined_values_are_nan(right):
    """No labels, all correct, all wrong, no weight, no objects: NaN, never an exception."""
    right = np.array(right, dtype=bool)
    weights = np.full(len(right), 0.25)
    assert np.isnan(auroc(weights, right))
    assert np.isnan(average_precision(weights, right)) == (not right.any())
    assert np.isnan(weighted_precision(weights * 0, right))
    assert np.isnan(weighted_precision(weights, right)) == (len(right) == 0)
    assert np.isnan(weighted_recall(weights, right, 0))
    assert weighted_recall(weights, right, 2) == 0.25 * right.sum() / 2
    assert np.isnan(expected_calibration_error(weights, right)) == (len(right) == 0)
    assert np.isnan(reliability_bins(weights, right, 0).recall).all()


def test_bins_contain_their_lower_edge_and_the_last_one_its_upper():
    """Every weight in [0, 1] is in one bin; recall over the bins adds up."""
    weights = np.array([0.0, 0.09, 0.1, 0.3, 0.7, 0.95, 1.0])
    right = np.array([False, False, True, False, True, True, True])
    table = reliability_bins(weights, right, 8)
    assert table.labels.tolist() == [2, 1, 0, 1, 0, 0, 0, 1, 0, 2]
    assert table.precision[[0, 1, 3, 7, 9]].tolist() == [0, 1, 0, 1, 1]
    assert np.isnan(table.precision[2])
    assert table.mean_weight[9] == pytest.approx(0.975)
    assert table.recall.sum() == pytest.approx(4 / 8)


def test_calibration_error_worked_out():
    """Two bins: weights 0.2 with a quarter correct, weights 0.8 all correct."""
    weights = np.array([0.2] * 4 + [0.8] * 4)
    right = np.array([True, False, False, False] + [True] * 4)
    assert expected_calibration_error(weights, right) == pytest.approx(0.5 * 0.05 + 0.5 * 0.2)


def test_calibrated_weights_have_a_small_error_and_overconfident_ones_a_large_one():
    """Labels are correct with the probability of their weight."""
    generator = np.random.default_rng(11)
    weights = generator.random(20_000)
    right = generator.random(20_000) < weights
    assert expected_calibration_error(weights, right) < 0.02
    assert expected_calibration_error(weights**0.25, right) > 0.2


def simulated_errors(weights, simulations, seed):
    """Return the calibration errors of labels that are each drawn by themselves."""
    generator = np.random.default_rng(seed)
    return np.array(
        [
            expected_calibration_error(weights, generator.random(len(weights)) < weights)
            for _ in range(simulations)
        ]
    )


@pytest.mark.parametrize(
    "weights",
    [
        np.array([0.3, 0.72, 0.78, 0.95]),
        np.linspace(0, 1, 60) ** 2,
        np.random.default_rng(5).random(300),
        np.concatenate([np.full(400, 0.001), [0.05, 0.09, 0.5], np.ones(50)]),
    ],
)
def test_the_error_by_chance_is_that_of_labels_drawn_one_by_one(weights):
    """Mean and 95 % quantile, within the error of 2,000 simulations."""
    slow = simulated_errors(weights, 2000, 0)
    fast = chance_calibration_errors(weights, np.random.default_rng(1), 20_000)
    assert fast.mean() == pytest.approx(slow.mean(), rel=0.04)
    assert np.quantile(fast, 0.95) == pytest.approx(np.quantile(slow, 0.95), rel=0.06)


def test_the_error_by_chance_of_one_label_by_hand():
    """A label of 0.2 is wrong in 80 % of cases, with an error of 0.2; else the error is 0.8."""
    found = chance_calibration_errors(np.array([0.2]), np.random.default_rng(0), 10_000)
    assert set(np.round(found, 9)) == {0.2, 0.8}
    assert found.mean() == pytest.approx(0.8 * 0.2 + 0.2 * 0.8, rel=0.03)


def test_certain_weights_have_no_error_by_chance():
    """0 and 1 leave nothing to chance; without labels or measurement it is undefined."""
    generator = np.random.default_rng(0)
    assert not chance_calibration_errors(np.array([0.0, 1.0, 1.0]), generator).any()
    assert np.isnan(chance_calibration_errors(np.zeros(0), generator)).all()
    assert np.isnan(chance_calibration_errors(np.full(3, np.nan), generator)).all()
