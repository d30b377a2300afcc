"""A calibration: the probability that a label is correct, by logistic regression over its evidence.

    p = 1 / (1 + exp(-(b + sum_i t_i))),  t_i = a_i (x_i - mean_i) / scale_i

The features x are those of `curate.calibration.features`, standardised over the labels of the fit.
Missing evidence is replaced by the mean, so that its term t_i is 0. The fit minimises the
logistic loss with an L2 penalty on the coefficients a, in which C is the inverse of its strength.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Self

import numpy as np

from curate.calibration.features import LabelEvidence, feature_names, features
from curate.errors import CurateError, DataError
from curate.shapes import Bool, Float, Int

INVERSE_PENALTY = 0.3
FEWEST_FRAMES = 5
FEWEST_CORRECT = 20
_TOLERANCE = 1e-10


class TooFewLabels(CurateError):  # noqa: N818 - named after the labels, as LabelsVanished is
    """There are too few labels with known truth to fit a calibration."""


@dataclass(frozen=True)
class Calibration:
    """A fitted logistic regression, with all that its features need.

    Attributes:
        categories: the categories of its labels.
        further: names of the columns of further evidence, in the order of their features.
        sizes: logarithms of the mean length, width and height per category, over the objects of
            X_l.
        mean: mean of each feature over the labels of the fit that have the evidence.
        scale: standard deviation of each feature over the same labels; 1 if it is 0.
        coefficients: coefficient of each standardised feature.
        intercept: logit of a label with the mean of every feature.
        inverse_penalty: C.
        labels: number of labels of the fit.
        correct: number of correct ones among them.
        frames: number of frames that they belong to.
    """

    categories: tuple[str, ...]
    further: tuple[str, ...]
    sizes: Mapping[str, tuple[float, float, float]]
    mean: tuple[float, ...]
    scale: tuple[float, ...]
    coefficients: tuple[float, ...]
    intercept: float
    inverse_penalty: float
    labels: int
    correct: int
    frames: int

    @property
    def features(self) -> tuple[str, ...]:
        """The names of the features."""
        return feature_names(self.categories, self.further)

    def terms(self, evidence: LabelEvidence) -> Float[np.ndarray, "n f"]:
        """Return what each feature of each label adds to its logit; 0 for missing evidence.

        Raises:
            ConfigError: if the calibration was fitted to other evidence or categories.
        """
        x = features(evidence, self.categories, self.sizes, self.further)
        return _standardised(x, np.array(self.mean), np.array(self.scale)) * self.coefficients

    def probability(self, evidence: LabelEvidence) -> Float[np.ndarray, " n"]:
        """Return the probability that each label is correct.

        Raises:
            ConfigError: if the calibration was fitted to other evidence or categories.
        """
        logit = self.intercept + self.terms(evidence).sum(axis=1)
        return np.asarray(np.exp(-np.logaddexp(0.0, -logit)))

    def as_json(self) -> str:
        """Return the calibration as a JSON object, from which `from_json` restores it exactly."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the calibration in a JSON object.

        Raises:
            DataError: if the object was not written by `as_json`.
        """
        try:
            values = json.loads(text)
            sizes = {name: tuple(each) for name, each in values.pop("sizes").items()}
            lists = {name: tuple(each) for name, each in values.items() if isinstance(each, list)}
            return cls(sizes=sizes, **{**values, **lists})
        except (ValueError, TypeError, AttributeError, KeyError) as error:
            raise DataError(
                f"the stored calibration is damaged ({error}); run `curate calibrate` again"
            ) from error


def fit_calibration(
    evidence: LabelEvidence,
    correct: Bool[np.ndarray, " n"],
    frame_index: Int[np.ndarray, " n"],
    *,
    categories: Sequence[str],
    sizes: Mapping[str, tuple[float, float, float]],
    inverse_penalty: float = INVERSE_PENALTY,
) -> Calibration:
    """Fit a calibration to labels that are known to be correct or wrong.

    The teacher must not have been trained on their frames, or the probabilities are too high.

    Args:
        evidence: the labels; neutral ones, neither correct nor wrong, are left out by the caller.
        correct: whether each label is correct.
        frame_index: number of the frame of each label; any numbering.
        categories: the categories of the detector.
        sizes: see `Calibration`.
        inverse_penalty: C of the L2 penalty.

    Raises:
        TooFewLabels: if the labels come from fewer than 5 frames, fewer than 20 are correct, or
            none is wrong.
    """
    frames, right = len(np.unique(frame_index)), int(correct.sum())
    if frames < FEWEST_FRAMES or right < FEWEST_CORRECT or right == len(correct):
        raise TooFewLabels(
            f"{right} correct and {len(correct) - right} wrong labels of {frames} frames; a "
            f"calibration needs {FEWEST_CORRECT} correct labels, a wrong one, and {FEWEST_FRAMES} "
            "frames"
        )
    further = tuple(evidence.further)
    x = features(evidence, categories, sizes, further)
    mean, scale = _moments(x)
    # scikit-learn takes seconds to import.
    from sklearn.linear_model import LogisticRegression

    regression = LogisticRegression(
        C=inverse_penalty, solver="newton-cholesky", tol=_TOLERANCE, max_iter=1000
    )
    regression.fit(_standardised(x, mean, scale), correct)
    return Calibration(
        categories=tuple(categories),
        further=further,
        sizes=dict(sizes),
        mean=tuple(mean.tolist()),
        scale=tuple(scale.tolist()),
        coefficients=tuple(regression.coef_[0].tolist()),
        intercept=float(regression.intercept_[0]),
        inverse_penalty=inverse_penalty,
        labels=len(correct),
        correct=right,
        frames=frames,
    )


def _moments(x: Float[np.ndarray, "n f"]) -> tuple[np.ndarray, np.ndarray]:
    """Return (f,) mean and standard deviation of the known values; 0 and 1 where none varies."""
    known = ~np.isnan(x)
    count = np.maximum(known.sum(axis=0), 1)
    mean = x.sum(axis=0, where=known) / count
    deviation = np.sqrt(((x - mean) ** 2).sum(axis=0, where=known) / count)
    constant = deviation <= np.finfo(np.float64).eps * np.maximum(np.abs(mean), 1.0)
    return mean, np.where(constant, 1.0, deviation)


def _standardised(
    x: Float[np.ndarray, "n f"], mean: Float[np.ndarray, " f"], scale: Float[np.ndarray, " f"]
) -> Float[np.ndarray, "n f"]:
    """Return the standardised features; 0 for missing evidence."""
    return np.where(np.isnan(x), 0.0, (x - mean) / scale)
