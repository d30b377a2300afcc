"""The logistic regression behind the probability of a label."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from support.simulated_evidence import CATEGORIES, SIZES, random_evidence, true_probability

from curate.calibration.features import LabelEvidence, features
from curate.calibration.model import Calibration, TooFewLabels, fit_calibration
from curate.errors import ConfigError, DataError


def fitted(evidence: LabelEvidence, correct: np.ndarray, **options) -> Calibration:
    """Return the fit to labels of twenty frames."""
    frames = np.arange(len(evidence)) % 20
    return fit_calibration(evidence, correct, frames, categories=CATEGORIES, sizes=SIZES, **options)


def drawn(evidence: LabelEvidence, seed: int = 0) -> np.ndarray:
    """Return a draw of which labels are correct."""
    return np.random.default_rng(seed).random(len(evidence)) < true_probability(evidence)


@pytest.mark.parametrize("inverse_penalty", [0.3, 10.0])
def test_the_fit_is_that_of_a_slow_optimiser(inverse_penalty: float):
    """Penalised logistic loss over standardised features, with means in place of unknown ones."""
    evidence = random_evidence(300)
    correct = drawn(evidence)
    x = features(evidence, CATEGORIES, SIZES)
    mean, scale = np.nanmean(x, axis=0), np.nanstd(x, axis=0)
    z = (np.where(np.isnan(x), mean, x) - mean) / scale
    sign = np.where(correct, 1.0, -1.0)

    def objective(w: np.ndarray) -> float:
        loss = np.logaddexp(0, -sign * (w[0] + z @ w[1:])).sum()
        return inverse_penalty * loss + 0.5 * (w[1:] ** 2).sum()

    best = minimize(objective, np.zeros(z.shape[1] + 1), options={"gtol": 1e-7}).x
    found = fitted(evidence, correct, inverse_penalty=inverse_penalty)
    assert [found.intercept, *found.coefficients] == pytest.approx(best, abs=1e-4)
    expected = 1 / (1 + np.exp(-(best[0] + z @ best[1:])))
    np.testing.assert_allclose(found.probability(evidence), expected, atol=1e-5)
    assert (found.labels, found.correct, found.frames) == (300, correct.sum(), 20)


def test_a_known_probability_is_recovered():
    """From simulated labels: within the error of the fit, on labels that it has not seen."""
    evidence, new = random_evidence(20_000, unseen=0.0), random_evidence(20_000, 1, unseen=0.0)
    calibration = fitted(evidence, drawn(evidence))
    p, true = calibration.probability(new), true_probability(new)
    assert np.abs(p - true).mean() < 0.01
    # Each coefficient lies within four standard errors, from the Fisher information, of the slope.
    x = features(evidence, CATEGORIES, SIZES)[:, :8]
    z = np.column_stack([np.ones(len(x)), (x - x.mean(axis=0)) / x.std(axis=0)])
    q = true_probability(evidence)
    error = np.sqrt(np.diag(np.linalg.inv(z.T @ (z * (q * (1 - q))[:, None]))))[1:]
    slopes = np.array([0.8, 0.4, 0.5, 0.3, 0.2, 1.5, -0.1, -1.0]) * x.std(axis=0)
    assert (np.abs(np.array(calibration.coefficients[:8]) - slopes) < 4 * error).all()


def test_the_probabilities_of_the_fit_sum_to_the_correct_labels():
    """The penalty does not act on the intercept."""
    evidence = random_evidence(500)
    correct = drawn(evidence)
    assert fitted(evidence, correct).probability(evidence).sum() == pytest.approx(correct.sum())


def test_the_terms_sum_to_the_logit():
    """With the intercept; a term of missing evidence is 0."""
    evidence = random_evidence(200)
    calibration = fitted(evidence, drawn(evidence))
    terms, p = calibration.terms(evidence), calibration.probability(evidence)
    assert calibration.intercept + terms.sum(axis=1) == pytest.approx(np.log(p / (1 - p)))
    assert not terms[np.isnan(evidence.pixel_share), calibration.features.index("pixels")].any()


def test_a_calibration_is_restored_exactly():
    """From its JSON."""
    evidence = random_evidence(200)
    calibration = fitted(evidence, drawn(evidence))
    assert Calibration.from_json(calibration.as_json()) == calibration


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"sizes": {}}', '{"sizes": 3}'])
def test_a_damaged_calibration_is_reported(text: str):
    with pytest.raises(DataError, match="stored calibration is damaged"):
        Calibration.from_json(text)


@pytest.mark.parametrize(
    ("frames", "right", "labels", "words"),
    [
        (20, 0, 100, "0 correct and 100 wrong labels of 20 frames"),
        (20, 19, 100, "19 correct"),
        (4, 50, 100, "of 4 frames"),
        (20, 100, 100, "100 correct and 0 wrong"),
        (20, 0, 0, "0 correct and 0 wrong labels of 0 frames"),
    ],
)
def test_too_few_labels_are_not_fitted(frames: int, right: int, labels: int, words: str):
    """No correct label, too few of them or too few frames, or none that is wrong."""
    with pytest.raises(TooFewLabels, match=words):
        fit_calibration(
            random_evidence(labels), np.arange(labels) < right, np.arange(labels) % frames,
            categories=CATEGORIES, sizes=SIZES,
        )  # fmt: skip


def test_a_category_without_a_correct_label_gets_low_probabilities():
    """Not 0: the penalty keeps them finite."""
    evidence = random_evidence(400)
    correct = drawn(evidence) & (evidence.category != "Cyclist")
    p = fitted(evidence, correct).probability(evidence)
    cyclists = evidence.category == "Cyclist"
    assert 0 < p[cyclists].max() < 1
    assert p[cyclists].mean() < 0.1 < p[~cyclists].mean()


def test_a_category_without_a_label_can_be_weighted():
    """It was not in the fit, so it counts neither for nor against a label."""
    evidence = random_evidence(400)
    known = evidence.select(evidence.category != "Cyclist")
    calibration = fitted(known, drawn(known))
    assert calibration.coefficients[calibration.features.index("Cyclist")] == 0
    assert np.isfinite(calibration.probability(evidence)).all()


def test_separable_labels_are_fitted():
    """The penalty keeps the coefficients finite, without a warning."""
    evidence = random_evidence(300)
    calibration = fitted(evidence, evidence.score > 0.5)
    assert np.abs(calibration.coefficients).max() < 10
    p = calibration.probability(evidence)
    assert p[evidence.score > 0.6].min() > p[evidence.score < 0.4].max()


def test_equal_scores_do_not_count():
    """The scores of labels to weight may differ: the fit has learned nothing from the score."""
    evidence = random_evidence(300)
    equal = replace(evidence, score=np.full(300, 0.5))
    calibration = fitted(equal, drawn(evidence))
    assert calibration.coefficients[0] == 0
    assert np.isfinite(calibration.probability(evidence)).all()


@pytest.mark.parametrize("missing", ["pixel_share", "loss", "points", "rho_diff"])
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_evidence_may_be_missing(missing: str, share: float):
    """For half of the labels, or for all of them, as without images or a second view."""
    evidence = random_evidence(600)
    column = getattr(evidence, missing).copy()
    column[: int(share * 600)] = np.nan
    calibration = fitted(replace(evidence, **{missing: column}), drawn(evidence))
    assert np.isfinite(calibration.coefficients).all()
    assert np.isfinite(calibration.probability(evidence)).all()
    if share == 1 and missing != "loss":
        name = "pixels" if missing == "pixel_share" else missing
        assert calibration.coefficients[calibration.features.index(name)] == 0


def test_other_evidence_than_that_of_the_fit_is_rejected():
    """Another list of categories or columns needs another fit."""
    evidence = random_evidence(200)
    calibration = fitted(evidence, drawn(evidence))
    with pytest.raises(ConfigError, match="run `curate calibrate` again"):
        calibration.probability(replace(evidence, category=np.full(200, "Van")))
    with pytest.raises(ConfigError, match="run `curate calibrate` again"):
        calibration.probability(replace(evidence, further={"hits": np.ones(200)}))


def test_the_order_of_the_labels_does_not_matter():
    """Up to rounding."""
    evidence = random_evidence(200)
    correct, order = drawn(evidence), np.random.default_rng(0).permutation(200)
    first, second = fitted(evidence, correct), fitted(evidence.select(order), correct[order])
    assert second.coefficients == pytest.approx(first.coefficients)
