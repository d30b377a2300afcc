"""Training of the small segmentation model that ships with curate, for simulated images.

    python -m curate.simulation.segmentation --out curate/segmenters/models/simulated.onnx

It simulates frames with seeds that no other part of the project uses, and trains an encoder-decoder
with skip connections (after U-Net, Ronneberger et al., MICCAI 2015) on the images at half
resolution. It then measures the intersection over union on frames of another seed and exports the
model to ONNX. Input: uint8 RGB [1, 188, 621, 3]. Output: class ids [1, 188, 621] (0 background,
1 car, 2 pedestrian, 3 cyclist).
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
"""Seeds of the simulated frames for training and for testing."""

INPUT_SIZE = (621, 188)
_CLASSES = len(SEMANTIC_CLASSES) + 1
_CROP_COLUMNS = 320
# Background, car, pedestrian, cyclist. Pedestrians and cyclists cover few pixels.
_CLASS_WEIGHTS = (0.7, 1.0, 1.6, 1.6)


@dataclass(frozen=True)
class SegmentationSettings:
    """Settings of the training; the defaults are those of the shipped model.

    Attributes:
        frames: number of simulated images for training.
        test_frames: number of simulated images for testing.
        steps: optimiser steps.
        batch_size: crops per step.
        learning_rate: peak of the one-cycle schedule.
        threads: number of torch threads, and of simulation processes.
        seed: seed of the weights, the crops and the augmentation.
    """

    frames: int = 320
    test_frames: int = 60
    steps: int = 1500
    batch_size: int = 4
    learning_rate: float = 3e-3
    threads: int = 2
    seed: int = 0


class SegmentationNet(nn.Module):
    """A U-Net of four levels (1/1, 1/2, 1/4 and 1/8 of the input) with 0.2 M parameters.

    The deepest level has dilated convolutions.
    """

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
        self.head = nn.Conv2d(8, _CLASSES, 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return (b, 4, h, w) logits of (b, h, w, 3) uint8 RGB images."""
        sharp = self.sharp(images.permute(0, 3, 1, 2).float() / 127.5 - 1)
        fine = self.fine(sharp)
        middle = self.middle(fine)
        deep = self.deep_to_middle(self.deep(middle))
        middle = self.mix_middle(middle + _upsample(deep, middle.shape[2:]))
        fine = self.mix_fine(fine + _upsample(self.middle_to_fine(middle), fine.shape[2:]))
        sharp = self.mix_sharp(sharp + _upsample(self.fine_to_sharp(fine), sharp.shape[2:]))
        logits: torch.Tensor = self.head(sharp)
        return logits


class _Residual(nn.Module):
    """A residual block of two convolutions."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            _convolution(channels, channels), _convolution(channels, channels, dilation=dilation)
        )

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return features of the same shape."""
        out: torch.Tensor = features + self.body(features)
        return out


def train_segmentation(out: Path, settings: SegmentationSettings) -> dict[str, float]:
    """Train the model, write it to `out`, and return its intersection over union by class."""
    torch.manual_seed(settings.seed)
    torch.set_num_threads(settings.threads)
    start = time.perf_counter()
    images, truth, _ = _simulate_images(TRAIN_SEED, settings.frames, settings.threads)
    _log.info("simulated %d images in %.0f s", len(images), time.perf_counter() - start)
    net = _fit(images, truth, settings)
    _log.info("trained for %d steps, %.0f s in total", settings.steps, time.perf_counter() - start)
    replace_file(out, _export(net))
    images, _, full_truth = _simulate_images(TEST_SEED, settings.test_frames, settings.threads)
    scores = _intersection_over_union(net, images, full_truth)
    for name, score in scores.items():
        _log.info("IoU of %s: %.3f", name, score)
    _log.info("mean IoU: %.3f; wrote %s", np.mean(list(scores.values())), out)
    return scores


def _convolution(inputs: int, outputs: int, *, stride: int = 1, dilation: int = 1) -> nn.Module:
    """Return a 3 x 3 convolution with batch norm and ReLU."""
    return nn.Sequential(
        nn.Conv2d(
            inputs, outputs, 3, stride=stride, padding=dilation, dilation=dilation, bias=False
        ),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def _upsample(features: torch.Tensor, size: torch.Size) -> torch.Tensor:
    """Interpolate features bilinearly to (height, width)."""
    return functional.interpolate(features, size=tuple(size), mode="bilinear", align_corners=False)


def _simulate_images(
    seed: int, frames: int, workers: int
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return (n, h, w, 3) images and (n, h, w) class ids in the model's size.

    Also return the class ids in full size.
    """
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
    """Return 1 minus the soft Dice coefficient, averaged over the classes except background.

    Source: Milletari et al., "V-Net", 3DV 2016. Classes count equally, even if they cover few
    pixels.
    """
    predicted = logits.softmax(dim=1)[:, 1:]
    truth = functional.one_hot(targets, _CLASSES).permute(0, 3, 1, 2)[:, 1:].float()
    common = (predicted * truth).sum(dim=(0, 2, 3))
    total = predicted.sum(dim=(0, 2, 3)) + truth.sum(dim=(0, 2, 3))
    dice: torch.Tensor = (2 * common + 1) / (total + 1)
    return (1 - dice).mean()


def _batch(
    images: np.ndarray, truth: np.ndarray, size: int, generator: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return random crops and their classes, with random mirroring, brightness and colour gain."""
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
    """Return the IoU by class over all pixels of all images in full size; NaN without pixels."""
    counts = np.zeros((_CLASSES, _CLASSES))
    for image, expected in zip(images, truth, strict=True):
        with torch.no_grad():
            logits = net(torch.from_numpy(image[None]))
        small = logits[0].argmax(dim=0).numpy().astype(np.uint8)
        predicted = cv2.resize(small, expected.shape[::-1], interpolation=cv2.INTER_NEAREST)
        pairs = expected.ravel().astype(np.int64) * _CLASSES + predicted.ravel()
        counts += np.bincount(pairs, minlength=_CLASSES**2).reshape(_CLASSES, _CLASSES)
    union = counts.sum(axis=0) + counts.sum(axis=1) - np.diag(counts)
    names = ("background", *SEMANTIC_CLASSES)
    ious = np.divide(np.diag(counts), union, out=np.full(_CLASSES, np.nan), where=union > 0)
    return dict(zip(names, ious.tolist(), strict=True))


def _export(net: SegmentationNet) -> bytes:
    """Return the serialized ONNX model."""
    weights = {name: tensor.detach().numpy() for name, tensor in net.state_dict().items()}
    return bytes(build_graph(weights, *INPUT_SIZE).SerializeToString())


def main() -> None:
    """Parse the command line and train the model."""
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
