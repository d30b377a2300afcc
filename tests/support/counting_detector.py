"""A trainable detector in double precision whose loss depends on the whole batch in every way.

It has batch normalisations, divides by a count of the batch, and has a layer that only frames with
objects use. Its curves are the same however the batch is split, up to the rounding of sums.
"""

import os
import signal
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from curate.detectors.base import Sample
from curate.detectors.whole_batch import whole_batch_sum
from curate.files.atomic import replace_file

KILL_AT = "COUNTING_KILL_AT"  # "STEP RANK FILE": a process kills itself once
DELAY_S = "COUNTING_DELAY_S"


class CountingNetwork(nn.Module):
    """Two normalised layers for points, and one more for points of objects."""

    def __init__(self, categories: int) -> None:
        super().__init__()
        self.points = nn.Sequential(
            nn.Linear(4, 8, bias=False), nn.BatchNorm1d(8), nn.Softplus(), nn.Linear(8, 6)
        )
        self.norm = nn.BatchNorm1d(6, momentum=None)
        self.inside = nn.Linear(6, categories)
        self.double()

    def forward(self, points: Tensor) -> Tensor:
        """Return (n, 6) features of points."""
        features: Tensor = self.norm(self.points(points)).tanh()
        return features


@dataclass
class CountingStudent:
    """Learns to which category's object a point belongs."""

    preset: str
    categories: tuple[str, ...]
    network: CountingNetwork
    steps: int = 0

    def encode(self, samples: Sequence[Sample], device: str) -> tuple[Tensor, Tensor]:
        """Return the points of all samples, and the category of each, -1 outside of objects."""
        points, owners = [np.zeros((0, 4))], [np.zeros(0, dtype=np.int64)]
        for sample in samples:
            owner = np.full(len(sample.points), -1)
            for box, name in zip(sample.boxes, sample.categories, strict=True):
                near = np.linalg.norm(sample.points[:, :2] - box[:2], axis=1) < 2
                owner[near] = self.categories.index(name)
            points.append(sample.points.astype(np.float64))
            owners.append(owner)
        return torch.from_numpy(np.concatenate(points)), torch.from_numpy(np.concatenate(owners))

    def loss(self, batch: tuple[Tensor, Tensor], expected_objects: float) -> Mapping[str, Tensor]:
        """Return the mean over the batch's points, and the mean over its points in objects."""
        time.sleep(float(os.environ.get(DELAY_S, "0")))
        self._kill()
        points, owners = batch
        features, inside = self.network(points), owners >= 0
        count = whole_batch_sum(torch.tensor(float(len(points)))).clamp(min=1)
        spread = features.square().sum() / count
        loss, named = spread, torch.zeros(())
        if inside.any():
            logits = self.network.inside(features[inside])
            own = nn.functional.cross_entropy(logits, owners[inside], reduction="sum")
            named = own
        positives = whole_batch_sum(inside.sum()).clamp(min=1)
        loss = loss + named / positives
        return {"loss": loss, "spread": spread, "named": named / positives}

    def _kill(self) -> None:
        self.steps += 1
        if wanted := os.environ.get(KILL_AT):
            step, rank, path = wanted.split(" ", 2)
            is_rank = torch.distributed.is_initialized() and torch.distributed.get_rank() == int(
                rank
            )
            if is_rank and self.steps == int(step) and not Path(path).exists():
                Path(path).touch()
                os.kill(os.getpid(), signal.SIGKILL)

    def save(self, path: Path, weights: Mapping[str, Tensor]) -> None:
        """Write the weights."""
        lines = [f"{name} {tensor.tolist()!r}" for name, tensor in weights.items()]
        replace_file(path, "\n".join(lines).encode())


class CountingDetector:
    """See `curate.detectors.base.TrainableDetector`."""

    presets: ClassVar[Collection[str]] = ("only",)
    checkpoint_suffix: ClassVar[str] = ".txt"
    checkpoint_version: ClassVar[str] = "1"

    @classmethod
    def new_student(cls, preset: str, categories: tuple[str, ...]) -> CountingStudent:
        """Return a student with random weights."""
        return CountingStudent(preset, categories, CountingNetwork(len(categories)))

    @classmethod
    def load_student(cls, checkpoint: Path) -> Any:
        """Return nothing; the tests start from scratch."""
        raise NotImplementedError

    @classmethod
    def check_checkpoint(cls, checkpoint: Path) -> None:
        """Accept every file."""
