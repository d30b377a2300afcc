"""How far a detector agrees with itself on an augmented copy of a frame (Eqs. 2 and 5).

Source: An et al., Remote Sensing 15(3):627, 2023. The box residual is the encoding of SECOND and
OpenPCDet, with the prediction as the anchor and the mapped-back reprediction as the target.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.detections import Detections
from curate.errors import ConfigError, ModelError
from curate.geometry.overlap import bev_iou
from curate.shapes import Float, Int

SCORE_FLOOR = 1e-6
"""Scores are lifted to this before the logarithm, so that a score of 0 has a finite loss."""


@dataclass(frozen=True)
class ConsistencySettings:
    """How a prediction is compared with its reprediction.

    Attributes:
        score_weight: factor of -ln s'.
        box_weight: factor of the summed smooth L1 of the residual.
        beta: where smooth L1 turns from a parabola into a line.
        minimum_iou: pairs with a BEV IoU at or below this never match. Low on purpose: the loss
            judges how well two boxes agree, the match only says that they mean the same object.
    """

    score_weight: float = 1.0
    box_weight: float = 2.0
    beta: float = 1 / 9
    minimum_iou: float = 0.1

    def __post_init__(self) -> None:
        """Raise ConfigError for a setting without meaning."""
        if self.score_weight < 0 or self.box_weight < 0:
            raise ConfigError("consistency: score_weight and box_weight must not be negative")
        if self.beta <= 0:
            raise ConfigError(f"consistency: beta must be positive, not {self.beta}")
        if not 0 <= self.minimum_iou < 1:
            raise ConfigError(f"consistency: minimum_iou must be in [0, 1), not {self.minimum_iou}")


@dataclass(frozen=True)
class Consistency:
    """The agreement of n predictions with one view's repredictions; NaN where nothing matched.

    Attributes:
        matched: (n,) int64 index of the matched reprediction, -1 for none.
        iou: (n,) BEV IoU with it.
        score_loss: (n,) -ln s', with s' the reprediction's score; without its weight.
        box_loss: (n,) sum of smooth L1 over the seven residuals; without its weight.
        loss: (n,) score_weight * score_loss + box_weight * box_loss.
    """

    matched: Int[np.ndarray, " n"]
    iou: Float[np.ndarray, " n"]
    score_loss: Float[np.ndarray, " n"]
    box_loss: Float[np.ndarray, " n"]
    loss: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class MeanConsistency:
    """The agreement of n predictions with several views.

    Attributes:
        loss: (n,) mean loss over the views that matched, NaN where none did.
        views_matched: (n,) int64 number of those views.
    """

    loss: Float[np.ndarray, " n"]
    views_matched: Int[np.ndarray, " n"]


_DEFAULT = ConsistencySettings()


def consistency(
    predictions: Detections,
    repredictions: Detections,
    settings: ConsistencySettings = _DEFAULT,
) -> Consistency:
    """Match one view's repredictions to the predictions and measure the disagreement.

    Args:
        predictions: n detections of the frame, in the LiDAR frame.
        repredictions: detections of the augmented copy, already mapped back by A^-1.
        settings: see `ConsistencySettings`.

    Raises:
        ModelError: if a matched box is not finite or has no size, so that it has no residual.
    """
    matched, iou = match(predictions, repredictions, settings.minimum_iou)
    found = matched >= 0
    targets = repredictions.select(matched[found])
    residuals = residual(predictions.boxes[found], targets.boxes)
    if not np.isfinite(residuals).all():
        raise ModelError(
            "the detector answered a box that is not finite or has no size; "
            "drop such boxes in the detector",
        )
    score_loss, box_loss = np.full((2, len(predictions)), np.nan)
    score_loss[found] = -np.log(np.clip(targets.scores, SCORE_FLOOR, 1.0))
    box_loss[found] = smooth_l1(residuals, settings.beta).sum(axis=1)
    loss = settings.score_weight * score_loss + settings.box_weight * box_loss
    return Consistency(matched, iou, score_loss, box_loss, loss)


def mean_over_views(views: Sequence[Consistency]) -> MeanConsistency:
    """L of each prediction over one or more views of its frame."""
    losses = np.stack([view.loss for view in views])
    views_matched = np.isfinite(losses).sum(axis=0)
    total = np.nansum(losses, axis=0)
    loss = np.where(views_matched > 0, total / np.maximum(views_matched, 1), np.nan)
    return MeanConsistency(loss, views_matched)


def match(
    predictions: Detections, repredictions: Detections, minimum_iou: float
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """One-to-one pairs within each category that maximise the total BEV IoU.

    Of several best assignments the choice depends on the detections alone, not on their order.

    Returns:
        (n,) int64 index of the matched reprediction or -1, and (n,) its BEV IoU or NaN.
    """
    from scipy.optimize import linear_sum_assignment

    matched = np.full(len(predictions), -1, dtype=np.int64)
    iou = np.full(len(predictions), np.nan)
    for category in np.intersect1d(predictions.categories, repredictions.categories):
        rows = _canonical_order(predictions, category)
        columns = _canonical_order(repredictions, category)
        overlaps = bev_iou(predictions.boxes[rows], repredictions.boxes[columns])
        # Pairs that may not match gain nothing, so the optimum of the rest is not disturbed.
        gain = np.where(overlaps > minimum_iou, overlaps, 0.0)
        row, column = linear_sum_assignment(gain, maximize=True)
        real = gain[row, column] > 0
        row, column = row[real], column[real]
        matched[rows[row]] = columns[column]
        iou[rows[row]] = overlaps[row, column]
    return matched, iou


def residual(
    anchors: Float[np.ndarray, "n 7"], targets: Float[np.ndarray, "n 7"]
) -> Float[np.ndarray, "n 7"]:
    """(n, 7) dx/d, dy/d, dz/h, ln l'/l, ln w'/w, ln h'/h, sin(yaw' - yaw); d, h of the anchor.

    Args:
        anchors: (n, 7) boxes.
        targets: (n, 7) boxes.

    Returns:
        The residual; not finite where a length is not positive.
    """
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])
    reach = np.stack([diagonal, diagonal, anchors[:, 5]], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = (targets[:, :3] - anchors[:, :3]) / reach
        stretch = np.log(targets[:, 3:6] / anchors[:, 3:6])
        turn = np.sin(targets[:, 6:] - anchors[:, 6:])
    return np.concatenate([offset, stretch, turn], axis=1)


def smooth_l1(
    difference: Float[np.ndarray, " *shape"], beta: float
) -> Float[np.ndarray, " *shape"]:
    """0.5 x^2 / beta where |x| < beta, |x| - 0.5 beta elsewhere."""
    size = np.abs(difference)
    loss: np.ndarray = np.where(size < beta, 0.5 * size**2 / beta, size - 0.5 * beta)
    return loss


def _canonical_order(detections: Detections, category: str) -> np.ndarray:
    """Indices of a category's detections by falling score, then by box: ties get an order."""
    index = np.flatnonzero(detections.categories == category)
    keys = np.column_stack([-detections.scores[index], detections.boxes[index]])
    return index[np.lexsort(keys.T[::-1])]
