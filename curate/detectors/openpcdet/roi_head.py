"""The second stage of Voxel R-CNN: it scores proposals and refines their boxes.

Source: Deng et al., "Voxel R-CNN: Towards High Performance Voxel-based 3D Object Detection",
AAAI 2021.

For each point g of a grid inside a proposal and the voxels j near it, with features f and centres
c, a level gives

    max over j of  relu(f_j + P(c_j - g))

with an affine P. Since relu is monotone and P affine this is relu(max_j (f_j + A c_j) - A g + b),
with P(d) = A d + b: one row per voxel instead of one per pair. In training, P contains a batch norm
over all pairs; the mean and covariance of the differences d give its statistics exactly.
"""

from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from curate.detectors.openpcdet.anchors import CODE, decode, turned
from curate.detectors.openpcdet.normalisation import RowNorm
from curate.detectors.openpcdet.pooling import NearMaximum, near_voxels
from curate.detectors.openpcdet.schema import Data, PoolLayer, VoxelRCNNHead
from curate.detectors.openpcdet.sparse import SparseTensor
from curate.detectors.whole_batch import whole_batch_sum


class RoIHead(nn.Module):
    """Scores and box codes of proposals from the voxels inside them.

    Args:
        config: the section of the model file.
        data: range and grid.
        channels: channels of the sparse backbone's levels by name.
        strides: voxels per cell of the levels by name.
    """

    def __init__(
        self,
        config: VoxelRCNNHead,
        data: Data,
        channels: Mapping[str, int],
        strides: Mapping[str, int],
    ) -> None:
        super().__init__()
        self.config = config
        self.data = data
        self.strides = strides
        pool = config.roi_grid_pool
        layers = [pool.pool_layers[name] for name in pool.features_source]
        self.roi_grid_pool_layers = nn.ModuleList(
            PooledLevel(channels[name], layer)
            for name, layer in zip(pool.features_source, layers, strict=True)
        )
        width = pool.grid_size**3 * sum(layer.mlps[0][-1] for layer in layers)
        self.shared_fc_layer = _fully_connected(width, config.shared_fc, config.dp_ratio)
        shared = config.shared_fc[-1]
        self.cls_fc_layers = _fully_connected(shared, config.cls_fc, config.dp_ratio)
        self.cls_pred_layer = nn.Linear(config.cls_fc[-1], 1)
        self.reg_fc_layers = _fully_connected(shared, config.reg_fc, config.dp_ratio)
        self.reg_pred_layer = nn.Linear(config.reg_fc[-1], CODE)
        for layer, std in ((self.cls_pred_layer, 0.01), (self.reg_pred_layer, 0.001)):
            nn.init.normal_(layer.weight, std=std)
            nn.init.zeros_(layer.bias)

    def forward(
        self, rois: Tensor, frames: Tensor, levels: Mapping[str, SparseTensor]
    ) -> tuple[Tensor, Tensor]:
        """Return (r,) score logits and (r, 7) box codes of proposals.

        Args:
            rois: (r, 7) proposals, boxes in the LiDAR frame.
            frames: (r,) int64 frame of each.
            levels: the levels of the sparse backbone by name.
        """
        shared = self.shared_fc_layer(self.pooled(rois, frames, levels).flatten(1))
        logits = self.cls_pred_layer(self.cls_fc_layers(shared))[:, 0]
        return logits, self.reg_pred_layer(self.reg_fc_layers(shared))

    def pooled(self, rois: Tensor, frames: Tensor, levels: Mapping[str, SparseTensor]) -> Tensor:
        """Return the (r, grid points, channels) pooled features of proposals."""
        pool = self.config.roi_grid_pool
        points = grid_points(rois, pool.grid_size)
        low = rois.new_tensor(self.data.point_cloud_range[:3])
        size = rois.new_tensor(self.data.voxels.voxel_size)
        # In float32, and not by multiplication with the inverse: the cell of a point on a
        # boundary depends on it.
        voxels = torch.floor_divide(points.flatten(0, 1) - low, size)
        of_frame = frames.repeat_interleave(points.shape[1])[:, None]
        parts = []
        for name, layer in zip(pool.features_source, self.roi_grid_pool_layers, strict=True):
            stride = self.strides[name]
            cells = torch.floor_divide(voxels, stride).long().flip(-1)
            cells = torch.cat([of_frame, cells], dim=1)
            sites = levels[name].sites
            centres = (sites.places[:, [3, 2, 1]].to(size) + 0.5) * (size * stride) + low
            parts.append(layer(levels[name], centres, cells, points.flatten(0, 1)))
        pooled = torch.cat(parts, dim=1)
        return pooled.view(*points.shape[:2], pooled.shape[1])  # there may be no proposals


