"""A training step, and a simulated frame, against the part of them that a library computes."""

import numpy as np
import pytest
import torch
from benchmarks.measuring import OURS, cpu_seconds, measure
from benchmarks.scenes import guesses_around

from curate.detections import CATEGORIES
from curate.detectors.base import Sample
from curate.detectors.pillars.detector import PillarDetector
from curate.geometry.projection import in_camera_view
from curate.simulation import simulate
from curate.simulation.lidar import sweep
from curate.simulation.pixels import cast_pixels
from curate.simulation.rig import CameraRig
from curate.simulation.scene import Caster, Scene
from curate.training.object_bank import ObjectBank
from curate.training.settings import TrainingSettings
from pipelines.workspace.config import make_config
from pipelines.workspace.workspace import open_dataset

pytestmark = pytest.mark.benchmark(timer=cpu_seconds)

TRAINING = "A training step of the preset small, 4 frames with about 60 labels each"
SIMULATION = "A simulated frame"
FRAMES = 4
CLUTTER = 55


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """Return labeled samples of simulated frames; boxes of clutter have weights below 1."""
    root = tmp_path_factory.mktemp("training")
    simulate(root, FRAMES, 0, val_frames=0, workers=1)
    dataset = open_dataset(make_config({"dataset": {"root": root}}, "benchmark"))
    generator = np.random.default_rng(0)
    found = []
    for name in dataset.frame_ids():
        frame = dataset.read(name)
        boxes = guesses_around(generator, dataset.annotations(name), CLUTTER)
        points = frame.points[in_camera_view(frame)]
        labels = boxes.boxes, boxes.categories, boxes.scores
        found.append(Sample(name, True, points, *labels))
    return found


@pytest.fixture(scope="module")
def student():
    """Return a student of the preset small."""
    torch.manual_seed(0)
    found = PillarDetector.new_student("small", CATEGORIES)
    found.network.train()
    return found


def bench_training_step(benchmark, samples, student):
    """Paste, augment, encode, forward, loss, backward, clip and update."""
    settings = TrainingSettings()
    augmentation = settings.augmentation()
    bank = ObjectBank.build(samples, CATEGORIES, settings.fewest_points)
    generator = np.random.default_rng(0)
    optimizer = torch.optim.AdamW(student.network.parameters(), lr=1e-4)

    def step():
        augmented = [augmentation.apply(sample, bank, generator) for sample in samples]
        loss = student.loss(student.encode(augmented, "cpu"), 20.0)["loss"]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(student.network.parameters(), 10.0)
        optimizer.step()
        return float(loss.detach())

    loss = measure(benchmark, step, group=TRAINING, name=OURS, amount=FRAMES, unit="frames")
    assert np.isfinite(loss)


def bench_convolutions(benchmark, student):
    """Compute the 3 x 3 convolutions of the same network alone, forward and backward."""
    network = student.network
    layers = [each for each in network.modules() if isinstance(each, torch.nn.Conv2d)]
    columns, rows = network.preset.cells
    maps = []
    for layer in layers:
        # The width of a scale follows from its channels; a stride halves it.
        scale = network.preset.channels.index(layer.in_channels)
        shape = FRAMES, layer.in_channels, columns >> scale, rows >> scale
        maps.append(torch.randn(shape).contiguous(memory_format=torch.channels_last))
    inputs = [each.requires_grad_() for each in maps]

    def convolve():
        for layer, each in zip(layers, inputs, strict=True):
            each.grad = layer.weight.grad = None
            output = layer(each)
            output.backward(torch.ones_like(output))
        return len(layers)

    name = "its 3 x 3 convolutions alone (PyTorch)"
    measure(benchmark, convolve, group=TRAINING, name=name, amount=FRAMES, unit="frames")


def bench_simulated_frame(benchmark, tmp_path):
    """Simulate sweep, image, semantic map and labels of a frame, and write the files."""

    def setup() -> tuple[tuple, dict]:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        return (folder, 4, 1), {"val_frames": 0, "workers": 1}

    measure(benchmark, simulate, group=SIMULATION, amount=4, unit="frames", setup=setup, rounds=4)


def bench_rays(benchmark):
    """Cast the rays of the sweeps and of the images alone."""
    scenes = []
    for index in range(4):
        layout, laser, lens = (np.random.default_rng([1, index, part]) for part in range(3))
        scene = Scene.draw(layout)
        scenes.append((scene, CameraRig.draw(lens), laser))

    def cast():
        for scene, rig, laser in scenes:
            caster = Caster(scene.vertices, scene.triangles)
            sweep(scene, caster, laser)
            cast_pixels(caster, rig)

    name = "its sweep and the rays of its pixels alone (Open3D)"
    measure(benchmark, cast, group=SIMULATION, name=name, amount=4, unit="frames")
