"""Sparse convolution against dense convolution, finite differences and itself."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from curate.detectors.openpcdet.sparse import (
    InverseConvolution,
    Sites,
    SparseTensor,
    StridedConvolution,
    SubmanifoldConvolution,
)
from curate.detectors.openpcdet.sparse.rulebook import strided_rulebook, submanifold_rulebook
from curate.errors import ConfigError

SIZES = st.integers(1, 5)


@st.composite
def geometries(draw: st.DrawFn) -> tuple[torch.Tensor, tuple[int, int, int], int]:
    """Draw the occupied cells of a small grid: none, a few or all of them, in any order."""
    shape = (draw(SIZES), draw(SIZES), draw(SIZES))
    frames = draw(st.integers(1, 2))
    share, seed = draw(st.sampled_from((0.0, 0.1, 0.5, 1.0))), draw(st.integers(0, 2**16))
    generator = torch.Generator().manual_seed(seed)
    places = torch.nonzero(torch.rand(frames, *shape, generator=generator) < share)
    return places[torch.randperm(len(places), generator=generator)], shape, frames


def random_tensor(places, shape, frames, channels: int, seed: int = 0) -> SparseTensor:
    """Return random features in float64 at cells."""
    sites, order = Sites.of(places, shape, frames)
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(len(places), channels, generator=generator, dtype=torch.float64)
    return SparseTensor(features[order], sites)


def dense_weight(convolution) -> torch.Tensor:
    """Return the weight in the layout of torch's dense convolution."""
    return convolution.weight.permute(0, 4, 1, 2, 3)


def at_sites(dense: torch.Tensor, sites: Sites) -> torch.Tensor:
    """Return the (n, channels) values of a dense tensor at cells."""
    frame, z, y, x = sites.places.T
    return dense[frame, :, z, y, x]


