"""Rows of frames and predictions for the benchmarks of the database."""

import numpy as np


def frame_rows(count):
    """Return unlabeled frames as rows of `frame`."""
    return [
        ("kitti", f"{i:06d}", "unlabeled", f"{i}.bin", f"{i}.png", f"{i}.txt", None)
        for i in range(count)
    ]


def prediction_rows(frames, each):
    """Return equally many labels of each frame in round 1 as rows of `prediction`."""
    count = frames * each
    generator = np.random.default_rng(0)
    boxes, scores = generator.normal(0, 10, (count, 7)).tolist(), generator.random(count).tolist()
    categories = generator.choice(["Car", "Pedestrian", "Cyclist"], count).tolist()
    labels = enumerate(zip(boxes, scores, categories, strict=True))
    return [
        (1, 1 + i // each, i % each, category, score, *box, None)
        for i, (box, score, category) in labels
    ]
