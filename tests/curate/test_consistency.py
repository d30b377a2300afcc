"""Consistency: matching and the loss between a prediction and its reprediction."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.assignment import best_total

from curate.consistency import (
    SCORE_FLOOR,
    ConsistencySettings,
    consistency,
    match,
    mean_over_views,
    residual,
    smooth_l1,
)
from curate.detections import Detections, as_categories
from curate.errors import ConfigError, ModelError
from curate.geometry.overlap import bev_iou
from curate.geometry.similarity import Similarity

CAR = [10.0, 2.0, -0.8, 4.0, 3.0, 1.5, 0.3]


def detections(boxes, scores=None, categories=None):
    """Return detections of cars with a score of 0.5 by default."""
    n = len(boxes)
    return Detections(
        np.reshape(np.array(boxes, dtype=np.float64), (n, 7)),
        np.full(n, 0.5) if scores is None else np.array(scores, dtype=np.float64),
        as_categories(["Car"] * n if categories is None else categories),
    )


def moved(box, **changes):
    """Return the box with some of its seven numbers shifted."""
    names = ("x", "y", "z", "length", "width", "height", "yaw")
    return [value + changes.get(name, 0.0) for name, value in zip(names, box, strict=True)]


@st.composite
def crowds(draw, largest=5):
    """Draw a few boxes so close together that most overlap, some of them exact copies."""
    places = st.tuples(
        st.integers(0, 4),
        st.integers(0, 2),
        st.sampled_from([0.0, 0.4, np.pi / 2]),
        st.sampled_from(["Car", "Cyclist"]),
        st.sampled_from([0.2, 0.5, 0.9]),
    )
    rows = draw(st.lists(places, max_size=largest))
    boxes = [[x, y, 0.0, 4.0, 2.0, 1.5, yaw] for x, y, yaw, _, _ in rows]
    return detections(boxes, [r[4] for r in rows], [r[3] for r in rows])


def test_identical_boxes_and_a_certain_score_have_no_loss():
    """L = 0 if the reprediction is identical and the score is 1."""
    found = consistency(detections([CAR]), detections([CAR], scores=[1.0]))
    assert found.matched.tolist() == [0]
    assert found.iou.tolist() == [1.0]
    assert found.loss.tolist() == [0.0]


def test_loss_is_score_loss_plus_twice_the_box_loss():
    """L = 1.0 * (-ln s') + 2.0 * sum smoothL1(residual), worked out by hand."""
    prediction, reprediction = CAR, moved(CAR, x=1.0, z=0.1)
    found = consistency(detections([prediction]), detections([reprediction], scores=[0.25]))
    far, near = 1.0 / 5.0, 0.1 / 1.5  # the diagonal of 4 x 3 is 5
    expected_box = (far - 0.5 / 9) + 0.5 * near**2 * 9
    assert found.score_loss[0] == pytest.approx(-np.log(0.25))
    assert found.box_loss[0] == pytest.approx(expected_box)
    assert found.loss[0] == pytest.approx(-np.log(0.25) + 2 * expected_box)


def test_weights_of_the_two_terms_are_settings():
    """The terms are stored without their weights, the loss contains them."""
    plain = consistency(detections([CAR]), detections([moved(CAR, y=0.5)]))
    weighed = consistency(
        detections([CAR]),
        detections([moved(CAR, y=0.5)]),
        ConsistencySettings(score_weight=3.0, box_weight=0.5),
    )
    assert weighed.score_loss[0] == plain.score_loss[0]
    assert weighed.box_loss[0] == plain.box_loss[0]
    assert weighed.loss[0] == pytest.approx(3 * plain.score_loss[0] + 0.5 * plain.box_loss[0])


def test_the_residual_is_relative_to_the_prediction():
    """The anchor is the prediction: its diagonal and height divide, its sizes are the base."""
    target = [11.0, 0.0, 0.2, 8.0, 1.5, 3.0, 0.3 + np.pi / 6]
    expected = [0.2, -0.4, 1 / 1.5, np.log(2), np.log(0.5), np.log(2), 0.5]
    assert residual(np.array([CAR]), np.array([target]))[0] == pytest.approx(expected)


def test_a_reversed_heading_has_no_loss():
    """The sine of the yaw difference ignores a half turn, as in SECOND."""
    turned = moved(CAR, yaw=np.pi)
    assert residual(np.array([CAR]), np.array([turned]))[0] == pytest.approx(np.zeros(7), abs=1e-12)


def test_smooth_l1_is_smooth_at_beta():
    """Parabola below beta, line above, equal in value and slope where they meet."""
    beta, step = 1 / 9, 1e-6
    at = smooth_l1(np.array([beta - step, beta, beta + step, 0.0, -2.0]), beta)
    assert at[1] == pytest.approx(beta / 2)
    assert (at[1] - at[0]) / step == pytest.approx(1.0, rel=1e-4)
    assert (at[2] - at[1]) / step == pytest.approx(1.0, rel=1e-4)
    assert at[3:].tolist() == pytest.approx([0.0, 2 - beta / 2])


def test_a_score_of_zero_has_a_finite_loss():
    """The logarithm is bounded."""
    found = consistency(detections([CAR]), detections([CAR], scores=[0.0]))
    assert found.loss[0] == pytest.approx(-np.log(SCORE_FLOOR))


def test_no_match_is_nan_not_zero():
    """Nothing near, or only another category: no evidence."""
    away = consistency(detections([CAR]), detections([moved(CAR, x=30.0)]))
    other = consistency(detections([CAR]), detections([CAR], categories=["Cyclist"]))
    for found in (away, other):
        assert found.matched.tolist() == [-1]
        assert np.isnan([found.iou, found.score_loss, found.box_loss, found.loss]).all()


@pytest.mark.parametrize("n", [0, 2])
@pytest.mark.parametrize("m", [0, 3])
def test_empty_frames_have_empty_evidence(n, m):
    """No predictions, no repredictions, or neither."""
    boxes = [moved(CAR, x=20.0 * i) for i in range(3)]
    found = consistency(detections(boxes[:n]), detections(boxes[:m]))
    assert found.matched.shape == found.loss.shape == (n,)
    assert found.matched.dtype == np.int64
    assert np.isnan(found.loss).all() == (m == 0 or n == 0)


def test_the_minimum_iou_itself_does_not_match():
    """A pair needs more overlap than the minimum."""
    iou = float(bev_iou(np.array([CAR]), np.array([moved(CAR, x=2.0)]))[0, 0])
    pair = detections([CAR]), detections([moved(CAR, x=2.0)])
    assert match(*pair, minimum_iou=iou)[0].tolist() == [-1]
    assert match(*pair, minimum_iou=np.nextafter(iou, 0))[0].tolist() == [0]


def test_a_pair_below_the_minimum_does_not_displace_a_valid_one():
    """Its overlap does not count in the total."""
    straight = [0.0, 0.0, 0.0, 10.0, 2.0, 1.5, 0.0]
    shifted = moved(straight, x=2.0)
    predictions = detections([straight, shifted])
    repredictions = detections([moved(straight, x=1.0), moved(straight, x=-9.0)])
    overlaps = bev_iou(predictions.boxes, repredictions.boxes)
    assert 0 < overlaps[0, 1] < 0.1
    matched, _ = match(predictions, repredictions, minimum_iou=0.1)
    assert sorted(matched.tolist()) == [-1, 0]


@settings(max_examples=60)
@given(crowds(), crowds())
def test_matching_is_one_to_one_and_optimal(predictions, repredictions):
    """No reprediction is used twice, categories agree, and no assignment has a larger total IoU."""
    matched, iou = match(predictions, repredictions, minimum_iou=0.1)
    found = np.flatnonzero(matched >= 0)
    assert len(set(matched[found])) == len(found)
    assert (predictions.categories[found] == repredictions.categories[matched[found]]).all()
    assert (iou[found] > 0.1).all()
    assert np.isnan(iou[matched < 0]).all()
    same = predictions.categories[:, None] == repredictions.categories[None, :]
    overlaps = bev_iou(predictions.boxes, repredictions.boxes)
    gains = np.where(same & (overlaps > 0.1), overlaps, 0.0)
    assert np.nansum(iou) == pytest.approx(best_total(gains.tolist()))


@settings(max_examples=60)
@given(crowds(8), crowds(8), st.randoms(use_true_random=False))
def test_matching_does_not_depend_on_the_order(predictions, repredictions, random):
    """Shuffled detections get the same loss, ties included."""
    rows = random.sample(range(len(predictions)), len(predictions))
    columns = random.sample(range(len(repredictions)), len(repredictions))
    straight = consistency(predictions, repredictions)
    shuffled = consistency(
        predictions.select(np.array(rows, dtype=np.int64)),
        repredictions.select(np.array(columns, dtype=np.int64)),
    )

    # Exact copies of a prediction are interchangeable, so the losses of all copies are compared
    # together.
    def results_by_copy(boxes, scores, categories, losses):
        rows = zip(categories, scores, boxes.tolist(), losses, strict=True)
        return sorted((str(c), s, b, np.nan_to_num(loss, nan=-1.0)) for c, s, b, loss in rows)

    p = predictions
    assert results_by_copy(p.boxes, p.scores, p.categories, straight.loss) == results_by_copy(
        p.boxes[rows], p.scores[rows], p.categories[rows], shuffled.loss
    )


@settings(max_examples=40)
@given(
    st.booleans(),
    st.floats(-np.pi, np.pi),
    st.floats(0.9, 1.1),
    crowds(),
)
def test_an_equivariant_detector_is_consistent(flip_y, turn, scale, predictions):
    """A^-1 of A's boxes are the boxes: the box loss is 0 for every A."""
    similarity = Similarity(flip_y, turn, scale)
    repredicted = similarity.apply_to_boxes(predictions.boxes)
    back = Detections(
        similarity.invert_boxes(repredicted), predictions.scores, predictions.categories
    )
    found = consistency(predictions, back)
    assert (found.matched >= 0).all()
    assert found.box_loss == pytest.approx(np.zeros(len(predictions)), abs=1e-12)
    assert np.sort(found.loss) == pytest.approx(np.sort(-np.log(predictions.scores)))


def test_the_mean_counts_only_views_that_matched():
    """Two of three views matched: their mean; none: NaN."""
    predictions = detections([CAR, moved(CAR, x=40.0)])
    views = [
        consistency(predictions, detections(boxes, scores=[score] * len(boxes)))
        for boxes, score in (([CAR], 0.5), ([], 0.9), ([CAR], 0.25))
    ]
    mean = mean_over_views(views)
    assert mean.views_matched.tolist() == [2, 0]
    assert mean.loss[0] == pytest.approx(-(np.log(0.5) + np.log(0.25)) / 2)
    assert np.isnan(mean.loss[1])


def test_a_box_without_height_is_reported():
    """A matched box without a residual gives a one-line error, not an infinite loss."""
    flat = [*CAR[:5], 0.0, CAR[6]]
    with pytest.raises(ModelError, match="no size"):
        consistency(detections([CAR]), detections([flat]))


@pytest.mark.parametrize(
    "wrong", [{"score_weight": -1}, {"box_weight": -1}, {"beta": 0}, {"minimum_iou": 1}]
)
def test_invalid_settings_are_rejected(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        ConsistencySettings(**wrong)
