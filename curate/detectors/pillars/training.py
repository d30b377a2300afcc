"""The pillar detector in training: batches of frames and their loss."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor

from curate.detectors.base import Sample
from curate.detectors.pillars.checkpoint import load_checkpoint, save_checkpoint
from curate.detectors.pillars.encoding import encode_boxes, encode_points, joined
from curate.detectors.pillars.loss import BatchTargets, weighted_loss
from curate.detectors.pillars.network import NetworkOutput, PillarNetwork, checkpoint_of, network_of
from curate.detectors.pillars.presets import preset_named
from curate.errors import ModelError


@dataclass(frozen=True)
class Batch:
    """The input of the network for b frames, and its targets.

    Attributes:
        features: (n, POINT_FEATURES) features of the points of all frames.
        slots: (n,) row of each point's pillar in the canvas of all frames.
        frames: number of frames b.
        targets: see `BatchTargets`.
    """

    features: Tensor
    slots: Tensor
    frames: int
    targets: BatchTargets


@dataclass(frozen=True)
class PillarStudent:
    """See `curate.detectors.base.Student`."""

    network: PillarNetwork
    categories: tuple[str, ...]

    @classmethod
    def new(cls, preset: str, categories: tuple[str, ...]) -> Self:
        """Return a student with random weights."""
        return cls(PillarNetwork(preset_named(preset), len(categories)), categories)

    @classmethod
    def load(cls, checkpoint: Path) -> Self:
        """Return a student that continues from a checkpoint.

        Raises:
            ModelError: if the file is not a checkpoint of this detector, or is damaged.
        """
        loaded = load_checkpoint(checkpoint)
        try:
            return cls(network_of(loaded), loaded.categories)
        except ModelError as error:
            raise ModelError(f"{checkpoint}: {error}") from None

    @property
    def preset(self) -> str:
        """Name of the network's preset."""
        return self.network.preset.name

    def encode(self, samples: Sequence[Sample], device: str) -> Batch:
        """Return the concatenated pillars of all samples, and their targets."""
        preset, names = self.network.preset, self.categories
        pillars, targets = [], []
        for sample in samples:
            ground = sample.ground
            pillars.append(encode_points(ground.lowered(sample.points), preset))
            ids = np.array([names.index(name) for name in sample.categories], dtype=np.int64)
            boxes = ground.lowered(sample.boxes)
            targets.append(encode_boxes(boxes, ids, sample.weights, len(names), preset))
        features, slots = joined(pillars, preset)
        return Batch(
            torch.from_numpy(features).to(device),
            torch.from_numpy(slots).to(device),
            len(pillars),
            BatchTargets.stack(targets, device),
        )

    def loss(self, batch: Batch, expected_objects: float) -> Mapping[str, Tensor]:
        """Return the weighted loss and its heatmap, box and IoU terms."""
        output = self.network(batch.features, batch.slots, batch.frames)
        output = NetworkOutput(*(each.float() for each in output))  # of mixed precision
        return weighted_loss(output, batch.targets, self.network.preset, expected_objects)

    def save(self, path: Path, weights: Mapping[str, Tensor]) -> None:
        """Write the checkpoint and its ONNX graph."""
        save_checkpoint(path, checkpoint_of(self.network, self.categories, weights))
