"""PointPillar, SECOND and Voxel R-CNN: the first stage, and the second one's place.

Modules and parameters have the names of OpenPCDet, so that its checkpoints load as they are.

Sources: Lang et al., "PointPillars", CVPR 2019; Yan, Mao and Li, "SECOND", Sensors 18(10), 2018;
Deng et al., "Voxel R-CNN", AAAI 2021.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from curate.detectors.openpcdet.anchors import CODE, decode, make_anchors, wrap
from curate.detectors.openpcdet.normalisation import RowNorm
from curate.detectors.openpcdet.roi_head import RoIHead
from curate.detectors.openpcdet.schema import AnchorHead as AnchorHeadConfig
from curate.detectors.openpcdet.schema import (
    BaseBEVBackbone,
    Data,
    ModelFile,
    PillarVFE,
    VoxelBackBone8x,
)
from curate.detectors.openpcdet.sparse import (
    Sites,
    SparseTensor,
    StridedConvolution,
    SubmanifoldConvolution,
)
from curate.detectors.openpcdet.voxels import Voxels

# Columns of a point.
POINT = 4
# Initial probability of a class at an anchor.
_PRIOR = 0.01
_STRIDES = {"x_conv1": 1, "x_conv2": 2, "x_conv3": 4, "x_conv4": 8}


@dataclass(frozen=True)
class Batch:
    """The voxels of b frames as tensors; see `Voxels`.

    Attributes:
        points: (n, points per voxel, 4).
        places: (n, 4) int64 frame, z, y, x.
        counts: (n,) int64.
        frames: b.
    """

    points: Tensor
    places: Tensor
    counts: Tensor
    frames: int

    @classmethod
    def of(cls, voxels: Voxels, device: str | torch.device = "cpu") -> "Batch":
        """Return voxels as tensors on a device."""
        points, places, counts = (
            torch.from_numpy(each).to(device)
            for each in (voxels.points, voxels.places, voxels.counts)
        )
        return cls(points, places, counts, len(voxels.left_out))


@dataclass(frozen=True)
class FirstStage:
    """Output of the first stage for the a anchors of b frames.

    Attributes:
        class_logits: (b, a, classes).
        codes: (b, a, 7) box codes, see `anchors`.
        direction_logits: (b, a, bins); None without a direction classifier.
        levels: the levels of the sparse backbone by OpenPCDet's names; empty for pillars.
        maps: the maps before and after the 2D backbone, (b, channels, y, x).
    """

    class_logits: Tensor
    codes: Tensor
    direction_logits: Tensor | None
    levels: Mapping[str, SparseTensor]
    maps: tuple[Tensor, Tensor]


class PillarFeatures(nn.Module):
    """Features of pillars: the maximum of a small network over a pillar's points."""

    def __init__(self, config: PillarVFE, data: Data) -> None:
        super().__init__()
        self.config = config
        low, size = data.point_cloud_range, data.voxels.voxel_size
        self.first_centre = [low[axis] + size[axis] / 2 for axis in range(3)]
        self.size = size
        columns = (POINT if config.use_abslote_xyz else POINT - 3) + 6 + config.with_distance
        widths = [columns, *config.num_filters]
        last = len(widths) - 2
        self.pfn_layers = nn.ModuleList(
            _PointLayer(widths[i], widths[i + 1], last=i == last) for i in range(last + 1)
        )

    def forward(self, batch: Batch) -> Tensor:
        """Return (n, channels) features."""
        points, counts = batch.points, batch.counts
        xyz = points[..., :3]
        # Slots behind the last point hold zeros, so they do not change the sum.
        mean = xyz.sum(dim=1, keepdim=True) / counts.clamp(min=1).view(-1, 1, 1)
        cells = batch.places[:, [3, 2, 1]].to(points.dtype)
        centre = cells * points.new_tensor(self.size) + points.new_tensor(self.first_centre)
        own = points if self.config.use_abslote_xyz else points[..., 3:]
        columns = [own, xyz - mean, xyz - centre[:, None]]
        if self.config.with_distance:
            columns.append(torch.linalg.vector_norm(xyz, dim=-1, keepdim=True))
        slots = torch.arange(points.shape[1], device=points.device)
        features = torch.cat(columns, dim=-1) * (slots < counts[:, None])[..., None]
        for layer in self.pfn_layers:
            features = layer(features)
        return features[:, 0]


