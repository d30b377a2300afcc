"""Interfaces of detectors, and of detectors that curate can train."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from curate.detections import Detections
from curate.errors import ConfigError, CurateError
from curate.frames import Calibration, Frame, RotationY
from curate.geometry.ground import GroundMap
from curate.geometry.similarity import Similarity
from curate.shapes import Bool, Float, Float32, Shaped
from curate.spelling import did_you_mean
from curate.weighting.base import ZeroWeight

if TYPE_CHECKING:
    from torch import Tensor, nn


_NO_OPTIONS: Mapping[str, Any] = MappingProxyType({})


class Detector(Protocol):
    """Finds boxes in a frame; raises `ModelError` if the model cannot be used."""

    def predict(self, frame: Frame) -> Detections:
        """Return all boxes of the frame, including low scores, after non-maximum suppression.

        Boxes are in the frame of reference of `frame.points`. The caller may have cropped these
        points to the camera's view or transformed them by a similarity.
        """
        ...


@runtime_checkable
class BatchDetector(Detector, Protocol):
    """A detector that finds the boxes of several frames in one call."""

    @classmethod
    def batch_size(cls, device: str) -> int:
        """Return how many frames it gets at a time by default.

        Args:
            device: a device of torch, or a provider of ONNX Runtime, such as "cpu" or "cuda".
        """
        ...

    def predict_batch(self, frames: Sequence[Frame]) -> Sequence[Detections | CurateError]:
        """Return the boxes of each frame as `predict` does, or the error of this frame alone.

        The boxes of a frame do not depend on the other frames. If the call raises an error, it is
        repeated with smaller batches, so that only frames fail that raise it by themselves.
        """
        ...


@runtime_checkable
class CopiesDetector(Protocol):
    """A detector that runs elsewhere, on copies of the files of the frames."""

    @classmethod
    def batch_size(cls, device: str) -> int:
        """Return how many frames it gets at a time by default."""
        ...

    def predict_copies(
        self, copies: Mapping[str, Similarity | None], view: int = 0
    ) -> Sequence[Detections | CurateError]:
        """Return the boxes that it finds in each frame or copy A(x), in the frame of A(x).

        Args:
            copies: A of each frame, by frame id; None for the frame itself.
            view: number of the copy, from 1; 0 for the frames themselves.

        Returns:
            For each frame, in the same order, its boxes or the error of this frame.
        """
        ...

    def rotation_y_of_copies(self, calibration: Calibration) -> RotationY:
        """Return how rotation_y of results of copies is read, for the calibration of a frame."""
        ...


@runtime_checkable
class RecordedViews(Protocol):
    """A detector with stored predictions for augmented copies; the record defines each A."""

    def views(self, frame_id: str) -> Sequence[tuple[Similarity, Detections]]:
        """Return A and the detections of each augmented copy A(x), in A's frame of reference."""
        ...


@runtime_checkable
class DeclaresInput(Protocol):
    """A detector that says whether it looks at the points of a frame; others always get them.

    Attributes:
        needs_points: False if `predict` takes only the frame's name, calibration and image size.
            Reading the points takes longer than most of what curate does with a frame.
    """

    needs_points: bool


@runtime_checkable
class NamesCategories(Protocol):
    """A detector that knows the category names of its boxes before it sees a frame."""

    def category_names(self) -> Collection[str]:
        """Return all names that its boxes can have."""
        ...


@runtime_checkable
class DescribesScores(Protocol):
    """A detector that says what the scores of its boxes estimate."""

    @classmethod
    def score_meaning(
        cls, preset: str, checkpoint: Path | None = None, options: Mapping[str, Any] = _NO_OPTIONS
    ) -> str:
        """Return what a score estimates, as a noun phrase such as "the 3D IoU with the object".

        Args:
            preset: name of the network's preset, if there is no checkpoint.
            checkpoint: the user's checkpoint; it is not loaded if the options say enough.
            options: `detector.options`.

        Raises:
            CurateError: if the checkpoint, or a file of the options, cannot be used.
        """
        ...


@runtime_checkable
class ExportsOnnx(Protocol):
    """A detector with a network that can be written as an ONNX model."""

    @classmethod
    def export_onnx(
        cls, checkpoint: Path, output: Path, options: Mapping[str, Any]
    ) -> tuple[str, ...]:
        """Write a checkpoint as an ONNX model; return its inputs, outputs and use, in lines.

        Args:
            checkpoint: the checkpoint.
            output: the file to write.
            options: `detector.options`.

        Raises:
            ConfigError: if ONNX has no operators for the network.
            ModelError: if the checkpoint cannot be used, or the file cannot be written.
        """
        ...


IgnoredRegions = Mapping[str, tuple[Float[np.ndarray, "n 7"], Shaped[np.ndarray, " n"]]]
"""Boxes of regions to ignore, and their categories, by frame."""


