"""Submanifold, strided and inverse sparse convolution with gradients.

For each cell of the kernel, the rows of its inputs are gathered, multiplied by its weights and
added to the rows of its outputs. The backward pass gathers again, so that only the features and the
weights are stored. The order of all sums is fixed: on the CPU the result is the same in every run.

Weights have the layout of spconv 2, (channels out, z, y, x, channels in), so that the checkpoints
of OpenPCDet load as they are.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from curate.detectors.openpcdet.sparse.rulebook import (
    Rulebook,
    strided_rulebook,
    submanifold_rulebook,
)
from curate.detectors.openpcdet.sparse.sites import Sites, Triple


@dataclass(frozen=True)
class SparseTensor:
    """Features at the occupied cells of a grid.

    Attributes:
        features: (n, channels).
        sites: the n cells.
    """

    features: Tensor
    sites: Sites

    def dense(self) -> Tensor:
        """Return the features as a (frames, channels, z, y, x) tensor with 0 in free cells."""
        sites, channels = self.sites, self.features.shape[1]
        height, depth, width = sites.shape
        frame, z, y, x = sites.places.unbind(dim=1)
        cell = ((frame * height + z) * depth + y) * width + x
        flat = self.features.new_zeros(sites.frames * height * depth * width, channels)
        flat = flat.index_copy(0, cell, self.features)
        return flat.view(sites.frames, height, depth, width, channels).permute(0, 4, 1, 2, 3)


class _Convolution(nn.Module):
    """Weights of a sparse convolution, initialised like those of a dense one."""

    def __init__(self, channels_in: int, channels_out: int, kernel: Triple) -> None:
        super().__init__()
        self.kernel = kernel
        self.weight = nn.Parameter(torch.empty(channels_out, *kernel, channels_in))
        nn.init.uniform_(self.weight, *_uniform_bounds(channels_in * math.prod(kernel)))

    def convolve(self, features: Tensor, rulebook: Rulebook) -> SparseTensor:
        """Return the features of the rulebook's outputs."""
        weights = self.weight.flatten(1, 3).permute(1, 2, 0).contiguous()
        output: Tensor = _SparseConvolution.apply(  # type: ignore[no-untyped-call]
            _autocast(features), _autocast(weights), rulebook
        )
        return SparseTensor(output, rulebook.after)


class SubmanifoldConvolution(_Convolution):
    """A convolution with its input cells as output cells; the kernel is odd."""

    def forward(self, tensor: SparseTensor) -> SparseTensor:
        """Return the convolved tensor."""
        return self.convolve(tensor.features, submanifold_rulebook(tensor.sites, self.kernel))


class StridedConvolution(_Convolution):
    """A convolution with an output wherever the kernel meets an input."""

    def __init__(
        self, channels_in: int, channels_out: int, kernel: Triple, stride: Triple, padding: Triple
    ) -> None:
        super().__init__(channels_in, channels_out, kernel)
        self.stride = stride
        self.padding = padding

    def rulebook(self, sites: Sites) -> Rulebook:
        """Return the rulebook for these input cells."""
        return strided_rulebook(sites, self.kernel, self.stride, self.padding)

    def forward(self, tensor: SparseTensor) -> SparseTensor:
        """Return the convolved tensor."""
        return self.convolve(tensor.features, self.rulebook(tensor.sites))


class InverseConvolution(_Convolution):
    """A convolution from the outputs of a strided one back to its input cells."""

    def forward(self, tensor: SparseTensor, strided: Rulebook) -> SparseTensor:
        """Return the convolved tensor.

        Args:
            tensor: features at the output cells of the strided convolution.
            strided: rulebook of the strided convolution.
        """
        return self.convolve(tensor.features, strided.inverse())


def _autocast(tensor: Tensor) -> Tensor:
    """Return a tensor in the type of mixed precision; torch casts only for its own functions."""
    kind = tensor.device.type
    return tensor.to(torch.get_autocast_dtype(kind)) if torch.is_autocast_enabled(kind) else tensor


def _uniform_bounds(fan_in: int) -> tuple[float, float]:
    """Return the bounds of He's uniform initialisation as torch uses it for convolutions."""
    bound = 1 / math.sqrt(max(fan_in, 1))
    return -bound, bound


class _SparseConvolution(torch.autograd.Function):
    """The function and its gradients; weights are (cells of the kernel, channels in, out)."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weights: Tensor, rulebook: Rulebook) -> Tensor:
        """Return (outputs, channels out) features."""
        ctx.save_for_backward(features, weights)
        ctx.rulebook = rulebook
        return _gather_multiply_add(features, weights, rulebook)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        """Return the gradients of features and weights."""
        features, weights = ctx.saved_tensors
        rulebook: Rulebook = ctx.rulebook
        of_features = of_weights = None
        gradient = gradient.contiguous()
        if ctx.needs_input_grad[0]:
            of_features = _gather_multiply_add(
                gradient, weights.transpose(1, 2), rulebook.inverse()
            )
        if ctx.needs_input_grad[1]:
            of_weights = torch.zeros_like(weights)
            for k, (start, end) in enumerate(pairwise(rulebook.starts)):
                if k == rulebook.centre:
                    torch.mm(features.t(), gradient, out=of_weights[k])
                elif end > start:
                    inputs = features.index_select(0, rulebook.inputs[start:end])
                    outputs = gradient.index_select(0, rulebook.outputs[start:end])
                    torch.mm(inputs.t(), outputs, out=of_weights[k])
        return of_features, of_weights, None


def _gather_multiply_add(features: Tensor, weights: Tensor, rulebook: Rulebook) -> Tensor:
    """Return the (outputs, channels out) sums over the kernel's cells."""
    centre = rulebook.centre
    if centre is None:
        output = features.new_zeros(len(rulebook.after), weights.shape[2])
    else:
        output = features @ weights[centre]
    for k, (start, end) in enumerate(pairwise(rulebook.starts)):
        if k != centre and end > start:
            rows = features.index_select(0, rulebook.inputs[start:end]) @ weights[k]
            output.index_add_(0, rulebook.outputs[start:end], rows)
    return output
