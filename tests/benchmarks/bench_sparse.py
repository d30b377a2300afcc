"""Sparse 3D convolution, and the detectors made of it, against spconv and dense convolution."""

import numpy as np
import pytest
import torch
from benchmarks.measuring import OURS, cpu_seconds, measure
from torch import nn

from curate.datasets.kitti.dataset import KittiDataset
from curate.detections import CATEGORIES
from curate.detectors.base import Sample
from curate.detectors.openpcdet.detector import OpenPCDetDetector
from curate.detectors.openpcdet.inference import detect
from curate.detectors.openpcdet.network import Batch, DetectionNetwork, SparseBlock
from curate.detectors.openpcdet.pooling import near_voxels
from curate.detectors.openpcdet.presets import preset_file
from curate.detectors.openpcdet.sparse import (
    Sites,
    SparseTensor,
    StridedConvolution,
    SubmanifoldConvolution,
)
from curate.detectors.openpcdet.sparse.rulebook import strided_rulebook, submanifold_rulebook
from curate.detectors.openpcdet.voxels import make_voxels
from curate.geometry.projection import in_camera_view
from curate.simulation import simulate

pytestmark = [
    pytest.mark.benchmark(timer=cpu_seconds),
    pytest.mark.filterwarnings("ignore:.*is_fx_tracing.*"),
]

BACKBONE = "Sparse backbone of Voxel R-CNN at the paper's size, one simulated sweep, forward"
LAYER = "Submanifold convolution, 16 to 16 channels, on a part of a sweep"
PARTS = "Parts of Voxel R-CNN at the paper's size, one sweep"
WHOLE = "Voxel R-CNN, one frame for inference and two for a training step"
# Cells of the part of the grid on which dense convolution has room.
PART = (40, 200, 200)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Return two simulated frames as samples, with the points in the camera's view."""
    root = tmp_path_factory.mktemp("sparse")
    simulate(root, 2, 0, val_frames=0, workers=1)
    dataset = KittiDataset(root)
    found = []
    for name in dataset.frame_ids():
        frame = dataset.read(name)
        labels = dataset.annotations(name)
        kept = np.isin(labels.categories, CATEGORIES)
        found.append(
            Sample(
                name,
                True,
                frame.points[in_camera_view(frame)],
                labels.boxes[kept],
                labels.categories[kept],
                np.ones(int(kept.sum())),
            )
        )
    return found


@pytest.fixture(scope="module")
def network():
    """Return Voxel R-CNN at the paper's size with random weights."""
    torch.manual_seed(0)
    return DetectionNetwork(preset_file("voxel-rcnn", CATEGORIES)).eval()


@pytest.fixture(scope="module")
def voxels(network, frames):
    """Return the voxel means of the first frame."""
    made = make_voxels([frames[0].points], network.file.data_config)
    return network.voxel_means(Batch.of(made))


def fresh(tensor):
    """Return a sparse tensor without cached rulebooks."""
    sites = tensor.sites
    return SparseTensor(tensor.features, Sites(sites.keys, sites.shape, sites.frames))


class Peer(nn.Module):
    """The sparse backbone in spconv, with the weights of ours."""

    def __init__(self, backbone):
        super().__init__()
        self.spconv = pytest.importorskip("spconv.pytorch")
        self.blocks = [block for block in backbone.modules() if isinstance(block, SparseBlock)]
        self.layers = nn.ModuleList(map(self._layer, range(len(self.blocks))))

    def _layer(self, number):
        ours = self.blocks[number][0]
        channels_out, *kernel, channels_in = ours.weight.shape
        if isinstance(ours, SubmanifoldConvolution):
            # Layers with the same cells share a rulebook.
            down = sum(isinstance(each[0], StridedConvolution) for each in self.blocks[:number])
            layer = self.spconv.SubMConv3d(
                channels_in, channels_out, kernel, padding=1, bias=False, indice_key=f"level{down}"
            )
        else:
            layer = self.spconv.SparseConv3d(
                channels_in, channels_out, kernel, ours.stride, ours.padding, bias=False
            )
        layer.weight.data.copy_(ours.weight)
        return layer

    def forward(self, tensor):
        """Return the output of the last layer."""
        sites = tensor.sites
        found = self.spconv.SparseConvTensor(
            tensor.features, sites.places.int(), list(sites.shape), sites.frames
        )
        for layer, block in zip(self.layers, self.blocks, strict=True):
            found = layer(found)
            found = found.replace_feature(torch.relu(block[1](found.features)))
        return found


def bench_backbone(benchmark, network, voxels):
    """Find the rulebooks and convolve, 12 layers."""
    with torch.inference_mode():
        found = measure(
            benchmark,
            lambda: network.backbone_3d(fresh(voxels))["encoded"],
            group=BACKBONE,
            amount=len(voxels.sites),
            unit="voxels",
        )
    assert found.features.abs().max() > 0


def bench_backbone_in_spconv(benchmark, network, voxels):
    """Measure the same in spconv; its CPU code is only safe with one thread."""
    peer = Peer(network.backbone_3d).eval()
    with torch.inference_mode():
        found = measure(
            benchmark,
            lambda: peer(voxels),
            group=BACKBONE,
            name="spconv (CPU)",
            amount=len(voxels.sites),
            unit="voxels",
        )
        expected = network.backbone_3d(fresh(voxels))["encoded"]
    sites, order = Sites.of(found.indices.long(), expected.sites.shape, 1)
    torch.testing.assert_close(sites.keys, expected.sites.keys)
    torch.testing.assert_close(found.features[order], expected.features, rtol=1e-3, atol=1e-4)


