"""How labels are matched to ground truth."""

from collections.abc import Mapping

import numpy as np

from curate.detections import Annotations, Detections
from curate.evaluation.kitti_rules import neighbours_of, overlaps_of
from curate.evaluation.reliability import (
    LabelMatches,
    MatchSettings,
    Overlap,
    match_to_ground_truth,
)
from curate.frames import Frame
from curate.geometry.projection import box_rectangles
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace


def configured_overlaps(config: Config) -> dict[str, float]:
    """Return the IoU threshold of each configured category."""
    return overlaps_of(config.dataset.categories, config.evaluation.overlaps)


def match_settings(
    config: Config, overlap: Overlap, overlaps: Mapping[str, float] | None = None
) -> MatchSettings:
    """Return the settings to match labels of the configured categories to ground truth.

    Args:
        config: the configuration.
        overlap: "bev" or "3d".
        overlaps: the IoU threshold of each category; None for the configured ones.
    """
    categories = config.dataset.categories
    return MatchSettings(
        overlap=overlap,
        minimum_iou=configured_overlaps(config) if overlaps is None else overlaps,
        neighbors={name: (other,) for name, other in neighbours_of(categories).items()},
    )


def rectangles_in_image(boxes: np.ndarray, frame: Frame) -> np.ndarray | None:
    """Return (n, 4) projected boxes, see `box_rectangles`; None for a frame without an image."""
    return None if frame.image_size is None else box_rectangles(boxes, frame)


def match_in_frame(
    workspace: Workspace,
    name: str,
    labels: Detections,
    truth: Annotations,
    settings: MatchSettings,
) -> LabelMatches:
    """Return which labels of a frame are correct, wrong or neutral.

    Args:
        workspace: the workspace, whose data set has the calibration and the size of the image.
        name: name of the frame.
        labels: its labels.
        truth: its ground truth.
        settings: see `match_settings`.
    """
    frame = workspace.dataset.read(name, points=False)
    return match_to_ground_truth(labels, truth, settings, rectangles_in_image(labels.boxes, frame))
