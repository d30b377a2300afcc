"""Trains the small segmentation model that the project ships for simulated images.

    python -m curate.simulation.segmentation --out curate/segmenters/models/simulated.onnx

It simulates frames under seeds of its own, which no other part of the project uses, trains an
encoder-decoder with skip connections (after U-Net, Ronneberger et al., MICCAI 2015) on their images
at half resolution, measures the intersection over union on frames of another seed, and exports to
ONNX: uint8 RGB [1, 188, 621, 3] in, class ids [1, 188, 621] out (0 background, 1 car,
2 pedestrian, 3 cyclist).
"""

import argparse
import logging
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn
from torch.nn import functional

from curate.datasets.formats.images import decode_image, read_image
from curate.files.atomic import replace_file
from curate.simulation import SEMANTIC_CLASSES, SEMANTIC_FOLDER, simulate
from curate.simulation.segmentation_graph import build_graph

_log = logging.getLogger(__name__)

TRAIN_SEED, TEST_SEED = 730_001, 730_002
"""Seeds of the simulations that the model learns from and is measured on."""

INPUT_SIZE = (621, 188)
_CLASSES = len(SEMANTIC_CLASSES) + 1
_CROP_COLUMNS = 320
# Pedestrians and cyclists cover few pixels: background, car, pedestrian, cyclist.
_CLASS_WEIGHTS = (0.7, 1.0, 1.6, 1.6)


@dataclass(frozen=True)
class SegmentationSettings:
    """How the shipped model was trained.

    Attributes:
        frames: simulated images to learn from.
        test_frames: images to measure on.
        steps: of the optimiser.
        batch_size: crops per step.
        learning_rate: the peak of a one-cycle schedule.
        threads: of torch, and processes of the simulation.
        seed: of the weights, the crops and the augmentation.
    """

    frames: int = 320
    test_frames: int = 60
    steps: int = 1500
    batch_size: int = 4
    learning_rate: float = 3e-3
    threads: int = 2
    seed: int = 0


class SegmentationNet(nn.Module):
    """Four levels at 1/1, 1/2, 1/4 and 1/8 of the input, the deepest dilated; 0.2 M parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.sharp = _convolution(3, 8)
        self.fine = _convolution(8, 16, stride=2)
        self.middle = nn.Sequential(_convolution(16, 32, stride=2), _Residual(32, 1))
        self.deep = nn.Sequential(
            _convolution(32, 64, stride=2), _Residual(64, 2), _Residual(64, 4)
        )
        self.deep_to_middle = nn.Conv2d(64, 32, 1)
        self.mix_middle = _convolution(32, 32)
        self.middle_to_fine = nn.Conv2d(32, 16, 1)
        self.mix_fine = _convolution(16, 16)
        self.fine_to_sharp = nn.Conv2d(16, 8, 1)
        self.mix_sharp = _convolution(8, 8)
        self.answer = nn.Conv2d(8, _CLASSES, 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return (b, 4, h, w) logits of (b, h, w, 3) uint8 RGB images."""
        sharp = self.sharp(images.permute(0, 3, 1, 2).float() / 127.5 - 1)
        fine = self.fine(sharp)
        middle = self.middle(fine)
        deep = self.deep_to_middle(self.deep(middle))
        middle = self.mix_middle(middle + _upsample(deep, middle.shape[2:]))
        fine = self.mix_fine(fine + _upsample(self.middle_to_fine(middle), fine.shape[2:]))
        sharp = self.mix_sharp(sharp + _upsample(self.fine_to_sharp(fine), sharp.shape[2:]))
        logits: torch.Tensor = self.answer(sharp)
        return logits


class _Residual(nn.Module):
    """Two convolutions around which the input is carried."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            _convolution(channels, channels), _convolution(channels, channels, dilation=dilation)
        )

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Features of the same shape."""
        out: torch.Tensor = features + self.body(features)
        return out


def train_segmentation(out: Path, settings: SegmentationSettings) -> dict[str, float]:
    """Train the model, writes it to `out`, and returns its intersection over union by class."""
    torch.manual_seed(settings.seed)
    torch.set_num_threads(settings.threads)
    start = time.perf_counter()
    images, truth, _ = _simulated(TRAIN_SEED, settings.frames, settings.threads)
    _log.info("simulated %d images in %.0f s", len(images), time.perf_counter() - start)
    net = _fit(images, truth, settings)
    _log.info("trained for %d steps, %.0f s in all", settings.steps, time.perf_counter() - start)
    replace_file(out, _exported(net))
    images, _, full_truth = _simulated(TEST_SEED, settings.test_frames, settings.threads)
    scores = _intersection_over_union(net, images, full_truth)
    for name, score in scores.items():
        _log.info("IoU of %s: %.3f", name, score)
    _log.info("mean IoU: %.3f; wrote %s", np.mean(list(scores.values())), out)
    return scores


