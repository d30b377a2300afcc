"""A trainable external detector: a linear scorer on a grid, in one small file."""

import io
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from curate.detections import Detections
from curate.detectors.base import Sample
from curate.errors import ModelError
from curate.files.atomic import replace_file
from curate.frames import Frame
from curate.geometry.nms import nms_bev
from support.toys import INTENSITIES, SIZES, wait_if_requested

CELL_M, CELLS, LEFT_M = 2.0, 16, -16.0
FEATURES = len(INTENSITIES) + 1
VERSION = "7"


def cell_features(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (cells, FEATURES) counts of bright points, and (cells, 2) their mean position."""
    place = np.floor((points[:, :2] - [0.0, LEFT_M]) / CELL_M).astype(np.int64)
    inside = ((place >= 0) & (place < CELLS)).all(axis=1)
    cell, points = place[inside] @ [CELLS, 1], points[inside]
    seen = np.ones((CELLS * CELLS, FEATURES), dtype=np.float32)
    bright = points[:, 3] > 0.6
    for column, intensity in enumerate(INTENSITIES.values()):
        same_intensity = cell[np.abs(points[:, 3] - intensity) < 0.01]
        seen[:, column] = np.log1p(np.bincount(same_intensity, minlength=CELLS * CELLS))
    count = np.maximum(np.bincount(cell[bright], minlength=CELLS * CELLS), 1)
    sums = [np.bincount(cell[bright], points[bright, k], CELLS * CELLS) for k in range(2)]
    return seen, np.stack(sums, axis=1) / count[:, None]


@dataclass
class GridStudent:
    """Learns which cells contain a centre; boxes have the category's size."""

    preset: str
    categories: tuple[str, ...]
    network: nn.Module

    def encode(self, samples: Sequence[Sample], device: str) -> tuple[Tensor, Tensor, Tensor]:
        """Return features, targets and weights of the cells of all samples."""
        seen, truth, weights = [], [], []
        for sample in samples:
            seen.append(cell_features(sample.points)[0])
            truth.append(np.zeros((CELLS * CELLS, len(self.categories)), dtype=np.float32))
            weights.append(np.ones_like(truth[-1]))
            place = np.floor((sample.boxes[:, :2] - [0.0, LEFT_M]) / CELL_M).astype(np.int64)
            for (i, j), name, v in zip(place, sample.categories, sample.weights, strict=True):
                if 0 <= i < CELLS and 0 <= j < CELLS:
                    here = (i * CELLS + j, self.categories.index(name))
                    truth[-1][here], weights[-1][here] = float(v > 0), v
        batch = (np.concatenate(part) for part in (seen, truth, weights))
        a, b, c = (torch.from_numpy(part).to(device) for part in batch)
        return a, b, c

    def loss(self, batch: tuple[Tensor, Tensor, Tensor], expected_objects: float) -> dict:
        """Return the cross-entropy with random dropout, as object and background terms."""
        wait_if_requested()
        seen, truth, weights = batch
        logits = self.network(functional.dropout(seen, 0.1))
        each = weights * functional.binary_cross_entropy_with_logits(
            logits, truth, reduction="none"
        )
        total = each.sum() / expected_objects
        found = (each * truth).sum() / expected_objects
        return {"loss": total, "objects": found, "background": total - found}

    def save(self, path: Path, weights: Mapping[str, Tensor]) -> None:
        """Write one file for training and inference."""
        about = json.dumps({"toy": VERSION, "preset": self.preset, "categories": self.categories})
        content = io.BytesIO()
        arrays = {name: tensor.cpu().numpy() for name, tensor in weights.items()}
        np.savez(content, about=np.array(about), **arrays)
        replace_file(path, content.getvalue())


class GridDetector:
    """See `curate.detectors.base.TrainableDetector`."""

    presets: ClassVar[Collection[str]] = ("coarse", "coarser")
    checkpoint_suffix: ClassVar[str] = ".npz"
    checkpoint_version: ClassVar[str] = VERSION

    def __init__(self, path: Path, *, minimum_score: float = 0.1) -> None:
        self.about, self.arrays = read(path)
        self.minimum_score = minimum_score

    @classmethod
    def check_checkpoint(cls, checkpoint: Path) -> None:
        """Check the file by reading it."""
        read(checkpoint)

    @classmethod
    def new_student(cls, preset: str, categories: tuple[str, ...]) -> GridStudent:
        """Return a student with random weights."""
        return GridStudent(preset, categories, nn.Linear(FEATURES, len(categories)))

    @classmethod
    def load_student(cls, checkpoint: Path) -> GridStudent:
        """Return the student of a checkpoint."""
        about, arrays = read(checkpoint)
        student = cls.new_student(about["preset"], tuple(about["categories"]))
        student.network.load_state_dict({name: torch.from_numpy(a) for name, a in arrays.items()})
        return student

    @classmethod
    def export_onnx(cls, checkpoint: Path, output: Path, _: Mapping) -> tuple[str, ...]:
        """Write the checkpoint itself."""
        output.write_bytes(checkpoint.read_bytes())
        return ("in: points", "out: boxes")

    def predict(self, frame: Frame) -> Detections:
        """Return a box per cell with a score above the threshold."""
        seen, centres = cell_features(frame.points)
        scores = 1 / (1 + np.exp(-(seen @ self.arrays["weight"].T + self.arrays["bias"])))
        found = Detections.empty()
        parts = []
        for column, name in enumerate(self.about["categories"]):
            cells = np.flatnonzero(scores[:, column] >= self.minimum_score)
            boxes = np.zeros((len(cells), 7))
            boxes[:, :2], boxes[:, 2], boxes[:, 3:6] = centres[cells], -0.8, SIZES[name]
            kept = nms_bev(boxes, scores[cells, column], 0.1)
            parts.append((boxes[kept], scores[cells[kept], column], [name] * len(kept)))
        if sum(len(part[0]) for part in parts):
            boxes, values, names = (np.concatenate([part[k] for part in parts]) for k in range(3))
            found = Detections(boxes, values.astype(np.float64), names.astype(np.str_))
        return found


def read(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """Return the metadata and the arrays of a checkpoint."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        about = json.loads(str(arrays.pop("about")))
        version = about["toy"]
    except FileNotFoundError:
        raise ModelError(f"{path}: no such checkpoint") from None
    except (OSError, ValueError, KeyError, EOFError):
        raise ModelError(f"{path}: not a checkpoint of the toy grid detector") from None
    if version != VERSION:
        raise ModelError(f"{path}: checkpoint format {version}, the toy reads {VERSION}")
    return about, arrays
