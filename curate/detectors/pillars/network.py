"""The pillar network: point features to pillars, a three-scale BEV backbone, boxes and scores."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from curate.detectors.pillars.checkpoint import Checkpoint
from curate.detectors.pillars.encoding import BOX_CODE, POINT_FEATURES
from curate.detectors.pillars.presets import Preset
from curate.errors import ModelError

# Initial probability that a cell contains an object, before training.
_PRIOR = 0.02


class NetworkOutput(NamedTuple):
    """Output of the network for every cell of b frames.

    Attributes:
        logits: (b, x cells, y cells, categories) logits of the scores.
        codes: (b, x cells, y cells, BOX_CODE) box codes.
        iou_logits: (b, x cells, y cells) logits of the 3D IoU of the cell's box with its object.
    """

    logits: Tensor
    codes: Tensor
    iou_logits: Tensor


class PillarNetwork(nn.Module):
    """Maps the pillar features of b frames to logits, box codes and IoU estimates of the boxes.

    All maps are channels-last: on CPU, convolutions and their gradients are about twice as fast
    that way, and 1 x 1 convolutions are plain matrix products.
    """

    def __init__(self, preset: Preset, categories: int) -> None:
        super().__init__()
        self.preset = preset
        self.categories = categories
        first, second, third = preset.channels
        head = preset.head_channels
        self.points = nn.Sequential(
            nn.Linear(POINT_FEATURES, preset.pillar_channels, bias=False),
            nn.BatchNorm1d(preset.pillar_channels),
            nn.ReLU(),
        )
        self.stem = _Pointwise(4 * preset.pillar_channels, first)
        self.stem_norm = nn.BatchNorm2d(first)
        self.scale1 = _scale(first, first, preset.depths[0], down=False)
        self.scale2 = _scale(first, second, preset.depths[1], down=True)
        self.scale3 = _scale(second, third, preset.depths[2], down=True)
        self.up3 = _Pointwise(third, second)
        self.up2 = _Pointwise(second, head)
        self.side1 = _Pointwise(first, head)
        self.head = _convolution(head, head)
        self.answer = nn.Linear(head, categories + BOX_CODE + 1)
        for parameter in self.parameters():
            if parameter.dim() == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
        with torch.no_grad():
            bias = self.answer.bias
            bias.zero_()
            bias[:categories] = torch.logit(torch.tensor(_PRIOR))

    def forward(self, features: Tensor, slots: Tensor, frames: int) -> NetworkOutput:
        """Return the output for a batch.

        Args:
            features: (n, POINT_FEATURES) features of the points of all frames.
            slots: (n,) row of each point's pillar in the canvas of all frames.
            frames: number of frames b.
        """
        maps = self._stem(features, slots, frames)
        fine = self.scale1(functional.relu_(self.stem_norm(maps)))
        middle = self.scale2(fine)
        coarse = self.scale3(middle)
        middle = middle + functional.interpolate(self.up3(coarse), scale_factor=2.0)
        fine = self.side1(fine) + functional.interpolate(self.up2(middle), scale_factor=2.0)
        output = self.answer(self.head(fine).permute(0, 2, 3, 1))
        return NetworkOutput(
            output[..., : self.categories],
            output[..., self.categories : -1],
            output[..., -1],
        )

    def _stem(self, features: Tensor, slots: Tensor, frames: int) -> Tensor:
        """Return the maps of the first scale before their normalisation.

        Only the cells with points are computed, about a tenth of them; the others are zero.
        """
        cells = frames * self.preset.cells[0] * self.preset.cells[1]
        cell = slots // 4
        has_points = torch.zeros(cells, dtype=torch.bool, device=slots.device)
        has_points[cell] = True
        row = has_points.cumsum(0) - 1  # of each cell among those with points
        occupied = has_points.nonzero()[:, 0]
        pillars: Tensor = SlotMaximum.apply(  # type: ignore[no-untyped-call]
            self.points(features), 4 * row[cell] + slots % 4, 4 * len(occupied)
        )
        mixed = self.stem.mix(pillars.view(len(occupied), self.stem.mix.in_features))
        maps: Tensor = mixed.new_zeros(cells, mixed.shape[1]).index_copy(0, occupied, mixed)
        return maps.view(frames, *self.preset.cells, -1).permute(0, 3, 1, 2)


class SlotMaximum(torch.autograd.Function):
    """Maximum over the points of each slot, 0 in empty slots; inputs must not be negative.

    The gradient of autograd's scatter_reduce divides the gradient among equal maxima in several
    passes over the whole canvas, which takes as long as a convolution. Here every equal maximum
    gets the full gradient: ties above zero occur only between copies of a point.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, slots: Tensor, count: int) -> Tensor:
        """Return (count, c) maxima of (n, c) values; row i of the values is in slot slots[i]."""
        index = slots[:, None].expand(-1, values.shape[1])
        highest = values.new_zeros(count, values.shape[1])
        highest = highest.scatter_reduce(0, index, values, "amax", include_self=True)
        ctx.save_for_backward(values, slots, highest)
        return highest

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        """Return the slot's gradient for each point that is its slot's maximum, otherwise 0."""
        values, slots, highest = ctx.saved_tensors
        is_maximum = values == highest.index_select(0, slots)
        return gradient.index_select(0, slots) * is_maximum, None, None


class _Pointwise(nn.Module):
    """A 1 x 1 convolution on channels-last maps."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.mix = nn.Linear(channels_in, channels_out, bias=False)

    def forward(self, maps: Tensor) -> Tensor:
        """Map (b, channels_in, x, y) to (b, channels_out, x, y)."""
        mixed: Tensor = self.mix(maps.permute(0, 2, 3, 1))
        return mixed.permute(0, 3, 1, 2)


def _convolution(channels_in: int, channels_out: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False),
        nn.BatchNorm2d(channels_out),
        nn.ReLU(inplace=True),
    )


def _scale(channels_in: int, channels_out: int, depth: int, *, down: bool) -> nn.Sequential:
    first = [_convolution(channels_in, channels_out, 2)] if down else []
    return nn.Sequential(*first, *(_convolution(channels_out, channels_out) for _ in range(depth)))


def network_of(checkpoint: Checkpoint) -> PillarNetwork:
    """Return the network with the checkpoint's weights, on CPU.

    Raises:
        ModelError: if the checkpoint's tensors are not those of its preset.
    """
    network = PillarNetwork(checkpoint.preset, len(checkpoint.categories))
    state = {name: torch.from_numpy(array) for name, array in checkpoint.weights.items()}
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise ModelError(f"damaged checkpoint: {reason}; train again") from None
    return network


def checkpoint_of(
    network: PillarNetwork,
    categories: tuple[str, ...],
    weights: Mapping[str, Tensor] | None = None,
) -> Checkpoint:
    """Return a checkpoint with copied weights.

    Args:
        network: provides the preset.
        categories: categories that it detects, in the order of its heatmaps.
        weights: state to save; by default the current state of the network.
    """
    state = network.state_dict() if weights is None else weights
    arrays = {
        name: tensor.detach().to("cpu", copy=True).contiguous().numpy()
        for name, tensor in state.items()
    }
    return Checkpoint(network.preset, categories, arrays)
