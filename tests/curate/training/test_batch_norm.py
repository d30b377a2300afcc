"""Batch normalisation over split batches: equal to torch's over the whole batch."""

import copy
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor, nn

from curate.detectors.whole_batch import batch_split, whole_batch_sum
from curate.training.batch_norm import WholeBatchNorm, normalise_whole_batches

KINDS = {2: nn.BatchNorm1d, 3: nn.BatchNorm1d, 4: nn.BatchNorm2d, 5: nn.BatchNorm3d}


class Threads:
    """Threads that sum tensors with each other, in place of processes."""

    def __init__(self, count: int) -> None:
        self._barrier = threading.Barrier(count)
        self._given: dict[int, Tensor] = {}
        self._count = count

    def run(self, work: Callable[[int], object]) -> list:
        """Run the work of each thread and return the results."""
        with batch_split(self._total), ThreadPoolExecutor(self._count) as pool:
            return list(pool.map(work, range(self._count)))

    def _total(self, values: Tensor) -> Tensor:
        self._given[threading.get_ident()] = values.clone()
        self._barrier.wait(timeout=60)
        total = torch.stack(list(self._given.values())).sum(dim=0)
        self._barrier.wait(timeout=60)
        return total


def split_and_whole(parts: list[Tensor], norm: nn.Module, weights: list[Tensor]) -> None:
    """Check outputs, gradients and running statistics of split batches against torch's."""
    for part in parts:
        part.requires_grad_()
    whole = copy.deepcopy(norm)
    expected = whole(torch.cat(parts))
    (expected * torch.cat(weights)).sum().backward()
    gradients = [part.grad for part in parts]
    networks = [nn.Sequential(copy.deepcopy(norm)) for _ in parts]
    for part, network in zip(parts, networks, strict=True):
        part.grad = None
        normalise_whole_batches(network)
        assert type(network[0]) is WholeBatchNorm
        assert list(network.state_dict()) == [f"0.{name}" for name in norm.state_dict()]

    def work(rank: int) -> Tensor:
        output = networks[rank](parts[rank])
        (output * weights[rank]).sum().backward()
        return output.detach()

    outputs = Threads(len(parts)).run(work)
    torch.testing.assert_close(torch.cat(outputs), expected.detach())
    for part, gradient in zip(parts, gradients, strict=True):
        torch.testing.assert_close(part.grad, gradient)
    for name, parameter in whole.named_parameters():
        grads = [dict(network[0].named_parameters())[name].grad for network in networks]
        torch.testing.assert_close(sum(grads), parameter.grad)
    for name, buffer in whole.named_buffers():
        for network in networks:
            torch.testing.assert_close(dict(network[0].named_buffers())[name], buffer)


@pytest.mark.parametrize("shape", [(3,), (3, 7), (3, 5, 4), (3, 2, 5, 4)])
@pytest.mark.parametrize(
    "options", [{}, {"momentum": None}, {"affine": False}, {"track_running_stats": False}]
)
def test_a_split_batch_is_normalised_like_the_whole(shape: tuple, options: dict) -> None:
    """In double precision, with parts of 4, 1 and 0 frames, for two steps."""
    generator = torch.Generator().manual_seed(len(shape))

    def drawn(rows: int) -> Tensor:
        return torch.randn(rows, *shape, generator=generator, dtype=torch.float64) * 3 + 100

    norm = KINDS[len(shape) + 1](3, **options).double()
    if norm.affine:
        nn.init.uniform_(norm.weight, 0.5, 2.0, generator=generator)
        nn.init.uniform_(norm.bias, generator=generator)
    for _ in range(2):
        sizes = (4, 1, 0)
        split_and_whole([drawn(n) for n in sizes], norm, [drawn(n) - 100 for n in sizes])


def test_the_gradient_is_that_of_finite_differences() -> None:
    """Of the whole formula, in one process."""
    norm = nn.Sequential(nn.BatchNorm1d(2).double())
    normalise_whole_batches(norm)
    points = torch.randn(5, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(norm, (points,))


def test_a_small_variance_beside_a_large_mean_is_kept() -> None:
    """30,000 rows in single precision, channels last; torch's own sums lose it."""
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(2, 4, 100, 150, generator=generator, dtype=torch.float64) + 1000
    maps = values.float().contiguous(memory_format=torch.channels_last)
    norm = nn.Sequential(nn.BatchNorm2d(4, momentum=1.0))
    normalise_whole_batches(norm)
    output = norm(maps)
    exact = maps.double().var(dim=(0, 2, 3))
    torch.testing.assert_close(norm[0].running_var.double(), exact, rtol=1e-5, atol=0)
    assert output.is_contiguous(memory_format=torch.channels_last)


def test_half_precision_does_not_overflow() -> None:
    """The sum of 10,000 numbers of 100 is too large for it."""
    norm = nn.Sequential(nn.BatchNorm1d(1))
    normalise_whole_batches(norm)
    output = norm(torch.full((10_000, 1), 100.0, dtype=torch.float16))
    assert output.dtype == torch.float16
    assert output.abs().max() < 1


def test_a_network_in_evaluation_uses_its_running_statistics() -> None:
    norm = nn.Sequential(nn.BatchNorm1d(3))
    points = torch.randn(6, 3)
    norm(points)
    converted = copy.deepcopy(norm)
    normalise_whole_batches(converted)
    assert torch.equal(converted.eval()(points), norm.eval()(points))


def test_a_sum_outside_of_a_split_training_is_the_value_itself() -> None:
    values = torch.ones(3, requires_grad=True)
    assert torch.equal(whole_batch_sum(values), values)
    assert not whole_batch_sum(values).requires_grad