class PooledLevel(nn.Module):
    """The pooling of one level of the sparse backbone."""

    def __init__(self, channels: int, config: PoolLayer) -> None:
        super().__init__()
        self.config = config
        middle, last = config.mlps[0]
        self.mlps_in = nn.ModuleList([_PointwiseNorm(channels, middle, 1)])
        self.mlps_pos = nn.ModuleList([_PointwiseNorm(3, middle, 2)])
        self.mlps_out = nn.ModuleList([_PointwiseNorm(middle, last, 1)])

    def forward(
        self, level: SparseTensor, centres: Tensor, cells: Tensor, points: Tensor
    ) -> Tensor:
        """Return (m, channels) features of points.

        Args:
            level: the n voxels.
            centres: (n, 3) x, y, z of their centres, metres.
            cells: (m, 4) int64 frame and cell z, y, x of the points.
            points: (m, 3) x, y, z, metres.
        """
        # In half precision a coordinate of 50 m is rounded to 3 cm, and a variance may be negative.
        with torch.autocast(points.device.type, enabled=False):
            return self._pool(level, centres, cells, points)

    def _pool(self, level: SparseTensor, centres: Tensor, cells: Tensor, points: Tensor) -> Tensor:
        (reach,), (radius,) = self.config.query_ranges, self.config.pool_radius
        most = self.config.nsample[0]
        near = near_voxels(level.sites, centres, cells, points, reach, radius, most)
        empty = near[:, :1] < 0
        matrix, shift = self._position(centres, near, points)
        # Coordinates from the middle of the scene keep the products small.
        middle = centres.mean(dim=0) if len(centres) else points.new_zeros(3)
        rows = self.mlps_in[0](level.features.to(points)) + (centres - middle) @ matrix.t()
        highest = NearMaximum.apply(rows, near)  # type: ignore[no-untyped-call]
        position = torch.where(empty, 0.0, (points - middle) @ matrix.t())
        pooled = functional.relu(highest - position + shift)
        return functional.relu(self.mlps_out[0](pooled))

    def _position(self, centres: Tensor, near: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the matrix A (channels, 3) and the shift b (channels,) of P(d) = A d + b."""
        mlp = self.mlps_pos[0]
        assert isinstance(mlp, _PointwiseNorm)  # noqa: S101 - the list is made of them
        weight, norm = mlp.parts()
        if not self.training:
            scale, shift = norm.affine_map()
            return scale[:, None] * weight, shift
        mean, covariance, count = _statistics(centres, near, points)
        mean, covariance = mean.to(weight), covariance.to(weight)
        variance = ((weight @ covariance) * weight).sum(dim=1)
        norm.update(weight @ mean, variance, count)
        matrix = (norm.weight * torch.rsqrt(variance + norm.eps))[:, None] * weight
        return matrix, norm.bias - matrix @ mean


def _statistics(centres: Tensor, near: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean, covariance and number of the differences c_j - g of the whole batch.

    A point without a voxel near it counts with differences of 0. In double precision: sums over a
    million pairs are wrong by 1e-4 in float32.
    """
    away = points.new_zeros((*near.shape, 3))
    if len(centres):
        away = centres[near.clamp(min=0)] - points[:, None]
    away = torch.where(near[..., None] < 0, 0.0, away).flatten(0, 1).double()
    own = torch.cat([away.new_full((1,), len(away)), away.sum(dim=0), (away.t() @ away).flatten()])
    joined = whole_batch_sum(own)
    count = joined[0]
    mean, squares = joined[1:4] / count.clamp(min=1), joined[4:].view(3, 3) / count.clamp(min=1)
    return mean, squares - mean[:, None] * mean, count


class _Pointwise(nn.Module):
    """A linear layer with a weight in the shape of a 1 x 1 convolution."""

    def __init__(self, channels_in: int, channels_out: int, axes: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(channels_out, channels_in, *([1] * axes)))
        nn.init.kaiming_normal_(self.weight)

    def forward(self, rows: Tensor) -> Tensor:
        """Map (n, channels in) to (n, channels out)."""
        return functional.linear(rows, self.weight.flatten(1))


class _PointwiseNorm(nn.Sequential):
    """A pointwise layer and batch norm."""

    def __init__(self, channels_in: int, channels_out: int, axes: int) -> None:
        super().__init__(_Pointwise(channels_in, channels_out, axes), RowNorm(channels_out))

    def parts(self) -> tuple[Tensor, RowNorm]:
        """Return the (channels out, channels in) weight and the norm."""
        linear, norm = self
        return cast("_Pointwise", linear).weight.flatten(1), cast("RowNorm", norm)


def _fully_connected(width: int, widths: tuple[int, ...], dropout: float) -> nn.Sequential:
    """Return linear layers with batch norm and ReLU; dropout between them."""
    layers: list[nn.Module] = []
    for number, out in enumerate(widths):
        linear = nn.Linear(width, out, bias=False)
        nn.init.xavier_normal_(linear.weight)
        layers += [linear, RowNorm(out), nn.ReLU()]
        if number < len(widths) - 1 and dropout > 0:
            layers.append(nn.Dropout(dropout))
        width = out
    return nn.Sequential(*layers)


def grid_points(rois: Tensor, size: int) -> Tensor:
    """Return the (r, size^3, 3) points of a regular grid inside (r, 7) boxes, by x, y, z."""
    steps = torch.arange(size, device=rois.device)
    index = torch.cartesian_prod(steps, steps, steps).to(rois.dtype)
    sizes = rois[:, None, 3:6]
    local = (index + 0.5) / size * sizes - sizes / 2
    return turned(local, rois[:, 6]) + rois[:, None, :3]


def refine(codes: Tensor, rois: Tensor) -> Tensor:
    """Return the (r, 7) boxes of codes relative to proposals, in the LiDAR frame.

    A code is in the proposal's own frame: origin at its centre, x along its heading. Its yaw is
    added to that of the proposal.
    """
    local = torch.cat([torch.zeros_like(rois[:, :3]), rois[:, 3:]], dim=1)
    boxes = decode(codes, local)
    centres = turned(boxes[:, None, :3], rois[:, 6])[:, 0] + rois[:, :3]
    return torch.cat([centres, boxes[:, 3:]], dim=1)