class _PointLayer(nn.Module):
    """A linear layer on all slots of a pillar and their maximum, also over the empty slots."""

    def __init__(self, channels_in: int, channels_out: int, *, last: bool) -> None:
        super().__init__()
        self.last = last
        width = channels_out if last else channels_out // 2
        self.linear = nn.Linear(channels_in, width, bias=False)
        self.norm = RowNorm(width, eps=1e-3, momentum=0.01)

    def forward(self, slots: Tensor) -> Tensor:
        """Return (n, 1, channels) maxima, or (n, slots, channels) with the maximum appended."""
        rows = self.norm(self.linear(slots).flatten(0, 1))
        values = functional.relu(rows).view(*slots.shape[:2], rows.shape[1])
        highest = values.amax(dim=1, keepdim=True)
        return highest if self.last else torch.cat([values, highest.expand_as(values)], dim=-1)


class SparseBackbone(nn.Module):
    """The sparse 3D backbone: four levels, each of half the resolution, and a flat output."""

    def __init__(self, config: VoxelBackBone8x) -> None:
        super().__init__()
        first, one, two, three, four, last = config.channels
        self.channels = {"x_conv1": one, "x_conv2": two, "x_conv3": three, "x_conv4": four}
        self.conv_input = _subm(POINT, first)
        self.conv1 = nn.Sequential(_subm(first, one))
        self.conv2 = nn.Sequential(_down(one, two, (1, 1, 1)), _subm(two, two), _subm(two, two))
        self.conv3 = nn.Sequential(
            _down(two, three, (1, 1, 1)), _subm(three, three), _subm(three, three)
        )
        self.conv4 = nn.Sequential(
            _down(three, four, (0, 1, 1)), _subm(four, four), _subm(four, four)
        )
        self.conv_out = SparseBlock(
            StridedConvolution(four, last, (3, 1, 1), (2, 1, 1), (0, 0, 0)), last
        )

    def forward(self, tensor: SparseTensor) -> dict[str, SparseTensor]:
        """Return the levels and the output by OpenPCDet's names."""
        levels = {"x_conv1": self.conv1(self.conv_input(tensor))}
        for number, level in enumerate((self.conv2, self.conv3, self.conv4), 2):
            levels[f"x_conv{number}"] = level(levels[f"x_conv{number - 1}"])
        return {**levels, "encoded": self.conv_out(levels["x_conv4"])}


class SparseBlock(nn.Sequential):
    """A sparse convolution, batch norm and ReLU."""

    def __init__(self, convolution: nn.Module, channels: int) -> None:
        super().__init__(convolution, RowNorm(channels, eps=1e-3, momentum=0.01))

    def forward(self, tensor: SparseTensor) -> SparseTensor:
        """Return the convolved, normalised and rectified tensor."""
        convolved = self[0](tensor)
        return SparseTensor(functional.relu(self[1](convolved.features)), convolved.sites)


def _subm(channels_in: int, channels_out: int) -> SparseBlock:
    return SparseBlock(SubmanifoldConvolution(channels_in, channels_out, (3, 3, 3)), channels_out)


def _down(channels_in: int, channels_out: int, padding: tuple[int, int, int]) -> SparseBlock:
    convolution = StridedConvolution(channels_in, channels_out, (3, 3, 3), (2, 2, 2), padding)
    return SparseBlock(convolution, channels_out)


class BEVBackbone(nn.Module):
    """The 2D backbone: levels of lower and lower resolution, upsampled and joined."""

    def __init__(self, config: BaseBEVBackbone, channels: int) -> None:
        super().__init__()
        widths = [channels, *config.num_filters]
        self.blocks = nn.ModuleList()
        self.deblocks = nn.ModuleList()
        for i, layers in enumerate(config.layer_nums):
            before, width = widths[i], widths[i + 1]
            block: list[nn.Module] = [
                nn.ZeroPad2d(1),
                nn.Conv2d(before, width, 3, stride=config.layer_strides[i], bias=False),
                *_norm_2d(width),
            ]
            for _ in range(layers):
                block += [nn.Conv2d(width, width, 3, padding=1, bias=False), *_norm_2d(width)]
            self.blocks.append(nn.Sequential(*block))
            out, stride = config.num_upsample_filters[i], config.upsample_strides[i]
            upsampled = nn.ConvTranspose2d(width, out, stride, stride=stride, bias=False)
            self.deblocks.append(nn.Sequential(upsampled, *_norm_2d(out)))
        self.channels = sum(config.num_upsample_filters)

    def forward(self, maps: Tensor) -> Tensor:
        """Return the (b, channels, y, x) joined maps."""
        parts = []
        for block, deblock in zip(self.blocks, self.deblocks, strict=True):
            maps = block(maps)
            parts.append(deblock(maps))
        return torch.cat(parts, dim=1)


def _norm_2d(channels: int) -> list[nn.Module]:
    return [nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01), nn.ReLU(inplace=True)]


