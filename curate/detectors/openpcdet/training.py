"""PointPillar, SECOND and Voxel R-CNN in training: batches of frames and their loss."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor

from curate.detectors.base import Sample
from curate.detectors.openpcdet.anchors import anchor_classes, make_anchors
from curate.detectors.openpcdet.checkpoint import load_network, save_checkpoint
from curate.detectors.openpcdet.inference import proposals
from curate.detectors.openpcdet.loss import anchor_loss, roi_loss
from curate.detectors.openpcdet.network import Batch, DetectionNetwork, FirstStage
from curate.detectors.openpcdet.presets import preset_file
from curate.detectors.openpcdet.targets import (
    AnchorTargets,
    Objects,
    anchor_targets,
    joined,
    sample_rois,
)
from curate.detectors.openpcdet.voxels import make_voxels


@dataclass(frozen=True)
class TrainingBatch:
    """The input of the network for b frames, and its targets.

    Attributes:
        voxels: the voxels.
        targets: what the anchors learn.
        objects: the objects of each frame, for the proposals.
    """

    voxels: Batch
    targets: AnchorTargets
    objects: tuple[Objects, ...]


@dataclass(frozen=True)
class AnchorStudent:
    """See `curate.detectors.base.Student`.

    Attributes:
        network: the network.
        preset: name of the preset; empty for a model file of one's own.
    """

    network: DetectionNetwork
    preset: str

    @classmethod
    def new(cls, preset: str, categories: tuple[str, ...]) -> Self:
        """Return a student with random weights.

        Raises:
            ConfigError: if there is no such preset, or it has no anchor for a category.
        """
        return cls(DetectionNetwork(preset_file(preset, categories)), preset)

    @classmethod
    def load(cls, checkpoint: Path, config: Path | None = None) -> Self:
        """Return a student that continues from a checkpoint of curate or OpenPCDet.

        Raises:
            ModelError: if the checkpoint cannot be used.
            ConfigError: if its model file cannot be used.
        """
        network, loaded = load_network(checkpoint, config)
        return cls(network.train(), loaded.preset or "")

    @property
    def categories(self) -> tuple[str, ...]:
        """The class names of the model file."""
        return self.network.file.class_names

    @cached_property
    def _anchors(self) -> tuple[np.ndarray, np.ndarray]:
        """The anchors, and the class of each."""
        return make_anchors(self.network.file), anchor_classes(self.network.file)

    def encode(self, samples: Sequence[Sample], device: str) -> TrainingBatch:
        """Return the voxels of all samples, and what the anchors learn."""
        file = self.network.file
        # At the cap, later points of a file are left out: in any order, this hits all regions.
        sweeps = [
            np.random.default_rng(len(sample.points)).permutation(sample.points)
            for sample in samples
        ]
        voxels = make_voxels(sweeps, file.data_config, training=True)
        objects = tuple(self._objects(sample) for sample in samples)
        return TrainingBatch(
            Batch.of(voxels, device), anchor_targets(*self._anchors, file, objects, device), objects
        )

    def _objects(self, sample: Sample) -> Objects:
        """Return the objects with their centre in the range."""
        limits = np.array(self.network.file.data_config.point_cloud_range).reshape(2, 3)
        centres = sample.boxes[:, :3]
        inside = ((centres >= limits[0]) & (centres <= limits[1])).all(axis=1)
        classes = [self.categories.index(name) for name in sample.categories[inside]]
        return Objects(
            sample.boxes[inside].astype(np.float32),
            np.array(classes, dtype=np.int64),
            sample.weights[inside].astype(np.float32),
        )

    def loss(self, batch: TrainingBatch, expected_objects: float) -> Mapping[str, Tensor]:  # noqa: ARG002 - normalised by counts
        """Return the weighted loss and its terms, by OpenPCDet's names."""
        stage = self.network(batch.voxels)
        model = self.network.file.model
        terms = anchor_loss(stage, batch.targets, model.dense_head)
        if model.roi_head is not None:
            terms |= self._second_stage(stage, batch.objects)
        total = torch.stack(list(terms.values())).sum()
        return {"loss": total, **{name: term.detach() for name, term in terms.items()}}

    def _second_stage(self, stage: FirstStage, objects: Sequence[Objects]) -> Mapping[str, Tensor]:
        """Return the terms of proposals that are sampled from the first stage's boxes."""
        head = self.network.roi_head
        sampled = []
        with torch.no_grad():
            for frame, each in enumerate(objects):
                rois, classes, _ = proposals(
                    self.network, stage, frame, head.config.nms_config.train
                )
                sampled.append(sample_rois(rois, classes, frame, each, head.config.target_config))
        targets = joined(sampled)
        logits, codes = head(targets.rois, targets.frames, stage.levels)
        return roi_loss(logits, codes, targets, head.config)

    def save(self, path: Path, weights: Mapping[str, Tensor]) -> None:
        """Write the checkpoint with its model file."""
        save_checkpoint(path, self.network, weights, self.preset)
