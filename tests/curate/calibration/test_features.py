"""The features of a calibration."""

import numpy as np
import pytest
from support.simulated_evidence import CATEGORIES, SIZES, random_evidence

from curate.calibration.features import LabelEvidence, feature_names, features, mean_log_sizes
from curate.errors import ConfigError, DataError

NAN = float("nan")


def label(**changes) -> LabelEvidence:
    """Return the car of the example in the module."""
    values = {
        "category": "Car", "score": 0.9, "loss": 0.1, "points": 19.0, "rho_diff": 0.5,
        "pixel_share": 0.8, "boxes": [30, 40, 0, 4.0, 1.6, 1.5, 0.3],
    }  # fmt: skip
    return LabelEvidence(**{name: np.array([each]) for name, each in (values | changes).items()})


def of(evidence: LabelEvidence) -> dict[str, float]:
    """Return the features of the only label by name."""
    sizes = {"Car": (np.log(4.4), np.log(1.6), np.log(1.5))}
    x = features(evidence, ("Car", "Cyclist"), sizes)
    return dict(zip(feature_names(("Car", "Cyclist")), x[0].tolist(), strict=True))


def test_the_features_of_the_example():
    """Each by its formula."""
    assert of(label()) == pytest.approx(
        {
            "score": np.log(0.9 / 0.1), "loss": -np.log(0.1), "matched": 1, "points": np.log(20),
            "rho_diff": np.log(0.5), "pixels": 0.8, "distance": 5, "size": np.log(4.4 / 4.0),
            "Car": 1, "Cyclist": 0,
        }
    )  # fmt: skip


def test_extreme_values_are_limited():
    """No feature is infinite, whatever the evidence is."""
    found = of(label(score=1.0, loss=0.0, points=0.0, rho_diff=0.0))
    assert found["score"] == pytest.approx(np.log((1 - 1e-4) / 1e-4))
    assert found["loss"] == pytest.approx(-np.log(0.02))
    assert (found["points"], found["rho_diff"]) == (0, pytest.approx(np.log(1e-3)))
    assert of(label(score=0.0, loss=1e9))["loss"] == pytest.approx(-np.log(20))
    flat = label(boxes=[0, 0, 0, 0, 0, 0, 0])
    assert all(map(np.isfinite, of(flat).values()))


def test_a_label_without_a_match_has_the_greatest_loss():
    """And the flag says that there was none."""
    found = of(label(loss=NAN))
    assert (found["loss"], found["matched"]) == (pytest.approx(-np.log(20)), 0)


def test_missing_evidence_is_nan():
    """Outside the image, without the point prior, or of a category without an object in X_l."""
    found = of(label(pixel_share=NAN, points=NAN, rho_diff=NAN, category="Cyclist"))
    missing = {name for name, value in found.items() if np.isnan(value)}
    assert missing == {"pixels", "points", "rho_diff", "size"}


def test_further_columns_come_last_in_their_order():
    """As they are."""
    evidence = random_evidence(5)
    further = {"track_length": np.arange(5.0), "hits": np.full(5, NAN)}
    evidence = LabelEvidence(**{**vars(evidence), "further": further})
    x = features(evidence, CATEGORIES, SIZES, ("track_length", "hits"))
    np.testing.assert_array_equal(x[:, -2], np.arange(5))
    assert np.isnan(x[:, -1]).all()
    assert feature_names(CATEGORIES, ("track_length", "hits"))[-2:] == ("track_length", "hits")


def test_rows_are_selected_in_every_column():
    """By index, further columns included."""
    evidence = LabelEvidence(**{**vars(random_evidence(5)), "further": {"hits": np.arange(5.0)}})
    found = evidence.select(np.array([3, 1]))
    assert found.further["hits"].tolist() == [3, 1]
    np.testing.assert_array_equal(found.boxes, evidence.boxes[[3, 1]])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"category": np.array(["Tram"])}, "a label is a Tram, but the calibration knows Car"),
        ({"further": {"hits": np.ones(1)}}, "the further evidence none, but the labels have hits"),
    ],
)
def test_labels_of_another_kind_are_rejected(changes, words):
    """Another category, or other evidence than that of the fit."""
    evidence = LabelEvidence(**{**vars(label()), **changes})
    with pytest.raises(ConfigError, match=words):
        features(evidence, ("Car", "Cyclist"), {})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"loss": np.ones(2)}, "column loss has 2 labels, score has 1"),
        ({"score": np.array([NAN])}, "score of a label is missing"),
        ({"loss": np.array([np.inf])}, "loss of a label is infinite"),
        ({"further": {"hits": np.array([-np.inf])}}, "hits of a label is infinite"),
    ],
)
@pytest.mark.wrong_shapes
def test_invalid_columns_are_rejected(changes, words):
    with pytest.raises(DataError, match=words):
        LabelEvidence(**{**vars(label()), **changes})


def test_mean_sizes_are_geometric():
    """sqrt(4 * 9) = 6; a box without a size is left out."""
    boxes = np.zeros((4, 7))
    boxes[:, 3:6] = [[4, 1, 2], [9, 1, 2], [3, 3, 3], [0, 1, 1]]
    category = np.array(["Car", "Car", "Cyclist", "Car"])
    found = mean_log_sizes(category, boxes)
    assert np.exp(found["Car"]) == pytest.approx([6, 1, 2])
    assert np.exp(found["Cyclist"]) == pytest.approx([3, 3, 3])
    assert mean_log_sizes(category[:0], boxes[:0]) == {}