@pytest.fixture(scope="module")
def part(voxels):
    """Return 16 features per voxel of a part of the sweep that is small enough for a dense grid."""
    places = voxels.sites.places - torch.tensor([0, 0, 500, 200])
    inside = ((places >= 0) & (places < torch.tensor([1, *PART]))).all(dim=1)
    sites, _ = Sites.of(places[inside], PART, 1)
    assert len(sites) > 1000
    return SparseTensor(torch.randn(len(sites), 16), sites)


@pytest.mark.parametrize("name", [OURS, "spconv (CPU)", "torch (dense)"])
def bench_layer(benchmark, part, name):
    """Convolve forward; the rulebook is not cached."""
    torch.manual_seed(0)
    ours = SubmanifoldConvolution(16, 16, (3, 3, 3))
    dense = nn.Conv3d(16, 16, 3, padding=1, bias=False)
    dense.weight.data.copy_(ours.weight.permute(0, 4, 1, 2, 3))
    grid = part.dense()
    if name == "spconv (CPU)":
        spconv = pytest.importorskip("spconv.pytorch")
        peer = spconv.SubMConv3d(16, 16, 3, padding=1, bias=False)
        peer.weight.data.copy_(ours.weight)
        places = part.sites.places.int()

    def work():
        if name == OURS:
            return ours(fresh(part)).features
        if name == "torch (dense)":
            return dense(grid)
        return peer(spconv.SparseConvTensor(part.features, places, list(PART), 1)).features

    with torch.inference_mode():
        found = measure(
            benchmark, work, group=LAYER, name=name, amount=len(part.sites), unit="voxels"
        )
        expected = ours(fresh(part)).features
    if name == "torch (dense)":
        _, z, y, x = part.sites.places.unbind(dim=1)
        found = found[0, :, z, y, x].t()
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)


def bench_rulebooks(benchmark, voxels):
    """Find the pairs of a submanifold and of a strided convolution."""
    sites = voxels.sites

    def rulebooks():
        own = Sites(sites.keys, sites.shape, sites.frames)
        submanifold_rulebook(own, (3, 3, 3))
        return strided_rulebook(own, (3, 3, 3), (2, 2, 2), (1, 1, 1))

    found = measure(
        benchmark, rulebooks, group=PARTS, name="two rulebooks", amount=len(sites), unit="voxels",
        figure="rate",
    )  # fmt: skip
    assert len(found.after) > 0


def bench_voxel_query(benchmark, network, voxels):
    """Find the voxels near the 216 grid points of 100 proposals, on the level of 0.1 m."""
    with torch.inference_mode():
        level = network.backbone_3d(voxels)["x_conv2"]
    generator = np.random.default_rng(0)
    chosen = generator.integers(0, len(level.sites), 21_600)
    cells = level.sites.places[chosen]
    low = torch.tensor(network.file.data_config.point_cloud_range[:3])
    size = torch.tensor([0.1, 0.1, 0.2])
    centres = (level.sites.places[:, [3, 2, 1]] + 0.5) * size + low
    near = measure(
        benchmark,
        lambda: near_voxels(level.sites, centres, cells, centres[chosen], (4, 4, 4), 0.4, 16),
        group=PARTS,
        name="voxel query",
        amount=len(chosen),
        unit="points",
        figure="rate",
    )
    assert (near[:, 0] >= 0).all()


def bench_second_stage(benchmark, network, frames, voxels):
    """Pool and refine 100 proposals."""
    with torch.inference_mode():
        levels = network.backbone_3d(voxels)
        boxes = torch.from_numpy(frames[0].boxes[np.arange(100) % len(frames[0].boxes)]).float()
        zeros = torch.zeros(100, dtype=torch.int64)
        logits, _ = measure(
            benchmark,
            lambda: network.roi_head(boxes, zeros, levels),
            group=PARTS,
            name="second stage",
            amount=100,
            unit="proposals",
            figure="rate",
        )
    assert torch.isfinite(logits).all()


def bench_inference(benchmark, network, frames):
    """From points to boxes."""
    found = measure(
        benchmark,
        lambda: detect(network, frames[0].points, 0.005, "frame"),
        group=WHOLE,
        name="voxel-rcnn, inference",
        amount=1,
        unit="frames",
        target_s=1.2,
        figure="rate",
    )
    assert len(found.scores) > 0


@pytest.mark.parametrize("preset", ["voxel-rcnn", "voxel-rcnn-small"])
def bench_training_step(benchmark, frames, preset):
    """Encode, forward, loss, backward and update."""
    torch.manual_seed(0)
    student = OpenPCDetDetector.new_student(preset, CATEGORIES)
    student.network.train()
    optimizer = torch.optim.AdamW(student.network.parameters(), lr=1e-4)

    def step():
        loss = student.loss(student.encode(frames, "cpu"), 20.0)["loss"]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        return float(loss.detach())

    loss = measure(
        benchmark, step, group=WHOLE, name=f"{preset}, training step", amount=2, unit="frames",
        rounds=5 if preset == "voxel-rcnn-small" else 1, figure="rate",
    )  # fmt: skip
    assert np.isfinite(loss)
