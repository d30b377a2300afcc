"""A small label set for tests of single formats."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from curate.exporters.base import (
    BOX_COLUMNS,
    GROUND_TRUTH_COLUMNS,
    WEIGHTED_LABEL_COLUMNS,
    FrameFiles,
    LabelFileDescription,
    LabelSet,
)
from curate.frames import Frame
from curate.weighting.base import ZeroWeight
from support.toys import IMAGE_SIZE, toy_calibration

TRUE_BOX = (10.0, 0.0, -0.8, 4.0, 1.8, 1.6, 0.0)
# Visible, of weight 0, and behind the camera.
BOXES = (
    (20.0, 1.0, -0.5, 4.0, 2.0, 1.5, 0.1),
    (10.0, -2.0, 0.0, 0.8, 0.6, 1.7, 3.0),
    (-9.0, 2.0, 0.0, 4.0, 2.0, 1.0, 1.0),
)
CATEGORIES = ("Car", "Pedestrian", "Car")
WEIGHTS = (0.75, 0.0, 1 / 3)
SCORES = (0.9, 0.3, 0.6)

Row = dict[str, Any]


def label(frame: str, k: int = 0, box: Sequence[float] = BOXES[0], **changes: Any) -> Row:
    """Return a weighted label by column name."""
    return {
        "round": 1, "frame": frame, "k": k, "category": "Car",
        **dict(zip(BOX_COLUMNS, box, strict=True)), "score": 0.9, "loss": 0.2, "points": 30,
        "points_threshold": 60.0, "rho_diff": 0.5, "mask_pixels": 80, "box_pixels": 100,
        "rho_anno": 0.8, "rho_det": 0.4, "lambda_u": 1.5, "provenance": "detector",
        "policy": "pspsl", "weight": 0.5,
    } | changes  # fmt: skip


def truth(frame: str, k: int = 0, box: Sequence[float] = TRUE_BOX, **changes: Any) -> Row:
    """Return a ground-truth object by column name."""
    own = {"frame": frame, "k": k, "category": "Car", "truncated": 0.0, "occluded": 0}
    return own | dict(zip(BOX_COLUMNS, box, strict=True)) | changes


def block(rows: Sequence[Row], names: Sequence[str] = WEIGHTED_LABEL_COLUMNS) -> dict[str, list]:
    """Return rows as named columns."""
    return {name: [row[name] for row in rows] for name in names}


def truth_block(rows: Sequence[Row] = ()) -> dict[str, list]:
    """Return ground truth as named columns."""
    return block(rows, GROUND_TRUTH_COLUMNS)


def rows_of(labels: LabelSet) -> list[Row]:
    """Return the labels of a label set, one row each."""
    return [
        dict(zip(each, values, strict=True))
        for each in labels.labels
        for values in zip(*each.values(), strict=True)
    ]


def with_rows(labels: LabelSet, rows: Sequence[Row]) -> LabelSet:
    """Return the label set with other labels."""
    return replace(labels, labels=[block(rows)] if rows else [])


def renamed(labels: LabelSet, names: dict[str, str], read: Callable[[str], Frame]) -> LabelSet:
    """Return the label set with other frame names, and their reader."""
    moved = with_rows(labels, [row | {"frame": names[row["frame"]]} for row in rows_of(labels)])
    return replace(
        moved,
        frames=[replace(each, frame=names[each.frame]) for each in labels.frames],
        ground_truth={
            **labels.ground_truth,
            "frame": [names[frame] for frame in labels.ground_truth["frame"]],
        },
        read=read,
    )


def toy_frame(name: str) -> Frame:
    """Return a frame with seven points in the middle of the true box, one outside."""
    points = np.zeros((8, 4), dtype=np.float32)
    points[:, :3] = TRUE_BOX[:3]
    points[:7, 0] += np.linspace(-1, 1, 7, dtype=np.float32)
    points[7, 0] = 30
    return Frame(name, points, toy_calibration(), IMAGE_SIZE)


def toy_labels(
    points: tuple[int | None, ...] = (12, None, 3), zero_weight: ZeroWeight = "ignore"
) -> LabelSet:
    """Return labeled frame 000000 with a car and a van, unlabeled 000001 with three labels."""
    files = [(f"velodyne/00000{i}.bin", f"image_2/00000{i}.png", "c") for i in range(2)]
    evidence = {
        "points_threshold": 20.0, "rho_diff": 0.6, "mask_pixels": 30, "box_pixels": 100,
        "rho_anno": 0.5, "rho_det": 0.3,
    }  # fmt: skip
    return LabelSet(
        description=LabelFileDescription(
            "kitti", Path("/data"), ("Car", "Pedestrian", "Cyclist"), 1, "pspsl", "1", zero_weight
        ),
        frames=[
            FrameFiles("000000", "labeled", *files[0]),
            FrameFiles("000001", "unlabeled", *files[1]),
        ],
        ground_truth=truth_block(
            [
                truth("000000"),
                truth(
                    "000000", 1, (25.0, 4.0, -0.8, 5.0, 2.0, 2.0, 0.5), category="Van",
                    truncated=0.2, occluded=1,
                ),
            ]
        ),
        labels=[
            block(
                [
                    label(
                        "000001", k, BOXES[k], category=CATEGORIES[k], score=SCORES[k], loss=None,
                        points=points[k], weight=WEIGHTS[k], **evidence,
                    )
                    for k in range(3)
                ]
            )
        ],
        read=toy_frame,
        read_points=toy_frame,
    )  # fmt: skip
