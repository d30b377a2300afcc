"""What a GPU computes equals what the CPU computes, and how fast it is; run by `make prove-gpu`.

CURATE_GPU_DEVICE=cpu runs the tests on the CPU in place of a GPU, to check the tests themselves.
"""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.utilisation import Utilisation

from curate.datasets.kitti.dataset import KittiDataset
from curate.detectors.pillars import PillarDetector
from curate.detectors.pillars.checkpoint import load_checkpoint
from curate.detectors.pillars.detector import onnx_forward, torch_forward
from curate.detectors.pillars.encoding import encode_points
from curate.detectors.pillars.presets import PRESETS
from curate.files.onnx_providers import requested_providers
from curate.frames import Calibration, Frame
from curate.segmenters.classes import class_map
from curate.segmenters.onnx import OnnxSegmenter
from curate.training.settings import TrainingSettings
from curate.training.trainer import train
from pipelines.assembly import SHIPPED_SEGMENTER

pytestmark = pytest.mark.gpu

STEPS = 30


@pytest.fixture(scope="module")
def device() -> str:
    """Return the accelerator of torch."""
    if chosen := os.environ.get("CURATE_GPU_DEVICE"):
        return chosen
    if not torch.accelerator.is_available():
        pytest.skip("torch finds no accelerator; install a build of torch for yours")
    return torch.accelerator.current_accelerator().type


@pytest.fixture(scope="module")
def provider() -> str:
    """Return the best provider of ONNX Runtime."""
    best = requested_providers("auto")[0].name
    if best == "cpu" and "CURATE_GPU_DEVICE" not in os.environ:
        pytest.skip("ONNX Runtime has no provider for a GPU; see docs/install.md#gpus")
    return best


def cloud(count: int, seed: int) -> np.ndarray:
    """Return (count, 4) points all over the grid of the small preset."""
    low, high = [0, -32, -2, 0], [64, 32, 1, 1]
    return np.random.default_rng(seed).uniform(low, high, (count, 4)).astype(np.float32)


def frames(number: int) -> list[Frame]:
    """Return frames of 20,000 points."""
    calibration = Calibration(np.eye(3, 4), np.eye(4))
    return [
        Frame(f"{seed:06}", cloud(20_000, seed), calibration, (100, 100)) for seed in range(number)
    ]


@pytest.fixture
def trained(make_labels, tmp_path):
    """Return a function that trains a small detector and returns its checkpoint and losses."""
    labels = make_labels(labeled=4, unlabeled=4)

    def run(name: str, **changes) -> tuple:
        settings = TrainingSettings(preset="small", steps=STEPS, statistics_steps=1)
        report = train(PillarDetector, labels, tmp_path / name, replace(settings, **changes))
        losses = [each.value for each in report.statistics if each.name == "loss"]
        return report, np.array(losses)

    return run


@contextmanager
def measured(what: str, count: int, unit: str) -> Iterator[None]:
    """Print how many units a second a block has done, and how busy the GPU was."""
    with Utilisation() as busy:
        start = time.perf_counter()
        yield
        seconds = time.perf_counter() - start
    print(f"\n{what}: {count / seconds:.1f} {unit}/s, {busy}")  # noqa: T201 - the result


def test_the_network_gives_the_same_scores(device, trained, tmp_path):
    """In torch on the GPU and in ONNX Runtime on the CPU, alone and in a batch."""
    trained("net.safetensors")
    path = tmp_path / "net.safetensors"
    checkpoint = load_checkpoint(path)
    pillars = [encode_points(cloud(4_000 * (1 + i), i), PRESETS["small"]) for i in range(4)]
    on_cpu = onnx_forward(path, checkpoint, 1)(pillars)
    on_gpu = torch_forward(path, checkpoint, device)(pillars)
    for expected, found in zip(on_cpu, on_gpu, strict=True):
        for a, b in zip(expected, found, strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-4, atol=1e-4)
    for precision, tolerance in (("bfloat16", 0.1), ("float16", 0.02)):
        rough = torch_forward(path, checkpoint, device, precision)(pillars)
        worst = max(np.abs(b[0] - a[0]).max() for a, b in zip(on_cpu, rough, strict=True))
        print(f"\nscores in {precision} differ by at most {worst:.4f}")  # noqa: T201
        assert worst < tolerance


def test_a_training_has_the_same_loss_curve(device, trained):
    """Rounding grows from step to step, so the first steps are compared closely."""
    _, on_cpu = trained("cpu.safetensors")
    _, on_gpu = trained("gpu.safetensors", device=device)
    np.testing.assert_allclose(on_gpu[:3], on_cpu[:3], rtol=1e-2)
    assert abs(on_gpu[-5:].mean() / on_cpu[-5:].mean() - 1) < 0.25
    for precision in ("bfloat16", "float16"):
        _, rough = trained(f"{precision}.safetensors", device=device, precision=precision)
        print(f"\nlast losses in {precision}: {rough[-3:]}, float32 {on_gpu[-3:]}")  # noqa: T201
        assert abs(rough[0] / on_cpu[0] - 1) < 0.05
        assert rough[-5:].mean() < on_cpu[:5].mean()


def test_loaders_change_no_loss_on_the_gpu_either(device, trained):
    """Up to the order of atomic additions."""
    _, alone = trained("a.safetensors", device=device)
    _, loaded = trained("b.safetensors", device=device, loaders=2)
    np.testing.assert_allclose(loaded[:3], alone[:3], rtol=1e-3)


def test_the_best_provider_gives_the_same_map(provider, toy_kitti):
    """At least 999 of 1,000 pixels of the shipped segmenter."""
    frame = KittiDataset(toy_kitti).read("000000", image=True)
    expected, found = (
        OnnxSegmenter(SHIPPED_SEGMENTER, class_map("simulated"), providers=each).segment(frame)
        for each in ("cpu", provider)
    )
    assert (found.class_ids == expected.class_ids).mean() > 0.999


@pytest.mark.parametrize("batch", [1, 8])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_frames_per_second_of_predictions(device, trained, tmp_path, batch, precision):
    """Printed, not judged."""
    trained("net.safetensors")
    path = tmp_path / "net.safetensors"
    detector = PillarDetector(path, device=device, precision=precision)
    some = frames(16)
    detector.predict_batch(some[:batch])
    predict: Callable = detector.predict_batch
    with measured(f"predict on {device}, {precision}, batches of {batch}", 64, "frames"):
        for start in range(0, 64, batch):
            predict([some[i % 16] for i in range(start, start + batch)])


@pytest.mark.parametrize("loaders", [0, 2])
def test_frames_per_second_of_training(device, trained, loaders):
    """Printed, not judged; the start of the loaders is included."""
    with measured(f"training on {device} with {loaders} loaders", STEPS * 4, "frames"):
        report, _ = trained("t.safetensors", device=device, loaders=loaders)
    print(f"{report.steps} steps in {report.seconds:.1f} s")  # noqa: T201 - the result


def test_frames_per_second_of_the_segmenter(provider, toy_kitti):
    """Printed, not judged."""
    frame = KittiDataset(toy_kitti).read("000000", image=True)
    segmenter = OnnxSegmenter(SHIPPED_SEGMENTER, class_map("simulated"), providers=provider)
    segmenter.segment(frame)
    with measured(f"segmenter on {provider}", 50, "images"):
        for _ in range(50):
            segmenter.segment(frame)
