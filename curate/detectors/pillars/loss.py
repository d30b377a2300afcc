"""The weighted loss of a batch (Eqs. 6 and 10 of An et al., Remote Sensing 15(3):627, 2023).

    L = 1/n * sum over X_l of L_3d + 1/n * sum over X_u of v * L_3d

L_3d is the penalty-reduced focal loss of the heatmap (Law and Deng, CornerNet, ECCV 2018) plus an
L1 loss of the box code plus the cross-entropy of the estimated 3D IoU of the answered box, after
AFDetV2 (Hu et al., AAAI 2022), which is also taught that what it finds beside all objects overlaps
none. v multiplies all that an object says: that its centre is a centre,
what its box is, how good the answer is, and that the cells around its centre are not centres. v = 0
leaves its region without gradient: it is neither object nor background. n is a constant of the
training, never a sum of weights, which would cancel them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from curate.detectors.pillars.encoding import Targets, code_ious
from curate.detectors.pillars.network import Answers
from curate.detectors.pillars.presets import Preset

# Weight of the box term against the classification term.
BOX_WEIGHT = 1.0
# Weight of the IoU term.
IOU_WEIGHT = 1.0
# A cell beside all objects that answers with a higher score has found something that is not there.
_FOUND_SCORE = 0.1
# An object's nine cells share one weight; so do, roughly, those that find the same false one.
_FALSE_SHARE = 1 / 9


@dataclass(frozen=True)
class BatchTargets:
    """The targets of b frames as tensors; cells are flat over the batch.

    Attributes:
        heatmap: (b, x cells, y cells, categories).
        background: (b, x cells, y cells, 1).
        centres: (m,) cells, m the objects of all frames.
        categories: (m,).
        weights: (m,) v.
        code_cells: (r,).
        codes: (r, BOX_CODE).
        code_weights: (r,).
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
        """Return the targets of several frames."""
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
    """Sum of the classification terms.

    Args:
        logits: (b, x cells, y cells, categories).
        targets: of the same b frames.
    """
    log_object = functional.logsigmoid(logits)
    log_background = log_object - logits
    probability = log_object.exp()
    doubt = (1 - targets.heatmap).square().square() * targets.background
    negative = -(doubt * probability.square() * log_background).sum()
    at = (targets.centres, targets.categories)
    log_found = log_object.flatten(0, 2)[at]
    missed = 1 - log_found.exp()
    return negative - (targets.weights * missed.square() * log_found).sum()


def box_loss(codes: Tensor, targets: BatchTargets) -> Tensor:
    """Sum of the box terms.

    Args:
        codes: (b, x cells, y cells, BOX_CODE).
        targets: of the same b frames.
    """
    answered = codes.flatten(0, 2)[targets.code_cells]
    return (targets.code_weights[:, None] * (answered - targets.codes).abs()).sum()


def iou_loss(answers: Answers, targets: BatchTargets, preset: Preset) -> Tensor:
    """Sum of the IoU terms: how well each answered box knows its overlap with the object.

    The overlap itself is exact and has no gradient; beside all objects it is 0.

    Args:
        answers: of the network for b frames.
        targets: of the same b frames.
        preset: the grid.
    """
    cells = targets.code_cells
    answered, true = answers.codes.detach().flatten(0, 2)[cells].cpu(), targets.codes.cpu()
    in_frame = cells.cpu().numpy() % (preset.cells[0] * preset.cells[1])
    overlap = code_ious(answered.numpy(), true.numpy(), in_frame, preset)
    estimated = answers.iou_logits.flatten()[cells]
    exact = torch.from_numpy(overlap).to(estimated)
    right = functional.binary_cross_entropy_with_logits(
        estimated, exact, targets.code_weights, reduction="sum"
    )
    false = answers.iou_logits[_found_beside(answers.logits, targets)]
    return right + _FALSE_SHARE * functional.softplus(false).sum()


def _found_beside(logits: Tensor, targets: BatchTargets) -> Tensor:
    """(b, x cells, y cells) bool, cells beside all objects and ignored regions that find one."""
    # The gaussian does not reach the corners of its box; one cell more does.
    near = functional.max_pool2d(targets.heatmap.amax(-1), 3, stride=1, padding=1)
    beside = (near == 0) & (targets.background[..., 0] == 1)
    return beside & (torch.sigmoid(logits.detach()).amax(-1) > _FOUND_SCORE)


def weighted_loss(
    answers: Answers, targets: BatchTargets, preset: Preset, objects: float
) -> dict[str, Tensor]:
    """Return the loss of a batch, and the terms that it is the sum of, without gradient.

    Args:
        answers: of the network for b frames.
        targets: of the same b frames.
        preset: the grid.
        objects: n, how many objects the batch's frames of X_l are expected to hold.
    """
    box = BOX_WEIGHT * box_loss(answers.codes, targets)
    iou = IOU_WEIGHT * iou_loss(answers, targets, preset)
    heatmap = heatmap_loss(answers.logits, targets)
    terms = {"heatmap": heatmap, "box": box, "iou": iou}
    shares = {name: term.detach() / objects for name, term in terms.items()}
    return {"loss": (heatmap + box + iou) / objects, **shares}
