"""Scores of detectors: probabilities, or numbers before the sigmoid (logits) that become them."""

import numpy as np

from curate.shapes import Float

SIGMOID_OPTION = "detector.options.sigmoid"


def to_probabilities(scores: Float[np.ndarray, " n"], *, sigmoid: bool) -> Float[np.ndarray, " n"]:
    """Return (n,) scores, after the sigmoid if they are logits."""
    if not sigmoid:
        return scores
    return np.asarray(0.5 * (1 + np.tanh(scores / 2)))  # does not overflow


def describe_invalid_scores(lowest: float, highest: float) -> str | None:
    """Return what is wrong with scores in a range and what to do, None if it is in [0, 1]."""
    if lowest >= 0 and highest <= 1:
        return None
    percent = (
        "; divide them by 100 if they are percentages" if lowest >= 0 and highest <= 100 else ""
    )
    shown = f"up to {highest:.3g}" if lowest >= 0 else f"from {lowest:.3g} to {highest:.3g}"
    return (
        f"scores {shown} are not in [0, 1]; set {SIGMOID_OPTION} = true "
        f"if they are logits (before the sigmoid){percent}"
    )
