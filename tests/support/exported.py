"""A small label set for tests of single formats."""

from pathlib import Path

import numpy as np

from curate.exporters.base import LabelFileDescription, LabelSet
from curate.frames import Frame
from support.toys import IMAGE_SIZE, toy_calibration

TRUE_BOX = (10.0, 0.0, -0.8, 4.0, 1.8, 1.6, 0.0)
# In view, to be ignored, and behind the camera.
BOXES = (
    (20.0, 1.0, -0.5, 4.0, 2.0, 1.5, 0.1),
    (10.0, -2.0, 0.0, 0.8, 0.6, 1.7, 3.0),
    (-9.0, 2.0, 0.0, 4.0, 2.0, 1.0, 1.0),
)
CATEGORIES = ("Car", "Pedestrian", "Car")
WEIGHTS = (0.75, 0.0, 1 / 3)
SCORES = (0.9, 0.3, 0.6)


def toy_frame(name: str) -> Frame:
    """Seven points in the middle of the true box, one outside."""
    points = np.zeros((8, 4), dtype=np.float32)
    points[:, :3] = TRUE_BOX[:3]
    points[:7, 0] += np.linspace(-1, 1, 7, dtype=np.float32)
    points[7, 0] = 30
    return Frame(name, points, toy_calibration(), IMAGE_SIZE)


def toy_labels(points: tuple[int | None, ...] = (12, None, 3)) -> LabelSet:
    """Labeled frame 000000 with a car and a van, unlabeled 000001 with three labels."""
    files = [(f"velodyne/00000{i}.bin", f"image_2/00000{i}.png", "c") for i in range(2)]
    evidence = (20.0, 0.6, 30, 100, 0.5, 0.3, 1.5, "detector", "pspsl")
    return LabelSet(
        description=LabelFileDescription(
            "kitti", Path("/data"), ("Car", "Pedestrian", "Cyclist"), 1, "pspsl", "1"
        ),
        frames=[("000000", "labeled", *files[0]), ("000001", "unlabeled", *files[1])],
        ground_truth=[
            ("000000", 0, "Car", *TRUE_BOX, 0.0, 0),
            ("000000", 1, "Van", 25.0, 4.0, -0.8, 5.0, 2.0, 2.0, 0.5, 0.2, 1),
        ],
        labels=[
            (1, "000001", k, CATEGORIES[k], *BOXES[k], SCORES[k], None, points[k], *evidence,
             WEIGHTS[k])
            for k in range(3)
        ],
        read=toy_frame,
        read_points=toy_frame,
    )  # fmt: skip