@dataclass(frozen=True)
class Sample:
    """One training frame with its weighted labels.

    Attributes:
        frame_id: id of the frame.
        labeled: true if the boxes are ground truth (X_l), false if they are pseudo-labels (X_u).
        points: (n, 4) float32 inside the camera's view, LiDAR frame.
        boxes: (m, 7) in the LiDAR frame.
        categories: (m,) str.
        weights: (m,) v in [0, 1]; 1 for ground truth.
        zero_weight: meaning of a pseudo-label of weight 0: "background" (not an object) or a region
            to "ignore". It comes from the policy, through the label file.
        regions: (m,) bool, boxes of weight 0 that are regions to ignore in any case, such as
            proposals for missed objects; None for none.
    """

    frame_id: str
    labeled: bool
    points: Float32[np.ndarray, "n 4"]
    boxes: Float[np.ndarray, "m 7"]
    categories: Shaped[np.ndarray, " m"]
    weights: Float[np.ndarray, " m"]
    zero_weight: ZeroWeight = "ignore"
    regions: Bool[np.ndarray, " m"] | None = None

    @property
    def ignored(self) -> Bool[np.ndarray, " m"]:
        """(m,) bool, true for boxes that are ignore regions: neither object nor background."""
        zero = np.asarray(self.weights == 0)
        if self.labeled or self.zero_weight == "ignore":
            return zero
        return np.asarray(zero & (False if self.regions is None else self.regions))

    @cached_property
    def ground(self) -> GroundMap:
        """Height map of the ground; cached because training reads it in every pass."""
        return GroundMap.of(self.points)


class Student(Protocol):
    """A detector in training: its network, batch encoding, targets and loss.

    Everything that training changes is in the parameters and buffers of `network`. The trainer
    optimises and averages them and stores them in snapshots. Randomness in the network or the loss
    (dropout, sampled proposals) comes from torch's global generators, which the trainer seeds in
    every step. For a training on several processes a student is pickled.

    Attributes:
        preset: name of the preset that the network was built from; empty if it was built from
            something else, such as a model file of the user: every preset fits then.
        categories: categories that it detects, in the order of its outputs.
        network: on CPU at first; the trainer moves it to the training device.
    """

    preset: str
    categories: tuple[str, ...]
    network: "nn.Module"

    def encode(self, samples: Sequence[Sample], device: str) -> Any:
        """Return a batch of augmented samples with its targets, as the input of `loss`.

        A box of weight 0 is an ignore region here, neither object nor background: labels that
        count as background have already been removed from the sample. Every other weight v
        multiplies all loss terms of its object: classification, box, direction, second stage.
        """
        ...

    def loss(self, batch: Any, expected_objects: float) -> "Mapping[str, Tensor]":
        """Return the loss of a batch: first `loss`, which is minimised, then its terms by name.

        Args:
            batch: from `encode`.
            expected_objects: average number of objects in the labeled frames of a batch. Normalise
                the loss by this number or by counts (of objects, anchors, proposals), never by sums
                of weights: these would cancel the weights. Several processes split a batch, and the
                sum of their losses is its loss: divide by counts of the whole batch, see
                `curate.detectors.whole_batch`. The terms are always the same.
        """
        ...

    def save(self, path: Path, weights: "Mapping[str, Tensor]") -> None:
        """Write a checkpoint and the files that inference needs, each one atomically.

        Args:
            path: has the detector's `checkpoint_suffix`; the detector's constructor accepts it.
            weights: the state of `network`, or a moving average of it.
        """
        ...


class TrainableDetector(Detector, Protocol):
    """A detector that curate can train; its constructor takes a checkpoint as first argument.

    A class is trainable if it has all of these members. Importing it need not import torch.

    Attributes:
        presets: names of the networks that can be trained; the first is the default.
        checkpoint_suffix: suffix of its checkpoint files, such as ".safetensors".
        checkpoint_version: version of their format; checkpoints of another version are trained
            again.
    """

    presets: ClassVar[Collection[str]]
    checkpoint_suffix: ClassVar[str]
    checkpoint_version: ClassVar[str]

    @classmethod
    def check_checkpoint(cls, checkpoint: Path) -> None:
        """Check that a file is a checkpoint of this detector and of this format version.

        Raises:
            ModelError: if the file is missing, damaged, or of another detector or version.
        """
        ...

    @classmethod
    def new_student(cls, preset: str, categories: tuple[str, ...]) -> Student:
        """Return a student with initial weights drawn from torch's global generator."""
        ...

    @classmethod
    def load_student(cls, checkpoint: Path) -> Student:
        """Return a student that continues from a checkpoint.

        Keyword arguments may follow, with names of the constructor's options: those that the user
        has set are passed.

        Raises:
            ModelError: as in `check_checkpoint`.
        """
        ...


def choose_preset(detector: type[TrainableDetector], name: str | None) -> str:
    """Return the name of one of the detector's presets; None selects the first.

    Raises:
        ConfigError: if the detector has no such preset; the message lists all of them.
    """
    chosen = next(iter(detector.presets), "") if name is None else name
    if chosen not in detector.presets:
        choices = ", ".join(detector.presets)
        hint = did_you_mean(chosen, detector.presets)
        raise ConfigError(f"unknown preset {chosen!r}; choose one of {choices}{hint}")
    return chosen
