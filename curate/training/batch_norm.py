"""Batch normalisation over a batch that is split over several processes.

torch's `SyncBatchNorm` runs on GPUs only. This one runs everywhere. It normalises with the mean and
variance of the whole batch, in forward and backward:

    forward     n, sum x and sum x^2 are summed over the processes
                y = (x - mean) * a + bias,  a = weight / sqrt(variance + eps)
    backward    sum dy and sum dy * x_hat are summed over the processes
                dx = a * (dy - mean(dy) - x_hat * mean(dy * x_hat)),  x_hat = (x - mean) / sigma

Squares are summed around the mean of the process's own part and joined in double precision (Chan,
Golub and LeVeque, 1983), so that a large mean does not drown a small variance.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from curate.detectors.whole_batch import whole_batch_sum


class WholeBatchNorm(_BatchNorm):
    """A batch normalisation with statistics of the whole batch; see `normalise_whole_batches`."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 - torch's name
        """Return the normalised input (b, channels, ...)."""
        if not (self.training or self.running_mean is None):
            return super().forward(input)
        full = input if input.dtype == torch.float64 else input.float()  # sums overflow in half
        output, mean, variance, count = _Normalise.apply(  # type: ignore[no-untyped-call]
            full, self.weight, self.bias, self.eps
        )
        if self.training and self.track_running_stats:
            self._track(mean, variance * (count / (count - 1).clamp(min=1)))
        normalised: Tensor = output.to(input.dtype)
        return normalised

    def _track(self, mean: Tensor, variance: Tensor) -> None:
        """Update the running statistics as torch does, with the unbiased variance."""
        running = (self.running_mean, self.running_var, self.num_batches_tracked)
        running_mean, running_variance, batches = running
        if running_mean is None or running_variance is None or batches is None:
            return
        batches.add_(1)
        share = 1 / float(batches) if self.momentum is None else self.momentum
        running_mean.lerp_(mean.to(running_mean), share)
        running_variance.lerp_(variance.to(running_variance), share)

    def _check_input_dim(self, input: Tensor) -> None:  # noqa: A002 - torch's name
        """Accept any number of dimensions."""


class _Normalise(torch.autograd.Function):
    """The formulas at the head of this module; statistics are double precision."""

    @staticmethod
    def forward(
        ctx: Any, values: Tensor, weight: Tensor | None, bias: Tensor | None, eps: float
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the normalised values, and (c,) mean, (c,) variance and count of the batch."""
        others, shape = _other_dimensions(values)
        rows = values.numel() // max(values.shape[1], 1)
        own_mean = values.sum(others) / max(rows, 1)
        buffer = values - own_mean.view(shape)
        squares = buffer.square_().sum(others).double()
        own_mean = own_mean.double()
        own_sums = torch.stack([rows * own_mean, squares + rows * own_mean.square()])
        own_count = own_sums.new_full((1,), rows)
        sums = whole_batch_sum(torch.cat([own_count, own_sums.flatten()]))
        count, (total, total_of_squares) = sums[0], sums[1:].view(2, -1)
        divisor = count.clamp(min=1)
        mean = total / divisor
        variance = (total_of_squares / divisor - mean.square()).clamp(min=0)
        inverse = (variance + eps).rsqrt()
        factor = inverse if weight is None else inverse * weight
        offset = -mean * factor if bias is None else bias - mean * factor
        ctx.save_for_backward(values, mean, inverse, factor, divisor)
        ctx.weight_type = None if weight is None else weight.dtype
        ctx.mark_non_differentiable(mean, variance, count)
        offset, slope = (each.to(values.dtype).view(shape) for each in (offset, factor))
        return torch.addcmul(offset, values, slope, out=buffer), mean, variance, count

    @staticmethod
    def backward(
        ctx: Any, gradient: Tensor, *_: Tensor
    ) -> tuple[Tensor, Tensor | None, Tensor | None, None]:
        """Return the gradients of the values, and this process's part of the parameters'."""
        values, mean, inverse, factor, divisor = ctx.saved_tensors
        others, shape = _other_dimensions(values)
        shifted = values - mean.to(values.dtype).view(shape)
        buffer = gradient * shifted
        own_sums = torch.stack([gradient.sum(others), buffer.sum(others)]).double()
        own_sums[1] *= inverse
        mean_gradient, mean_product = whole_batch_sum(own_sums) / divisor
        terms = (-factor * mean_gradient, -factor * inverse * mean_product, factor)
        offset, slope, scale = (each.to(values.dtype).view(shape) for each in terms)
        torch.addcmul(offset, shifted, slope, out=buffer).addcmul_(gradient, scale)
        if ctx.weight_type is None:
            return buffer, None, None, None
        of_bias, of_weight = own_sums.to(ctx.weight_type)
        return buffer, of_weight, of_bias, None


def _other_dimensions(values: Tensor) -> tuple[list[int], list[int]]:
    """Return the dimensions without that of the channels, and the shape of a value per channel."""
    others = [dimension for dimension in range(values.dim()) if dimension != 1]
    return others, [-1 if dimension == 1 else 1 for dimension in range(values.dim())]


def normalise_whole_batches(network: nn.Module) -> None:
    """Replace the batch normalisations of a network by ones with statistics of the whole batch.

    Parameters and buffers stay the same objects with the same names, so optimisers, state dicts and
    checkpoints do not change. Only torch's own classes are replaced.
    """
    for module in list(network.modules()):
        for name, child in module.named_children():
            if type(child) in _REPLACED:
                setattr(module, name, _whole(child))


_REPLACED = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d)


def _whole(norm: Any) -> WholeBatchNorm:
    made = WholeBatchNorm(
        norm.num_features, norm.eps, norm.momentum, norm.affine, norm.track_running_stats
    )
    made._parameters, made._buffers = norm._parameters, norm._buffers  # noqa: SLF001
    return made.train(norm.training)
