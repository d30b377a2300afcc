"""Batch normalisation of feature rows that is exact on the CPU.

torch's own sums the variance in float32 when channels are last in memory: at 200,000 rows it is
wrong by up to 1.5 %, which training feels. Here the rows are centred first.
"""

from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable


class RowNorm(nn.BatchNorm1d):
    """Batch normalisation over the rows of (n, channels) features."""

    def forward(self, rows: Tensor) -> Tensor:
        """Return the normalised (n, channels) rows; without rows there are no statistics."""
        if not self.training:
            scale, shift = self.affine_map()
            return torch.addcmul(shift, rows, scale)
        if len(rows) == 0:
            return rows * self.weight
        output: Tensor
        output, mean, variance = _NormaliseRows.apply(  # type: ignore[no-untyped-call]
            rows, self.weight, self.bias, self.eps
        )
        self.update(mean, variance, len(rows))
        return output

    def affine_map(self) -> tuple[Tensor, Tensor]:
        """Return the (channels,) factor and summand that normalise with the running statistics."""
        mean, variance = cast("Tensor", self.running_mean), cast("Tensor", self.running_var)
        scale = self.weight * torch.rsqrt(variance + self.eps)
        return scale, self.bias - mean * scale

    def update(self, mean: Tensor, variance: Tensor, count: int) -> None:
        """Move the running statistics towards those of a batch.

        Args:
            mean: (channels,) mean.
            variance: (channels,) mean squared deviation.
            count: number of rows.
        """
        share = self.momentum or 0.0
        with torch.no_grad():
            unbiased = variance.detach() * (count / max(count - 1, 1))
            self.running_mean.lerp_(mean.detach(), share)  # type: ignore[union-attr]
            self.running_var.lerp_(unbiased, share)  # type: ignore[union-attr]
            self.num_batches_tracked.add_(1)  # type: ignore[union-attr]


class _NormaliseRows(torch.autograd.Function):
    """The normalisation with the statistics of the batch, and its gradients."""

    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor, epsilon: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the normalised rows, their mean and their mean squared deviation."""
        mean = rows.mean(dim=0)
        unit = rows - mean
        variance = unit.square().mean(dim=0)
        inverse = torch.rsqrt(variance + epsilon)
        unit.mul_(inverse)
        ctx.save_for_backward(unit, weight, inverse)
        ctx.mark_non_differentiable(mean, variance)
        return torch.addcmul(bias, unit, weight), mean, variance

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, gradient: Tensor, _mean: Tensor, _variance: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, None]:
        """Return the gradients of rows, weight and bias."""
        unit, weight, inverse = ctx.saved_tensors
        of_bias = gradient.sum(dim=0)
        of_weight = (gradient * unit).sum(dim=0)
        count = len(unit)
        of_rows = gradient - of_bias / count
        of_rows.addcmul_(unit, of_weight, value=-1 / count).mul_(weight * inverse)
        return of_rows, of_weight, of_bias, None
