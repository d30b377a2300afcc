"""Consistency of a detector's predictions with those on an augmented copy of a frame (Eqs. 2, 5).

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
"""Lower scores are raised to this value before the logarithm: a score of 0 has a finite loss."""


@dataclass(frozen=True)
class ConsistencySettings:
    """Parameters of the comparison of a prediction with its reprediction.

    Attributes:
        score_weight: factor of -ln s'.
        box_weight: factor of the summed smooth L1 of the residual.
        beta: absolute residual at which smooth L1 changes from a parabola to a line.
        minimum_iou: pairs with a BEV IoU at or below this never match. The default is low on
            purpose: a match only states that two boxes show the same object, the loss measures how
            well they agree.
    """

    score_weight: float = 1.0
    box_weight: float = 2.0
    beta: float = 1 / 9
    minimum_iou: float = 0.1

    def __post_init__(self) -> None:
        """Raise ConfigError if a setting is out of its range."""
        if self.score_weight < 0 or self.box_weight < 0:
            raise ConfigError("consistency: score_weight and box_weight must not be negative")
        if self.beta <= 0:
            raise ConfigError(f"consistency: beta must be positive, not {self.beta}")
        if not 0 <= self.minimum_iou < 1:
            raise ConfigError(f"consistency: minimum_iou must be in [0, 1), not {self.minimum_iou}")


@dataclass(frozen=True)
class Consistency:
    """Consistency of n predictions with the repredictions of one view; NaN for unmatched ones.

    Attributes:
        matched: (n,) int64 index of the matched reprediction, -1 for none.
        iou: (n,) BEV IoU with the matched reprediction.
        score_loss: (n,) -ln s', where s' is the score of the reprediction; not yet weighted.
        box_loss: (n,) sum of smooth L1 over the seven residuals; not yet weighted.
        loss: (n,) score_weight * score_loss + box_weight * box_loss.
    """

    matched: Int[np.ndarray, " n"]
    iou: Float[np.ndarray, " n"]
    score_loss: Float[np.ndarray, " n"]
    box_loss: Float[np.ndarray, " n"]
    loss: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class MeanConsistency:
    """Consistency of n predictions with the repredictions of several views.

    Attributes:
        loss: (n,) mean loss over the views that matched, NaN if none matched.
        views_matched: (n,) int64 number of views that matched.
    """

    loss: Float[np.ndarray, " n"]
    views_matched: Int[np.ndarray, " n"]


_DEFAULT = ConsistencySettings()


def consistency(
    predictions: Detections,
    repredictions: Detections,
    settings: ConsistencySettings = _DEFAULT,
) -> Consistency:
    """Match the repredictions of one view to the predictions and return the consistency losses.

    Args:
        predictions: n detections of the frame, in the LiDAR frame.
        repredictions: detections of the augmented copy, already mapped back by A^-1.
        settings: see `ConsistencySettings`.

    Raises:
        ModelError: if a matched box is not finite or has a side that is not positive.
    """
    matched, iou = match(predictions, repredictions, settings.minimum_iou)
    has_match = matched >= 0
    targets = repredictions.select(matched[has_match])
    residuals = residual(predictions.boxes[has_match], targets.boxes)
    if not np.isfinite(residuals).all():
        raise ModelError(
            "the detector returned a box that is not finite or has no size; "
            "drop such boxes in the detector",
        )
    score_loss, box_loss = np.full((2, len(predictions)), np.nan)
    score_loss[has_match] = -np.log(np.clip(targets.scores, SCORE_FLOOR, 1.0))
    box_loss[has_match] = smooth_l1(residuals, settings.beta).sum(axis=1)
    loss = settings.score_weight * score_loss + settings.box_weight * box_loss
    return Consistency(matched, iou, score_loss, box_loss, loss)


def mean_over_views(views: Sequence[Consistency]) -> MeanConsistency:
    """Return the mean loss L of each prediction over the views of its frame.

    Args:
        views: one or more views, each with the same n predictions.
    """
    losses = np.stack([view.loss for view in views])
    views_matched = np.isfinite(losses).sum(axis=0)
    total = np.nansum(losses, axis=0)
    loss = np.where(views_matched > 0, total / np.maximum(views_matched, 1), np.nan)
    return MeanConsistency(loss, views_matched)


def match(
    predictions: Detections, repredictions: Detections, minimum_iou: float
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the one-to-one matches within each category that maximise the total BEV IoU.

    Example with two predicted cars A, B, two repredicted cars a, b and `minimum_iou` 0.1:

        BEV IoU      a     b        gain         a     b
              A   0.60  0.50           A      0.60  0.50
              B   0.55  0.05           B      0.55  0.00   (0.05 is not above minimum_iou)

    Greedy matching would pair A with a (0.60) and leave B unmatched. The optimal assignment pairs
    A with b and B with a, total 1.05: the result is matched = [1, 0], iou = [0.50, 0.55]. A pair
    that the assignment contains only to be complete has gain 0 and is discarded.

    If several assignments have the same total, the choice depends on the detections, not on their
    order.

    Args:
        predictions: n detections.
        repredictions: detections in the same frame of reference.
        minimum_iou: pairs with a BEV IoU at or below this never match.

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
        # Pairs that must not match have gain 0, so they do not change the optimum of the others.
        gain = np.where(overlaps > minimum_iou, overlaps, 0.0)
        row, column = linear_sum_assignment(gain, maximize=True)
        valid = gain[row, column] > 0
        row, column = row[valid], column[valid]
        matched[rows[row]] = columns[column]
        iou[rows[row]] = overlaps[row, column]
    return matched, iou


def residual(
    anchors: Float[np.ndarray, "n 7"], targets: Float[np.ndarray, "n 7"]
) -> Float[np.ndarray, "n 7"]:
    """Return the SECOND/OpenPCDet residual of each target box from its anchor box.

    Args:
        anchors: (n, 7) boxes x, y, z, l, w, h, yaw.
        targets: (n, 7) boxes x', y', z', l', w', h', yaw' in the same frame of reference.

    Returns:
        (n, 7) dx/d, dy/d, dz/h, ln l'/l, ln w'/w, ln h'/h, sin(yaw' - yaw), where
        d = sqrt(l^2 + w^2) is the diagonal of the anchor; not finite if a side is not positive.
    """
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])
    scale = np.stack([diagonal, diagonal, anchors[:, 5]], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = (targets[:, :3] - anchors[:, :3]) / scale
        size_ratio = np.log(targets[:, 3:6] / anchors[:, 3:6])
        yaw_difference = np.sin(targets[:, 6:] - anchors[:, 6:])
    return np.concatenate([offset, size_ratio, yaw_difference], axis=1)


def smooth_l1(
    difference: Float[np.ndarray, " *shape"], beta: float
) -> Float[np.ndarray, " *shape"]:
    """Return 0.5 x^2 / beta for |x| < beta, otherwise |x| - 0.5 beta."""
    absolute = np.abs(difference)
    loss: np.ndarray = np.where(absolute < beta, 0.5 * absolute**2 / beta, absolute - 0.5 * beta)
    return loss


def _canonical_order(detections: Detections, category: str) -> np.ndarray:
    """Return the indices of a category's detections by descending score; ties sorted by box."""
    index = np.flatnonzero(detections.categories == category)
    keys = np.column_stack([-detections.scores[index], detections.boxes[index]])
    return index[np.lexsort(keys.T[::-1])]
