"""A few evaluated labels, so that the expected figures can be computed by hand."""

import numpy as np

from curate.detections import as_categories
from curate.evaluation.audit import audit
from curate.evaluation.evaluated_labels import EvaluatedLabels

WEIGHTS = {
    "good": np.array([0.9, 0.8, 0.15, 0.05, 0.5, 0.0]),
    "bad": np.array([0.05, 0.25, 0.85, 0.95, 0.5, 1.0]),
    "all": np.ones(6),
}
"""Of `six_labels`; the fifth label is neutral and must not matter."""


def six_labels(points=(5, 60, 300, 5, 60, 20)):
    """Return six labels and five objects; frame 2 is empty.

    Two cars are correct and two wrong, one label is neutral, one cyclist is wrong.
    The distances are 10, 30, 30, 50, 10 and 15 m.
    """
    return EvaluatedLabels(
        frames=3,
        frame_index=np.array([0, 0, 1, 1, 1, 1]),
        category=as_categories(["Car"] * 5 + ["Cyclist"]),
        distance=np.array([10.0, 30, 30, 50, 10, 15]),
        points=np.array(points, dtype=np.float64),
        correct=np.array([True, True, False, False, False, False]),
        counted=np.array([True, True, True, True, False, True]),
        neutral=as_categories(["", "", "", "", "neighbour", ""]),
        object_frame=np.array([0, 0, 1, 1, 2]),
        object_category=as_categories(["Car", "Car", "Car", "Car", "Cyclist"]),
        object_distance=np.array([10.0, 30, 10, 60, 12]),
        other_category=as_categories(["Van", "Tram", "DontCare"]),
    )


def small_audit(weights=None, labels=None, **options):
    """Return the audit of `six_labels`."""
    return audit(
        six_labels() if labels is None else labels,
        WEIGHTS if weights is None else weights,
        ("Car", "Cyclist"),
        np.random.default_rng(0),
        **{"replicates": 200, **options},
    )


def many_labels(frames=60, seed=0):
    """Return correct and wrong labels of many frames, and a good, a fair and a random weighting."""
    generator = np.random.default_rng(seed)
    frame = np.repeat(np.arange(frames), 5)
    n = len(frame)
    right = generator.random(n) < 0.4
    labels = EvaluatedLabels(
        frames=frames,
        frame_index=frame,
        category=as_categories(generator.choice(["Car", "Cyclist"], n)),
        distance=generator.uniform(0, 60, n),
        points=generator.integers(0, 400, n).astype(float),
        correct=right,
        counted=np.full(n, True),
        neutral=np.full(n, ""),
        object_frame=frame,
        object_category=as_categories(["Car"] * n),
        object_distance=generator.uniform(0, 60, n),
        other_category=as_categories([]),
    )
    noise = generator.random((3, n))
    weights = {
        "good": np.clip(0.7 * right + 0.3 * noise[0], 0, 1),
        "fair": np.clip(0.3 * right + 0.7 * noise[1], 0, 1),
        "blind": noise[2],
    }
    return labels, weights