class AnchorHead(nn.Module):
    """Class scores, box codes and directions of the anchors at each cell of the map."""

    def __init__(self, config: AnchorHeadConfig, channels: int, classes: int) -> None:
        super().__init__()
        self.config = config
        self.classes = classes
        anchors = config.anchors_per_cell
        self.conv_cls = nn.Conv2d(channels, anchors * classes, 1)
        self.conv_box = nn.Conv2d(channels, anchors * CODE, 1)
        if config.has_directions:
            self.conv_dir_cls = nn.Conv2d(channels, anchors * config.num_dir_bins, 1)
        nn.init.constant_(_bias(self.conv_cls), math.log(_PRIOR / (1 - _PRIOR)))
        nn.init.normal_(self.conv_box.weight, std=0.001)

    def forward(self, maps: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return class logits, box codes and direction logits, (b, anchors, ...)."""

        def by_anchor(convolution: nn.Module, numbers: int) -> Tensor:
            return torch.permute(convolution(maps), (0, 2, 3, 1)).reshape(len(maps), -1, numbers)

        directions = None
        if self.config.has_directions:
            directions = by_anchor(self.conv_dir_cls, self.config.num_dir_bins)
        return by_anchor(self.conv_cls, self.classes), by_anchor(self.conv_box, CODE), directions


def _bias(layer: nn.Conv2d) -> Tensor:
    assert layer.bias is not None  # noqa: S101 - the layer is made with one
    return layer.bias


class DetectionNetwork(nn.Module):
    """The network of a model file.

    Attributes:
        file: the model file.
        anchors: (a, 7) anchors, in the order of the outputs.
    """

    anchors: Tensor

    def __init__(self, file: ModelFile) -> None:
        super().__init__()
        self.file = file
        model = file.model
        if isinstance(model.vfe, PillarVFE):
            self.vfe = PillarFeatures(model.vfe, file.data_config)
        if model.backbone_3d is not None:
            self.backbone_3d = SparseBackbone(model.backbone_3d)
        self.backbone_2d = BEVBackbone(model.backbone_2d, file.bev_channels)
        self.dense_head = AnchorHead(
            model.dense_head, self.backbone_2d.channels, len(file.class_names)
        )
        self.register_buffer("anchors", torch.from_numpy(make_anchors(file)), persistent=False)
        if model.roi_head is not None:
            self.roi_head = RoIHead(
                model.roi_head, file.data_config, self.backbone_3d.channels, _STRIDES
            )

    def forward(self, batch: Batch) -> FirstStage:
        """Return the output of the first stage."""
        levels: dict[str, SparseTensor] = {}
        if self.file.model.backbone_3d is None:
            maps = self._scattered(self.vfe(batch), batch)
        else:
            levels = self.backbone_3d(self.voxel_means(batch))
            maps = levels["encoded"].dense().flatten(1, 2)
        joined = self.backbone_2d(maps)
        logits, codes, directions = self.dense_head(joined)
        return FirstStage(logits, codes, directions, levels, (maps, joined))

    def voxel_means(self, batch: Batch) -> SparseTensor:
        """Return the mean of the points of each voxel."""
        across_x, across_y, height = self.file.data_config.grid
        # OpenPCDet adds a layer of free voxels on top.
        shape = (height + 1, across_y, across_x)
        sites, order = Sites.of(batch.places, shape, batch.frames)
        means = batch.points.sum(dim=1) / batch.counts.clamp(min=1)[:, None]
        return SparseTensor(means[order], sites)

    def _scattered(self, features: Tensor, batch: Batch) -> Tensor:
        """Return the (b, channels, y, x) map with the pillars' features, 0 elsewhere."""
        across_x, across_y, _ = self.file.data_config.grid
        frame, _, y, x = batch.places.unbind(dim=1)
        flat = features.new_zeros(batch.frames * across_y * across_x, features.shape[1])
        flat = flat.index_copy(0, (frame * across_y + y) * across_x + x, features)
        return flat.view(batch.frames, across_y, across_x, -1).permute(0, 3, 1, 2).contiguous()

    def boxes_of(self, stage: FirstStage, frame: int, index: Tensor) -> Tensor:
        """Return the (k, 7) boxes of some anchors of a frame, with their directions."""
        boxes = decode(stage.codes[frame, index], self.anchors[index])
        if stage.direction_logits is None:
            return boxes
        head = self.file.model.dense_head
        bins = stage.direction_logits[frame, index].argmax(dim=-1)
        period = 2 * math.pi / head.num_dir_bins
        yaw = wrap(boxes[:, 6] - head.dir_offset, head.dir_limit_offset, period)
        boxes[:, 6] = yaw + head.dir_offset + period * bins
        return boxes
