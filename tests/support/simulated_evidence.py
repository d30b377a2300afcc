"""Labels with random evidence, and with a known probability that each is correct."""

import numpy as np

from curate.calibration.features import LabelEvidence, features

CATEGORIES = ("Car", "Pedestrian", "Cyclist")
SIZES = {
    "Car": (np.log(4.2), np.log(1.7), np.log(1.5)),
    "Pedestrian": (np.log(0.8), np.log(0.6), np.log(1.7)),
    "Cyclist": (np.log(1.7), np.log(0.6), np.log(1.7)),
}
# Of score, loss, matched, points, rho_diff, pixels, distance, size, and the categories.
SLOPES = np.array([0.8, 0.4, 0.5, 0.3, 0.2, 1.5, -0.1, -1.0, 0.3, -0.2, 0.0])
INTERCEPT = -2.5


def random_evidence(n: int, seed: int = 0, *, unseen: float = 0.2) -> LabelEvidence:
    """Return n labels, a fifth of them without a match, some without image evidence."""
    rng = np.random.default_rng([seed, n])
    category = rng.choice(CATEGORIES, n)
    logs = np.array([SIZES[name] for name in category.tolist()]).reshape(-1, 3)
    boxes = np.column_stack(
        [rng.uniform(-40, 40, (n, 3)), np.exp(logs + rng.normal(0, 0.15, (n, 3))), np.zeros(n)]
    )
    return LabelEvidence(
        category=category,
        score=rng.beta(1, 1.5, n),
        loss=np.where(rng.random(n) < 0.2, np.nan, rng.exponential(0.5, n)),
        points=np.floor(rng.exponential(40, n)),
        rho_diff=rng.random(n),
        pixel_share=np.where(rng.random(n) < unseen, np.nan, rng.random(n)),
        boxes=boxes,
    )


def true_probability(evidence: LabelEvidence) -> np.ndarray:
    """Return (n,) the probability that each label is correct; missing evidence counts as 0.5."""
    x = np.nan_to_num(features(evidence, CATEGORIES, SIZES), nan=0.5)
    return 1 / (1 + np.exp(-(INTERCEPT + x @ SLOPES)))