ODD = st.sampled_from(((3, 3, 3), (1, 3, 3), (3, 1, 1), (5, 3, 1), (1, 1, 1)))
STRIDED = st.sampled_from((
    ((3, 3, 3), (2, 2, 2), (1, 1, 1)),
    ((3, 3, 3), (2, 2, 2), (0, 1, 1)),
    ((3, 1, 1), (2, 1, 1), (0, 0, 0)),
    ((2, 2, 2), (2, 2, 2), (0, 0, 0)),
    ((3, 3, 3), (1, 2, 3), (1, 0, 2)),
))  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(geometries(), ODD)
def test_submanifold_equals_dense_at_its_sites(geometry, kernel) -> None:
    tensor = random_tensor(*geometry, channels=3)
    convolution = SubmanifoldConvolution(3, 2, kernel).double()
    padding = tuple(size // 2 for size in kernel)
    expected = functional.conv3d(tensor.dense(), dense_weight(convolution), padding=padding)
    found = convolution(tensor)
    assert found.sites is tensor.sites
    torch.testing.assert_close(found.features, at_sites(expected, tensor.sites))


@settings(max_examples=60, deadline=None)
@given(geometries(), STRIDED)
def test_strided_equals_dense_everywhere(geometry, spec) -> None:
    """Cells that no input reaches are free, and 0 in the dense result."""
    kernel, stride, padding = spec
    tensor = random_tensor(*geometry, channels=3)
    convolution = StridedConvolution(3, 2, kernel, stride, padding).double()
    sizes = zip(tensor.sites.shape, kernel, padding, strict=True)
    if any(size + 2 * pad < cells for size, cells, pad in sizes):
        with pytest.raises(ConfigError, match="too small"):
            convolution(tensor)
        return
    found = convolution(tensor)
    expected = functional.conv3d(
        tensor.dense(), dense_weight(convolution), stride=stride, padding=padding
    )
    torch.testing.assert_close(found.dense(), expected)


@settings(max_examples=40, deadline=None)
@given(geometries())
def test_inverse_equals_transposed_dense_at_the_inputs(geometry) -> None:
    tensor = random_tensor(*geometry, channels=2)
    down = StridedConvolution(2, 3, (3, 3, 3), (2, 2, 2), (1, 1, 1)).double()
    up = InverseConvolution(3, 2, (3, 3, 3)).double()
    middle = down(tensor)
    found = up(middle, down.rulebook(tensor.sites))
    assert found.sites.same(tensor.sites)
    extra = [size - ((size - 1) // 2 * 2 + 1) for size in tensor.sites.shape]
    expected = functional.conv_transpose3d(
        middle.dense(), up.weight.permute(4, 0, 1, 2, 3), stride=2, padding=1, output_padding=extra
    )
    torch.testing.assert_close(found.features, at_sites(expected, tensor.sites))


@settings(max_examples=60, deadline=None)
@given(geometries(), ODD, STRIDED)
def test_compiled_rulebooks_equal_those_of_torch(geometry, kernel, spec) -> None:
    """The same pairs in the same order, so that the same sums are formed."""
    places, shape, frames = geometry
    books = []
    for compiled in (True, False):
        sites, _ = Sites.of(places, shape, frames)
        found = [submanifold_rulebook(sites, kernel, compiled=compiled)]
        if all(
            size + 2 * pad >= cells
            for size, cells, pad in zip(shape, spec[0], spec[2], strict=True)
        ):
            found.append(strided_rulebook(sites, *spec, compiled=compiled))
        books.append(found)
    for one, other in zip(*books, strict=True):
        assert torch.equal(one.inputs, other.inputs)
        assert torch.equal(one.outputs, other.outputs)
        assert one.starts == other.starts
        assert one.after.same(other.after)


@pytest.mark.parametrize("kind", ["submanifold", "strided", "inverse"])
def test_gradients_equal_finite_differences(kind: str) -> None:
    generator = torch.Generator().manual_seed(1)
    places = torch.nonzero(torch.rand(2, 3, 4, 3, generator=generator) < 0.4)
    tensor = random_tensor(places, (3, 4, 3), 2, channels=2)
    down = StridedConvolution(2, 2, (3, 3, 3), (2, 2, 2), (1, 1, 1)).double()
    modules = {
        "submanifold": SubmanifoldConvolution(2, 2, (3, 3, 3)).double(),
        "strided": down,
        "inverse": InverseConvolution(2, 2, (3, 3, 3)).double(),
    }
    module, sites, more = modules[kind], tensor.sites, ()
    features = tensor.features
    if kind == "inverse":
        middle = down(tensor)
        sites, more = middle.sites, (down.rulebook(tensor.sites),)
        features = middle.features.detach()

    def function(features: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        tensor = SparseTensor(features, sites)
        return torch.func.functional_call(module, {"weight": weight}, (tensor, *more)).features

    inputs = (features.requires_grad_(), module.weight.detach().requires_grad_())
    assert torch.autograd.gradcheck(function, inputs)


def test_results_and_gradients_repeat_bit_for_bit() -> None:
    generator = torch.Generator().manual_seed(2)
    places = torch.nonzero(torch.rand(1, 20, 40, 40, generator=generator) < 0.1)
    convolution = SubmanifoldConvolution(16, 16, (3, 3, 3))
    results = []
    for _ in range(3):
        sites, order = Sites.of(places, (20, 40, 40), 1)
        generator.manual_seed(3)
        features = torch.randn(len(order), 16, generator=generator).requires_grad_()
        convolution.zero_grad()
        output = convolution(SparseTensor(features, sites)).features
        output.square().sum().backward()
        results.append([output.detach(), features.grad, convolution.weight.grad.clone()])
    for one, other in zip(results[:1] * 2, results[1:], strict=True):
        assert all(map(torch.equal, one, other))


def test_the_order_of_the_sites_does_not_matter() -> None:
    """Sites are sorted; the returned order puts the features beside their cells."""
    places = torch.tensor([[0, 2, 1, 1], [0, 0, 0, 2], [1, 0, 0, 0], [0, 0, 0, 1]])
    sites, order = Sites.of(places, (3, 2, 3), 2)
    assert torch.equal(sites.places, places[order])
    assert torch.equal(sites.places[:, 0], torch.tensor([0, 0, 0, 1]))
    assert np.all(np.diff(sites.keys.numpy()) > 0)


def test_an_even_submanifold_kernel_is_rejected() -> None:
    sites, _ = Sites.of(torch.zeros(1, 4, dtype=torch.int64), (3, 3, 3), 1)
    with pytest.raises(ConfigError, match="use odd sizes"):
        submanifold_rulebook(sites, (2, 3, 3))
