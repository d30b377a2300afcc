"""Pooling of voxel features at points: the voxels near a point, and the maximum over them.

Source: Deng et al., "Voxel R-CNN", AAAI 2021 (voxel query and accelerated PointNet).
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from curate.detectors.openpcdet.sparse import Sites

# Grid points that are searched at once on a GPU; more would need more of its memory.
_CHUNK = 4096


def near_voxels(
    sites: Sites,
    centres: Tensor,
    cells: Tensor,
    points: Tensor,
    reach: tuple[int, int, int],
    radius: float,
    most: int,
    *,
    compiled: bool | None = None,
) -> Tensor:
    """Return (m, most) rows of the first voxels near each point, by z, y, x; -1 if there is none.

    The first voxel fills the places that are left.

    Args:
        sites: the n voxels.
        centres: (n, 3) x, y, z of their centres, metres.
        cells: (m, 4) int64 frame and cell z, y, x of the points.
        points: (m, 3) x, y, z, metres.
        reach: how many cells away along z, y, x a voxel may be.
        radius: how far away its centre may be, metres.
        most: number of voxels.
        compiled: whether to use the compiled kernel; by default for sites on the CPU.
    """
    if centres.device.type == "cpu" if compiled is None else compiled:
        from curate.detectors.openpcdet import kernels

        found = kernels.near_voxels(
            sites.places.numpy(),
            centres.numpy(),
            np.array([sites.frames, *sites.shape[:2]], dtype=np.int64),
            cells.numpy(),
            points.numpy(),
            np.array(reach, dtype=np.int64),
            float(radius),
            most,
        )
        return torch.from_numpy(found)
    parts = [
        _near_voxels(sites, centres, *each, reach, radius, most)
        for each in zip(torch.split(cells, _CHUNK), torch.split(points, _CHUNK), strict=True)
    ]
    return torch.cat(parts) if parts else cells.new_zeros((0, most))


def _near_voxels(
    sites: Sites,
    centres: Tensor,
    cells: Tensor,
    points: Tensor,
    reach: tuple[int, int, int],
    radius: float,
    most: int,
) -> Tensor:
    """Return what `near_voxels` returns, by a search for the key of every cell within reach."""
    device = cells.device
    ranges = [torch.arange(-each, each + 1, device=device) for each in reach]
    steps = torch.cartesian_prod(*ranges)
    near = cells[:, None, 1:] + steps
    inside = ((near >= 0) & (near < torch.tensor(sites.shape, device=device))).all(dim=-1)
    pitches = torch.tensor(sites.pitches, device=device)
    keys = cells[:, :1] * pitches[0] + (near * pitches[1:]).sum(dim=-1)
    rows = torch.searchsorted(sites.keys, keys).clamp(max=max(len(sites) - 1, 0))
    if len(sites) == 0:
        return cells.new_full((len(cells), most), -1)
    away = (centres[rows] - points[:, None]).square().sum(dim=-1)
    found = inside & (sites.keys[rows] == keys) & (away <= radius * radius)
    place = found.cumsum(dim=1) - 1
    kept = found & (place < most)
    result = rows.new_full((len(cells), most), -1)
    point, step = torch.nonzero(kept, as_tuple=True)
    result[point, place[point, step]] = rows[point, step]
    return torch.where(result < 0, result[:, :1], result)


class NearMaximum(torch.autograd.Function):
    """The maximum of feature rows over the voxels near each point, 0 if there is none."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, near: Tensor) -> Tensor:
        """Return (m, channels) maxima of (n, channels) rows over (m, most) rows."""
        empty = near[:, 0] < 0
        highest = features.new_zeros((len(near), features.shape[1]))
        source = near.new_zeros((len(near), features.shape[1]))
        filled = torch.nonzero(~empty)[:, 0]
        if len(filled):
            rows = near[filled]
            best = features[rows[:, 0]]
            which = rows[:, :1].expand_as(best).clone()
            for column in range(1, rows.shape[1]):
                values = features[rows[:, column]]
                better = values > best
                which = torch.where(better, rows[:, column : column + 1], which)
                best = torch.where(better, values, best)
            highest[filled], source[filled] = best, which
        ctx.save_for_backward(source, empty)
        ctx.count = len(features)
        return highest

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """Return the gradient of the rows: that of each maximum for the row that it is from."""
        source, empty = ctx.saved_tensors
        channels = gradient.shape[1]
        gradient = torch.where(empty[:, None], 0.0, gradient)
        index = source * channels + torch.arange(channels, device=source.device)
        flat = gradient.new_zeros(ctx.count * channels)
        if ctx.count:
            flat.index_add_(0, index.flatten(), gradient.flatten())
        return flat.view(-1, channels), None
