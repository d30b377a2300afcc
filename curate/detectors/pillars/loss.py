"""The weighted loss of a batch (Eqs. 6 and 10 of An et al., Remote Sensing 15(3):627, 2023).

    L = 1/n * sum over X_l of L_3d + 1/n * sum over X_u of v * L_3d

L_3d is the sum of three terms:

- heatmap: penalty-reduced focal loss (Law and Deng, CornerNet, ECCV 2018),
- box: L1 loss of the box code,
- IoU: cross-entropy of the estimated 3D IoU of the predicted box (Hu et al., AFDetV2, AAAI 2022).
  For a false positive, a cell away from all objects that finds one, the target is 0.

v multiplies every contribution of an object: the positive at its centre, the negatives in the cells
of its region, its box and its IoU. Cells outside all regions are background with weight 1. n is a
constant of the training; a sum of weights would cancel the weights.

Example: heatmap terms of a car with v = 0.5, if the network predicts the score p = 1/4 in each cell

    centre cell of the car          v * (1 - p)^2 * -ln p             = 0.5 * 0.780  = 0.390
    region, heatmap value h = 0.4   v * (1 - h)^4 * p^2 * -ln(1 - p)  = 0.5 * 0.0023 = 0.001
    cell away from all objects      1 * (1 - 0)^4 * p^2 * -ln(1 - p)                 = 0.018

Meaning of v = 0: a box that reaches this loss with v = 0 is an ignore region, neither object nor
background: all cells of its region get weight 0 and no gradient. Pseudo-labels of weight 0 that
count as background, the default of the policies, do not get here: `Augmentation.apply` removes them
from the sample, so their cells are background with weight 1 like any other cell without an object.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from curate.detectors.pillars.encoding import Targets, code_ious
from curate.detectors.pillars.network import NetworkOutput
from curate.detectors.pillars.presets import Preset

# Weight of the box term against the classification term.
BOX_WEIGHT = 1.0
# Weight of the IoU term.
IOU_WEIGHT = 1.0
# A cell away from all objects with a higher score than this is a false positive.
_FALSE_POSITIVE_SCORE = 0.1
# The nine cells of an object share its weight. About as many cells find the same false positive.
_FALSE_POSITIVE_WEIGHT = 1 / 9


@dataclass(frozen=True)
class BatchTargets:
    """The targets of b frames as tensors; see `Targets`. Flat cell indices run over the batch.

    Attributes:
        heatmap: (b, x cells, y cells, categories).
        background: (b, x cells, y cells, 1).
        centres: (m,) centre cells of the m objects of all frames.
        categories: (m,) category numbers.
        weights: (m,) weights v.
        code_cells: (r,) cells that learn a box.
        codes: (r, BOX_CODE) box codes.
        code_weights: (r,) weights of the box codes.
    """

    heatmap: Tensor
    background: Tensor
    centres: Tensor
    categories: Tensor
    weights: Tensor
    code_cells: Tensor
    codes: Tensor
    code_weights: Tensor

    @classmethod
    def stack(cls, targets: Sequence[Targets], device: str = "cpu") -> "BatchTargets":
        """Return the targets of several frames as one batch."""
        cells = targets[0].background.size

        def joined(name: str, step: int = 0) -> Tensor:
            parts = [getattr(target, name) + i * step for i, target in enumerate(targets)]
            return torch.from_numpy(np.concatenate(parts)).to(device)

        return cls(
            torch.from_numpy(np.stack([target.heatmap for target in targets])).to(device),
            torch.from_numpy(np.stack([target.background for target in targets]))
            .to(device)
            .unsqueeze(-1),
            joined("centres", cells),
            joined("categories"),
            joined("weights"),
            joined("code_cells", cells),
            joined("codes"),
            joined("code_weights"),
        )


def heatmap_loss(logits: Tensor, targets: BatchTargets) -> Tensor:
    """Return the sum of the classification terms, see the example at the head of this module.

    Args:
        logits: (b, x cells, y cells, categories).
        targets: targets of the same b frames.
    """
    log_object = functional.logsigmoid(logits)
    log_background = log_object - logits
    probability = log_object.exp()
    negative_weight = (1 - targets.heatmap).square().square() * targets.background
    negative = -(negative_weight * probability.square() * log_background).sum()
    at_centres = (targets.centres, targets.categories)
    log_score = log_object.flatten(0, 2)[at_centres]
    missed = 1 - log_score.exp()
    return negative - (targets.weights * missed.square() * log_score).sum()


def box_loss(codes: Tensor, targets: BatchTargets) -> Tensor:
    """Return the weighted sum of the L1 differences between box codes.

    Args:
        codes: (b, x cells, y cells, BOX_CODE) predicted box codes.
        targets: targets of the same b frames.
    """
    predicted = codes.flatten(0, 2)[targets.code_cells]
    return (targets.code_weights[:, None] * (predicted - targets.codes).abs()).sum()


def iou_loss(output: NetworkOutput, targets: BatchTargets, preset: Preset) -> Tensor:
    """Return the sum of the IoU terms: cross-entropy of each estimated IoU against the actual one.

    The actual IoU of the predicted box with its object is exact and has no gradient. It is 0 for
    false positives.

    Args:
        output: output of the network for b frames.
        targets: targets of the same b frames.
        preset: the grid.
    """
    cells = targets.code_cells
    predicted, target = output.codes.detach().flatten(0, 2)[cells].cpu(), targets.codes.cpu()
    cells_in_frame = cells.cpu().numpy() % (preset.cells[0] * preset.cells[1])
    overlap = code_ious(predicted.numpy(), target.numpy(), cells_in_frame, preset)
    estimated = output.iou_logits.flatten()[cells]
    actual = torch.from_numpy(overlap).to(estimated)
    objects = functional.binary_cross_entropy_with_logits(
        estimated, actual, targets.code_weights, reduction="sum"
    )
    false_positives = output.iou_logits[_false_positives(output.logits, targets)]
    return objects + _FALSE_POSITIVE_WEIGHT * functional.softplus(false_positives).sum()


def _false_positives(logits: Tensor, targets: BatchTargets) -> Tensor:
    """Return (b, x cells, y cells) bool: cells that find an object away from all regions."""
    # The gaussian does not reach the corners of its box; with one more cell it does.
    near_object = functional.max_pool2d(targets.heatmap.amax(-1), 3, stride=1, padding=1)
    away = (near_object == 0) & (targets.background[..., 0] == 1)
    return away & (torch.sigmoid(logits.detach()).amax(-1) > _FALSE_POSITIVE_SCORE)


def weighted_loss(
    output: NetworkOutput, targets: BatchTargets, preset: Preset, objects: float
) -> dict[str, Tensor]:
    """Return the loss of a batch, and its terms without gradient.

    Args:
        output: output of the network for b frames.
        targets: targets of the same b frames.
        preset: the grid.
        objects: n, the expected number of objects in the labeled frames of the batch.
    """
    box = BOX_WEIGHT * box_loss(output.codes, targets)
    iou = IOU_WEIGHT * iou_loss(output, targets, preset)
    heatmap = heatmap_loss(output.logits, targets)
    terms = {"heatmap": heatmap, "box": box, "iou": iou}
    shares = {name: term.detach() / objects for name, term in terms.items()}
    return {"loss": (heatmap + box + iou) / objects, **shares}
