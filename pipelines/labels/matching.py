"""How labels are matched to ground truth."""

from collections.abc import Mapping

import numpy as np

from curate.evaluation.kitti_rules import neighbours_of, overlaps_of
from curate.evaluation.reliability import MatchSettings, Overlap
from curate.frames import Frame
from curate.geometry.projection import box_rectangles
from pipelines.workspace.config import Config


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
