"""What every detector offers, and what one offers that curate can train."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from curate.detections import Detections
from curate.errors import ConfigError
from curate.frames import Frame
from curate.geometry.ground import GroundMap
from curate.geometry.similarity import Similarity
from curate.shapes import Bool, Float, Float32, Shaped
from curate.spelling import did_you_mean
from curate.weighting.base import ZeroWeight

if TYPE_CHECKING:
    from torch import Tensor, nn


class Detector(Protocol):
    """Finds boxes in a frame; raises `ModelError` where the model cannot be used as it is."""

    def predict(self, frame: Frame) -> Detections:
        """Return all boxes of the frame, low scores too, after non-maximum suppression.

        Boxes are in the frame of reference of `frame.points`, which the caller may have cropped
        to the camera's view or transformed by a similarity.
        """
        ...


@runtime_checkable
class RecordedViews(Protocol):
    """A detector whose answers for augmented copies were recorded: it dictates the augmentation."""

    def views(self, frame_id: str) -> Sequence[tuple[Similarity, Detections]]:
        """Each augmented copy A(x) of the frame with the detections in A's frame of reference."""
        ...


@dataclass(frozen=True)
class Sample:
    """One frame to learn from.

    Attributes:
        frame_id: name of the frame.
        labeled: whether the boxes are ground truth (X_l) or pseudo-labels (X_u).
        points: (n, 4) float32 inside the camera's view, LiDAR frame.
        boxes: (m, 7) in the LiDAR frame.
        categories: (m,) str.
        weights: (m,) in [0, 1]: 1 for ground truth.
        zero_weight: what a pseudo-label of weight 0 is: "background", so no object, or a region to
            "ignore". The label file says it, as the policy has it.
    """

    frame_id: str
    labeled: bool
    points: Float32[np.ndarray, "n 4"]
    boxes: Float[np.ndarray, "m 7"]
    categories: Shaped[np.ndarray, " m"]
    weights: Float[np.ndarray, " m"]
    zero_weight: ZeroWeight = "ignore"

    @property
    def ignored(self) -> Bool[np.ndarray, " m"]:
        """(m,) bool, which boxes are ignore regions: neither object nor background."""
        nothing = self.weights == 0
        return nothing if self.labeled or self.zero_weight == "ignore" else np.zeros_like(nothing)

    @cached_property
    def ground(self) -> GroundMap:
        """The height of the ground; a training asks for it in every pass."""
        return GroundMap.of(self.points)


class Student(Protocol):
    """A detector in training: its network, batch encoding, targets and loss.

    All that training changes lies in the parameters and buffers of `network`: the trainer optimises
    and averages them and stores them in snapshots. What is random in the network or the loss
    (dropout, sampled proposals) draws from torch's global generators, which the trainer seeds in
    every step.

    Attributes:
        preset: name of the preset that the network was built from.
        categories: what it finds, in the order of its outputs.
        network: on CPU at first; the trainer moves it to the device of the training.
    """

    preset: str
    categories: tuple[str, ...]
    network: "nn.Module"

    def encode(self, samples: Sequence[Sample], device: str) -> Any:
        """Return a batch of augmented samples with its targets, as `loss` takes it.

        A box of weight 0 is an ignore region, neither object nor background: what shall be
        background has been removed from the sample. Every other weight v multiplies all loss terms
        of its object: classification, box, direction, second stage.
        """
        ...

    def loss(self, batch: Any, expected_objects: float) -> "Mapping[str, Tensor]":
        """Return the loss of a batch: first `loss`, which is minimised, then its terms by name.

        Args:
            batch: from `encode`.
            expected_objects: objects that the labeled frames of a batch hold on average. The loss
                is normalised by this or by counts (of objects, anchors, proposals), never by sums
                of weights, which would cancel them.
        """
        ...

    def save(self, path: Path, weights: "Mapping[str, Tensor]") -> None:
        """Write a checkpoint, and what inference needs beside it; each file whole or not at all.

        Args:
            path: with the detector's `checkpoint_suffix`; the detector's constructor takes it.
            weights: the state of `network`, or a moving average of it.
        """
        ...


class TrainableDetector(Detector, Protocol):
    """A detector that curate can train; its constructor takes a checkpoint as first argument.

    A class is trainable if it has all of these members; importing it need not import torch.

    Attributes:
        presets: names of the networks that can be trained; the first is the default.
        checkpoint_suffix: of its checkpoint files, such as ".safetensors".
        checkpoint_version: of their format; checkpoints of another version are trained again.
    """

    presets: ClassVar[Collection[str]]
    checkpoint_suffix: ClassVar[str]
    checkpoint_version: ClassVar[str]

    @classmethod
    def check_checkpoint(cls, checkpoint: Path) -> None:
        """Check that a file is a checkpoint of this detector and of this format version.

        Raises:
            ModelError: if it is missing, damaged, of another detector or of another version.
        """
        ...

    @classmethod
    def new_student(cls, preset: str, categories: tuple[str, ...]) -> Student:
        """Return a student with first weights drawn from torch's global generator."""
        ...

    @classmethod
    def load_student(cls, checkpoint: Path) -> Student:
        """Return a student that continues from a checkpoint.

        Raises:
            ModelError: as `check_checkpoint`.
        """
        ...


def choose_preset(detector: type[TrainableDetector], name: str | None) -> str:
    """Return the name of one of the detector's presets; None stands for the first.

    Raises:
        ConfigError: if the detector has no such preset; the known ones are listed.
    """
    chosen = next(iter(detector.presets), "") if name is None else name
    if chosen not in detector.presets:
        known = ", ".join(detector.presets)
        meant = did_you_mean(chosen, detector.presets)
        raise ConfigError(f"unknown preset {chosen!r}; choose one of {known}{meant}")
    return chosen
