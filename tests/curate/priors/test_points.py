"""The point prior: thresholds learned from labeled frames, and Eq. 8."""

import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curate.detections import Annotations, Detections, as_categories
from curate.errors import ConfigError
from curate.frames import Calibration, Frame
from curate.priors.points import PointPrior, PointSettings, learn_thresholds, points_threshold


def frame_with(*crowds):
    """Return a frame with n_i points around (10 i, 0, 0) for the i-th number."""
    points = np.zeros((sum(crowds), 4), dtype=np.float32)
    points[:, 0] = np.repeat(10.0 * np.arange(len(crowds)), crowds)
    return Frame("000000", points, Calibration(np.eye(3, 4), np.eye(4)), (10, 10))


def boxes_at(*places):
    """Return boxes of 4 x 2 x 1.5 m around (10 i, 0, 0)."""
    return np.array([[10.0 * i, 0, 0, 4, 2, 1.5, 0.1] for i in places]).reshape(-1, 7)


def annotations_at(places, categories):
    """Return ground truth at those positions."""
    n = len(places)
    return Annotations(
        boxes_at(*places),
        as_categories(categories),
        np.zeros(n),
        np.zeros(n, dtype=np.int64),
        np.zeros(n),
        np.zeros((n, 4)),
    )


def detections_at(places, categories):
    """Return labels at those positions."""
    return Detections(boxes_at(*places), np.full(len(places), 0.5), as_categories(categories))


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (PointSettings(), 7.0),
        (PointSettings("mean"), (1 + 3 + 11 + 25) / 4),
        (PointSettings("quantile", quantile=1.0), 25.0),
        (PointSettings("quantile", quantile=0.25), 2.5),
        (PointSettings("fixed", fixed=12.0), 12.0),
    ],
)
def test_each_statistic_has_its_value(settings, expected):
    """Median, mean, quantile and fixed, on four boxes."""
    assert points_threshold(np.array([25, 1, 11, 3]), settings) == pytest.approx(expected)


def test_the_threshold_of_empty_boxes_is_one_point():
    """A median of 0 would divide by 0 and trust empty boxes."""
    assert points_threshold(np.zeros(9)) == 1.0
    assert points_threshold(np.array([0, 0, 1])) == 1.0


def test_thresholds_are_learned_per_category_over_all_frames():
    samples = [
        (frame_with(10, 3), annotations_at([0, 1], ["Car", "Cyclist"])),
        (frame_with(20, 40), annotations_at([0, 1], ["Car", "Car"])),
        (frame_with(5), annotations_at([], [])),
    ]
    learned = learn_thresholds(samples, ("Car", "Cyclist"))
    assert learned == {"Car": 20.0, "Cyclist": 3.0}


def test_dont_care_and_unknown_categories_are_not_learned():
    """NaN boxes of DontCare regions and unconfigured categories are left out."""
    truth = annotations_at([0, 1, 0], ["Car", "Van", "DontCare"])
    truth.boxes[2] = np.nan
    learned = learn_thresholds([(frame_with(8, 100), truth)], ("Car",))
    assert learned == {"Car": 8.0}


def test_a_category_without_ground_truth_uses_the_fallback_with_a_warning(caplog):
    """The warning contains the category and the fallback."""
    with caplog.at_level(logging.WARNING):
        learned = learn_thresholds(
            [(frame_with(8), annotations_at([0], ["Car"]))],
            ("Car", "Pedestrian"),
            PointSettings(fallback=7.0),
        )
    assert learned == {"Car": 8.0, "Pedestrian": 7.0}
    (record,) = caplog.records
    assert "Pedestrian" in record.getMessage()
    assert "7 points" in record.getMessage()


def test_a_fixed_threshold_needs_no_ground_truth(caplog):
    """It is not a fallback, so there is no warning."""
    learned = learn_thresholds([], ("Car",), PointSettings("fixed", fixed=9.0))
    assert learned == {"Car": 9.0}
    assert not caplog.records


def test_evidence_is_equation_8():
    """rho_diff = min(m, m_th) / m_th, with each category's own m_th."""
    prior = PointPrior({"Car": 20.0, "Cyclist": 2.5})
    found = prior.score(
        frame_with(5, 50, 2), detections_at([0, 1, 2, 3], ["Car", "Car", "Cyclist", "Cyclist"])
    )
    assert found["points"].tolist() == [5, 50, 2, 0]
    assert found["points"].dtype == np.int64
    assert found["points_threshold"].tolist() == [20.0, 20.0, 2.5, 2.5]
    assert found["rho_diff"].tolist() == [0.25, 1.0, 0.8, 0.0]


def test_evidence_declares_its_columns():
    """The fields are the columns of the database, and rho is the declared trust."""
    found = PointPrior({"Car": 2.0}).score(frame_with(1), detections_at([0], ["Car"]))
    assert list(found) == ["points", "points_threshold", "rho_diff"]
    assert PointPrior.rho_column in found


@given(st.integers(0, 500), st.integers(0, 500), st.floats(1.0, 300.0))
def test_more_points_never_lower_the_trust(few, more, threshold):
    """rho_diff rises with m, stays in [0, 1], and is 1 from m_th on."""
    few, more = sorted((few, more))
    found = PointPrior({"Car": threshold}).score(
        frame_with(few, more), detections_at([0, 1], ["Car", "Car"])
    )
    assert 0 <= found["rho_diff"][0] <= found["rho_diff"][1] <= 1
    assert (found["rho_diff"] == 1).tolist() == [few >= threshold, more >= threshold]


def test_an_empty_frame_has_empty_evidence():
    """No label, no point, or neither."""
    prior = PointPrior({"Car": 3.0})
    assert prior.score(frame_with(4), Detections.empty())[prior.rho_column].shape == (0,)
    none_inside = prior.score(frame_with(), detections_at([0], ["Car"]))
    assert none_inside[prior.rho_column].tolist() == [0.0]


def test_a_category_without_a_threshold_is_reported():
    """The error contains the category and what to do."""
    with pytest.raises(ConfigError, match=r"Tram.*learn the thresholds again"):
        PointPrior({"Car": 3.0}).score(frame_with(1), detections_at([0], ["Tram"]))


@pytest.mark.parametrize("wrong", [{"statistic": "mode"}, {"quantile": 1.5}, {"fallback": 0.0}])
def test_invalid_settings_are_rejected(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        PointSettings(**wrong)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_threshold_must_be_a_positive_number(value):
    with pytest.raises(ConfigError, match="Car"):
        PointPrior({"Car": value})
