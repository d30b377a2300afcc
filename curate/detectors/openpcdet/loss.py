"""The loss of both stages, with the weights of the objects.

    L = class + box + direction terms of the anchors  +  score + box + corner terms of the proposals

Sources: Lin et al., "Focal Loss", ICCV 2017; Yan, Mao and Li, "SECOND", Sensors 18(10), 2018; Qi et
al., "Frustum PointNets", CVPR 2018 (corner loss); factors from the model file.

v multiplies every term of an anchor or proposal that learns the object. The normalisers are counts:
the positives of a frame, the frames, the proposals. Sums of weights would cancel the weights.

Example: two positive anchors with v = 0.5 in a frame and box terms of 3 and 1 give the frame's box
loss (0.5 * 3 + 0.5 * 1) / 2 = 1, half of that with v = 1.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

from curate.detectors.openpcdet.anchors import turned, wrap
from curate.detectors.openpcdet.network import FirstStage
from curate.detectors.openpcdet.roi_head import refine
from curate.detectors.openpcdet.schema import AnchorHead, VoxelRCNNHead
from curate.detectors.openpcdet.targets import AnchorTargets, RoITargets
from curate.detectors.whole_batch import whole_batch_sum

# Focal loss: share of the positives, and exponent.
_ALPHA = 0.25
_GAMMA = 2
# Deviation of a code at which the smooth L1 loss becomes linear.
_BETA = 1 / 9


def anchor_loss(stage: FirstStage, targets: AnchorTargets, config: AnchorHead) -> dict[str, Tensor]:
    """Return the weighted terms of the first stage: means over the frames.

    Args:
        stage: output of the first stage.
        targets: targets of the same frames.
        config: factors of the terms, and the bins of the direction.
    """
    factors = config.loss_config.loss_weights
    frames = whole_batch_sum(targets.counts.new_tensor(len(targets.counts)))
    # A frame without positives is divided by 1.
    shares = 1 / (targets.counts.clamp(min=1) * frames)
    at = (targets.rows, targets.anchors)
    trust = targets.weights[at] * shares[targets.rows]
    per_anchor = (targets.weights * shares[:, None])[..., None]
    logits = stage.class_logits
    background = (1 - _ALPHA) * torch.sigmoid(logits) ** _GAMMA * functional.softplus(logits)
    own = logits[targets.rows, targets.anchors, targets.classes]
    foreground = _ALPHA * torch.sigmoid(-own) ** _GAMMA * functional.softplus(-own)
    instead = background[targets.rows, targets.anchors, targets.classes]
    classes = (per_anchor * background).sum() + (trust * (foreground - instead)).sum()
    boxes = (trust[:, None] * code_loss(stage.codes[at], targets.codes, factors.code_weights)).sum()
    terms = {
        "rpn_loss_cls": factors.cls_weight * classes,
        "rpn_loss_loc": factors.loc_weight * boxes,
    }
    if stage.direction_logits is not None:
        period = 2 * math.pi / config.num_dir_bins
        yaws = wrap(targets.yaws - config.dir_offset, 0.0)
        bins = (yaws / period).long().clamp(0, config.num_dir_bins - 1)
        entropy = functional.cross_entropy(stage.direction_logits[at], bins, reduction="none")
        terms["rpn_loss_dir"] = factors.dir_weight * (trust * entropy).sum()
    return terms


def code_loss(codes: Tensor, targets: Tensor, factors: tuple[float, ...]) -> Tensor:
    """Return the (n, 7) smooth L1 losses of box codes; yaws by the sine of their difference.

    The sine does not tell a box from the one turned by half a turn: the direction classifier does.
    """
    difference = codes - targets
    sine = torch.sin(codes[:, 6:]) * torch.cos(targets[:, 6:])
    sine = sine - torch.cos(codes[:, 6:]) * torch.sin(targets[:, 6:])
    return _smooth_l1(torch.cat([difference[:, :6], sine], dim=1), factors)


def roi_loss(
    logits: Tensor, codes: Tensor, targets: RoITargets, config: VoxelRCNNHead
) -> dict[str, Tensor]:
    """Return the weighted terms of the second stage: means over the proposals that learn.

    Args:
        logits: (n,) logits of the scores.
        codes: (n, 7) box codes.
        targets: targets of the n proposals.
        config: factors of the terms.
    """
    factors = config.loss_config.loss_weights
    entropy = functional.binary_cross_entropy_with_logits(logits, targets.scores, reduction="none")
    own_counts = torch.stack([(targets.weights > 0).sum(), (targets.box_weights > 0).sum()])
    counted, refined = whole_batch_sum(own_counts).clamp(min=1)
    own = codes[targets.refined]
    boxes = _smooth_l1(own - targets.codes, factors.code_weights).sum(dim=1)
    terms = {
        "rcnn_loss_cls": factors.rcnn_cls_weight * (targets.weights * entropy).sum() / counted,
        "rcnn_loss_reg": factors.rcnn_reg_weight * (targets.box_weights * boxes).sum() / refined,
    }
    if config.loss_config.corner_loss_regularization:
        found = refine(own, targets.rois[targets.refined])
        corner = (targets.box_weights * corner_loss(found, targets.boxes)).sum() / refined
        terms["rcnn_loss_corner"] = factors.rcnn_corner_weight * corner
    return terms


def corner_loss(boxes: Tensor, targets: Tensor) -> Tensor:
    """Return the (n,) mean distances of the corners of boxes, as Huber losses.

    A corner is compared with that of the target or of the target turned by half a turn, whichever
    is nearer.
    """
    half_turn = targets.new_tensor([0, 0, 0, 0, 0, 0, math.pi])
    corners = _corners(boxes)
    distances = torch.minimum(
        torch.linalg.vector_norm(corners - _corners(targets), dim=2),
        torch.linalg.vector_norm(corners - _corners(targets + half_turn), dim=2),
    )
    return functional.huber_loss(distances, torch.zeros_like(distances), reduction="none").mean(1)


def _corners(boxes: Tensor) -> Tensor:
    """Return the (n, 8, 3) corners of boxes."""
    signs = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], device=boxes.device)] * 3)
    local = signs * boxes[:, None, 3:6]
    return turned(local, boxes[:, 6]) + boxes[:, None, :3]


def _smooth_l1(difference: Tensor, factors: tuple[float, ...]) -> Tensor:
    """Return the smooth L1 losses of (n, 7) differences, each multiplied by its factor first."""
    scaled = difference * difference.new_tensor(factors)
    return functional.smooth_l1_loss(scaled, torch.zeros_like(scaled), reduction="none", beta=_BETA)