def _convolution(inputs: int, outputs: int, *, stride: int = 1, dilation: int = 1) -> nn.Module:
    """3 x 3 convolution, normalisation, rectification."""
    return nn.Sequential(
        nn.Conv2d(
            inputs, outputs, 3, stride=stride, padding=dilation, dilation=dilation, bias=False
        ),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def _upsample(features: torch.Tensor, size: torch.Size) -> torch.Tensor:
    """Bilinear interpolation to (height, width)."""
    return functional.interpolate(features, size=tuple(size), mode="bilinear", align_corners=False)


def _simulated(
    seed: int, frames: int, workers: int
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Images (n, h, w, 3) and classes (n, h, w) in the model's size, and classes in full size."""
    with tempfile.TemporaryDirectory() as folder:
        simulate(Path(folder), frames, seed, val_frames=0, workers=workers)
        images, truth, full = [], [], []
        for path in sorted((Path(folder) / "training" / "image_2").glob("*.png")):
            class_path = path.parents[1] / SEMANTIC_FOLDER / path.name
            class_ids = decode_image(class_path, cv2.IMREAD_UNCHANGED)
            images.append(cv2.resize(read_image(path), INPUT_SIZE, interpolation=cv2.INTER_AREA))
            truth.append(cv2.resize(class_ids, INPUT_SIZE, interpolation=cv2.INTER_NEAREST))
            full.append(class_ids)
    return np.stack(images), np.stack(truth), full


def _fit(images: np.ndarray, truth: np.ndarray, settings: SegmentationSettings) -> SegmentationNet:
    """Return the trained network, in evaluation mode."""
    generator = np.random.default_rng(settings.seed)
    net = SegmentationNet()
    optimiser = torch.optim.AdamW(net.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=settings.steps
    )
    weights = torch.tensor(_CLASS_WEIGHTS)
    for step in range(settings.steps):
        crops, targets = _batch(images, truth, settings.batch_size, generator)
        logits = net(crops)
        loss = functional.cross_entropy(logits, targets, weights) + _dice_loss(logits, targets)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        if step % 50 == 0:
            _log.info("step %d of %d: loss %.4f", step, settings.steps, loss.item())
    return net.eval()


def _dice_loss(logits: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """1 - the soft Dice coefficient, mean over the classes but the background.

    Source: Milletari et al., "V-Net", 3DV 2016. It weighs each class by its overlap, however few
    pixels it covers.
    """
    found = logits.softmax(dim=1)[:, 1:]
    truth = functional.one_hot(targets, _CLASSES).permute(0, 3, 1, 2)[:, 1:].float()
    common = (found * truth).sum(dim=(0, 2, 3))
    total = found.sum(dim=(0, 2, 3)) + truth.sum(dim=(0, 2, 3))
    dice: torch.Tensor = (2 * common + 1) / (total + 1)
    return (1 - dice).mean()


def _batch(
    images: np.ndarray, truth: np.ndarray, size: int, generator: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Random crops, mirrored and with other brightness, contrast and colour balance."""
    crops, targets = [], []
    for index in generator.integers(len(images), size=size):
        left = generator.integers(images.shape[2] - _CROP_COLUMNS + 1)
        part = slice(left, left + _CROP_COLUMNS)
        flip = slice(None, None, generator.choice([-1, 1]))
        gain = generator.uniform(0.75, 1.3) * generator.uniform(0.93, 1.07, size=3)
        pixels = images[index, :, part][:, flip] * gain + generator.uniform(-18, 18)
        crops.append(np.clip(pixels, 0, 255).astype(np.uint8))
        targets.append(truth[index, :, part][:, flip])
    return torch.from_numpy(np.stack(crops)), torch.from_numpy(np.stack(targets)).long()


def _intersection_over_union(
    net: SegmentationNet, images: np.ndarray, truth: list[np.ndarray]
) -> dict[str, float]:
    """By class, over all pixels of all images in full size; NaN for a class that has none."""
    counts = np.zeros((_CLASSES, _CLASSES))
    for image, expected in zip(images, truth, strict=True):
        with torch.no_grad():
            logits = net(torch.from_numpy(image[None]))
        answer = logits[0].argmax(dim=0).numpy().astype(np.uint8)
        found = cv2.resize(answer, expected.shape[::-1], interpolation=cv2.INTER_NEAREST)
        pairs = expected.ravel().astype(np.int64) * _CLASSES + found.ravel()
        counts += np.bincount(pairs, minlength=_CLASSES**2).reshape(_CLASSES, _CLASSES)
    union = counts.sum(axis=0) + counts.sum(axis=1) - np.diag(counts)
    names = ("background", *SEMANTIC_CLASSES)
    shares = np.divide(np.diag(counts), union, out=np.full(_CLASSES, np.nan), where=union > 0)
    return dict(zip(names, shares.tolist(), strict=True))


def _exported(net: SegmentationNet) -> bytes:
    """Return the ONNX model."""
    weights = {name: tensor.detach().numpy() for name, tensor in net.state_dict().items()}
    return bytes(build_graph(weights, *INPUT_SIZE).SerializeToString())


def main() -> None:
    """Read the command line and trains."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="the .onnx file to write")
    defaults = SegmentationSettings()
    parser.add_argument("--frames", type=int, default=defaults.frames)
    parser.add_argument("--steps", type=int, default=defaults.steps)
    parser.add_argument("--threads", type=int, default=defaults.threads)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    settings = SegmentationSettings(
        frames=arguments.frames, steps=arguments.steps, threads=arguments.threads
    )
    train_segmentation(arguments.out, settings)


if __name__ == "__main__":
    main()
