"""Sums over the whole batch, for a training that splits its batch over several processes.

Each process computes the loss of its own frames. The sum of these losses must be the loss of the
whole batch, so a loss that divides by a count of the batch divides by `whole_batch_sum(count)`:

    loss = each.sum() / whole_batch_sum(positive.sum()).clamp(min=1)

In a training of one process, and outside of a training, this is the count itself.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

# Returns the sum of a tensor over the processes; None if the batch is not split.
_sum: "Callable[[Tensor], Tensor] | None" = None


def whole_batch_sum(values: "Tensor") -> "Tensor":
    """Return the sum of a tensor over the processes that share the batch, without gradient.

    All processes must call it equally often in a step, with tensors of the same shape and type.
    """
    values = values.detach()
    return values if _sum is None else _sum(values)


@contextmanager
def batch_split(total: "Callable[[Tensor], Tensor]") -> Iterator[None]:
    """Let `whole_batch_sum` sum with a function."""
    global _sum  # noqa: PLW0603 - a training has the process to itself
    before, _sum = _sum, total
    try:
        yield
    finally:
        _sum = before
