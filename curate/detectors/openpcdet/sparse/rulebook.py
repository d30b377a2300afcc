"""Rulebooks: which input cell meets which cell of the kernel to contribute to which output cell.

Source: Graham, Engelcke and van der Maaten, "3D Semantic Segmentation with Submanifold Sparse
Convolutional Networks", CVPR 2018. Convolution means cross-correlation, as in torch:

    output[o] = sum over the kernel's cells k of  weight[k] . input[o * stride - padding + k]

Example along one axis, a kernel of 3 cells, stride 2, padding 1, inputs at 4 and 7:

    k = 0    4 would be the input of output (4 + 1 - 0) / 2 = 2.5: none;   7 of output 4
    k = 1    4 of output 2;                                                7 of 3.5: none
    k = 2    4 of 1.5: none;                                               7 of output 3
    the output has the cells 2, 3 and 4

On the CPU the pairs are found by compiled kernels, elsewhere by torch; the result is the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
import torch
from torch import Tensor

from curate.detectors.openpcdet.sparse.sites import HALO, Sites, Triple, key_pitches
from curate.errors import ConfigError


@dataclass(frozen=True, eq=False)
class Rulebook:
    """The pairs of input and output cells for each cell of a kernel.

    Attributes:
        inputs: (p,) int64 rows of the inputs, in the order of the kernel's cells z, y, x.
        outputs: (p,) int64 rows of the outputs; ascending within each cell of the kernel.
        starts: where the pairs of each of the k cells start, and p.
        centre: cell of the kernel that pairs each row with itself, None if there is none.
        before: the input cells.
        after: the output cells.
    """

    inputs: Tensor
    outputs: Tensor
    starts: tuple[int, ...]
    centre: int | None
    before: Sites
    after: Sites

    def inverse(self) -> "Rulebook":
        """Return the rulebook of the convolution from the outputs back to the inputs."""
        return Rulebook(
            self.outputs, self.inputs, self.starts, self.centre, self.after, self.before
        )


def submanifold_rulebook(sites: Sites, kernel: Triple, *, compiled: bool | None = None) -> Rulebook:
    """Return the rulebook of a convolution with its input cells as its output cells.

    Args:
        sites: the cells.
        kernel: odd numbers of cells along z, y, x.
        compiled: whether to use the compiled kernels; by default for sites on the CPU.
    """
    known = sites.rulebooks.get(kernel)
    if isinstance(known, Rulebook):
        return known
    if any(size % 2 == 0 or size > 2 * HALO + 1 for size in kernel):
        raise ConfigError(f"submanifold kernel {kernel}: use odd sizes up to {2 * HALO + 1}")
    steps = product(*(range(-(size // 2), size // 2 + 1) for size in kernel))
    _, *pitches = sites.pitches
    distances = [sum(step * pitch for step, pitch in zip(each, pitches, strict=True))
                 for each in steps]  # fmt: skip
    # The pairs at the distance -d are those at the distance d, turned round.
    positive = distances[len(distances) // 2 + 1 :]
    if _compiled(sites, compiled):
        from curate.detectors.openpcdet.sparse.kernels import pairs_at_distances

        found = pairs_at_distances(sites.keys.numpy(), np.array(positive, dtype=np.int64))
        low, high = torch.from_numpy(found[0]), torch.from_numpy(found[1])
        starts = found[2].tolist()
    else:
        parts = [_pairs_at_distance(sites.keys, distance) for distance in positive]
        low, high, starts = _joined(parts, sites.keys)
    chunks = list(pairwise(starts))
    below = [(high[a:b], low[a:b]) for a, b in reversed(chunks)]
    own = torch.arange(len(sites), device=sites.keys.device)
    above = [(low[a:b], high[a:b]) for a, b in chunks]
    # Cell k of the kernel meets the input at the output's key + distances[k].
    outputs, inputs, ends = _joined([*below, (own, own), *above], sites.keys)
    rulebook = Rulebook(inputs, outputs, tuple(ends), len(below), sites, sites)
    sites.rulebooks[kernel] = rulebook
    return rulebook


def strided_rulebook(
    sites: Sites,
    kernel: Triple,
    stride: Triple,
    padding: Triple,
    *,
    compiled: bool | None = None,
) -> Rulebook:
    """Return the rulebook of a convolution that has every output with at least one input.

    Args:
        sites: the input cells.
        kernel: cells along z, y, x.
        stride: steps along z, y, x.
        padding: free cells before and behind the grid along z, y, x.
        compiled: see `submanifold_rulebook`.
    """
    known = sites.rulebooks.get((kernel, stride, padding))
    if isinstance(known, Rulebook):
        return known
    sizes = [
        (size + 2 * pad - cells) // step + 1
        for size, cells, step, pad in zip(sites.shape, kernel, stride, padding, strict=True)
    ]
    if min(sizes) < 1:
        raise ConfigError(f"a grid of {sites.shape} cells is too small for a kernel of {kernel}")
    shape = (sizes[0], sizes[1], sizes[2])
    pitches = key_pitches(shape)
    if _compiled(sites, compiled):
        from curate.detectors.openpcdet.sparse.kernels import strided_pairs

        found = strided_pairs(
            sites.places.numpy(), np.array([kernel, stride, padding, shape]), np.array(pitches)
        )
        inputs, keys = torch.from_numpy(found[0]), torch.from_numpy(found[1])
        starts = found[2].tolist()
    else:
        parts = [
            _pairs_of_cell(sites, cell, stride, padding, shape)
            for cell in product(*map(range, kernel))
        ]
        inputs, keys, starts = _joined(parts, sites.keys)
    occupied, outputs = torch.unique(keys, return_inverse=True)
    after = Sites(occupied, shape, sites.frames)
    rulebook = Rulebook(inputs, outputs, tuple(starts), None, sites, after)
    sites.rulebooks[kernel, stride, padding] = rulebook
    return rulebook


def _compiled(sites: Sites, wish: bool | None) -> bool:
    return sites.keys.device.type == "cpu" if wish is None else wish


def _pairs_at_distance(keys: Tensor, distance: int) -> tuple[Tensor, Tensor]:
    """Return the rows of the lower and of the higher keys that are this far apart."""
    if len(keys) == 0:
        return keys, keys
    wanted = keys + distance
    place = torch.searchsorted(keys, wanted).clamp(max=len(keys) - 1)
    low = torch.nonzero(keys[place] == wanted)[:, 0]
    return low, place[low]


def _pairs_of_cell(
    sites: Sites, cell: Sequence[int], stride: Triple, padding: Triple, shape: Triple
) -> tuple[Tensor, Tensor]:
    """Return the rows of the inputs that meet a cell of the kernel, and the keys of the outputs."""
    device = sites.keys.device
    step, low, high = (torch.tensor(each, device=device) for each in (stride, cell, shape))
    shifted = sites.places[:, 1:] + torch.tensor(padding, device=device) - low
    place = torch.div(shifted, step, rounding_mode="floor")
    fits = (shifted == place * step) & (place >= 0) & (place < high)
    rows = torch.nonzero(fits.all(dim=1))[:, 0]
    full = torch.cat([sites.places[rows, :1], place[rows]], dim=1)
    return rows, (full * torch.tensor(key_pitches(shape), device=device)).sum(dim=1)


def _joined(
    parts: Sequence[tuple[Tensor, Tensor]], like: Tensor
) -> tuple[Tensor, Tensor, list[int]]:
    """Return the joined first and second members, and where each part starts."""
    if not parts:
        empty = like.new_zeros(0)
        return empty, empty, [0]
    starts = np.cumsum([0, *(len(first) for first, _ in parts)]).tolist()
    first, second = (torch.cat(each) for each in zip(*parts, strict=True))
    return first, second, starts
