"""Exported labels as a torch dataset, for this project's trainer or any other one.

It needs only the exported file and the frames that the file lists, no workspace:

    labels = WeightedLabels("labels.sqlite")
    for batch in DataLoader(labels, batch_size=4, collate_fn=labels.collate):
        loss = (batch.weights * my_loss_per_box(my_network, batch)).sum()
"""

import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final, Self

import numpy as np
import torch
from torch.utils.data import Dataset

from curate.detections import as_categories
from curate.detectors.base import IgnoredRegions, Sample
from curate.errors import DataError
from curate.exporters.label_file import (
    check_leakage,
    open_label_file,
    read_categories,
    read_meta,
    read_zero_weight,
)
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.geometry.projection import in_camera_view
from curate.shapes import Bool, Float, Int

# Ground-truth categories that look like another one: an ignore region for that category.
NEIGHBOURS: Final = {"Van": "Car", "Person_sitting": "Pedestrian"}


@dataclass(frozen=True)
class LabelBatch:
    """Several frames with their boxes as tensors, from `WeightedLabels.collate`.

    The p points and n boxes of all frames are concatenated; `point_frames` and `box_frames` give
    the frame of each within the batch. Boxes of weight 0 that count as background are left out, so
    a weight of 0 marks a region to ignore: multiply the loss of every box by its weight.

    Attributes:
        frame_ids: ids of the b frames.
        labeled: (b,) bool, true if a frame's boxes are ground truth (X_l), false if they are
            pseudo-labels (X_u).
        points: (p, 4) float32 x, y, z in metres in the LiDAR frame, and intensity in [0, 1].
        point_frames: (p,) int64 frame of each point, in [0, b).
        boxes: (n, 7) float32 x, y, z, length, width, height in metres and yaw in radians, at the
            box centre in the LiDAR frame.
        box_frames: (n,) int64 frame of each box, in [0, b).
        categories: (n,) int64 index into `WeightedLabels.categories`.
        weights: (n,) float32 v in [0, 1]; 1 for ground truth.
    """

    frame_ids: tuple[str, ...]
    labeled: Bool[torch.Tensor, " b"]
    points: Float[torch.Tensor, "p 4"]
    point_frames: Int[torch.Tensor, " p"]
    boxes: Float[torch.Tensor, "n 7"]
    box_frames: Int[torch.Tensor, " n"]
    categories: Int[torch.Tensor, " n"]
    weights: Float[torch.Tensor, " n"]

    def to(self, device: torch.device | str) -> Self:
        """Return the batch with its tensors on a device."""
        _, *tensors = (getattr(self, each.name) for each in fields(self))
        return type(self)(self.frame_ids, *(tensor.to(device) for tensor in tensors))


class WeightedLabels(Dataset[Sample]):
    """The frames of an exported label file with their boxes and weights, sorted by frame id.

    A torch `Dataset` of `Sample`. Source of the weights: An et al., Remote Sensing 15(3):627, 2023,
    Eqs. 6 and 10: v multiplies an object's classification and box loss.

    Args:
        path: path of the SQLite file.
        read: returns the frame of a frame id; by default reads KITTI's layout below the root of the
            data set that the file specifies.
        root: current root of that data set, if it has moved since the export.
        regions: regions of unlabeled frames to ignore, such as proposals for missed objects.

    Raises:
        DataError: if the file is missing, damaged, or not a label file of this version.
        LeakageError: if it contains ground truth of frames that are not labeled.
    """

    def __init__(
        self,
        path: StrPath,
        *,
        read: Callable[[str], Frame] | None = None,
        root: StrPath | None = None,
        regions: IgnoredRegions | None = None,
    ) -> None:
        path = Path(path)
        with open_label_file(path) as rows:
            self._load(rows, path)
        self._regions = dict(regions or {})
        self._read = read or _kitti_reader(root or self.meta["root"])

    def _load(self, rows: sqlite3.Connection, path: Path) -> None:
        self.meta = read_meta(rows, path)
        check_leakage(rows, path)
        self.categories = read_categories(self.meta, path)
        self.zero_weight = read_zero_weight(self.meta, path)
        frames = rows.execute("SELECT frame, split FROM frame ORDER BY frame").fetchall()
        self.frame_ids: tuple[str, ...] = tuple(frame for frame, _ in frames)
        self.labeled = np.array([split == "labeled" for _, split in frames], dtype=bool)
        self._boxes = dict.fromkeys(self.frame_ids, _NO_BOXES)
        # A label that a person rejected is background, even if weight 0 otherwise means ignore.
        rejected = "provenance IS 'human' AND weight IS 0"
        rejected = rejected if self.zero_weight == "ignore" else "false"
        for table, weight, left_out in (
            ("ground_truth", "1.0", "0"),
            ("label", "weight", rejected),
        ):
            query = (
                "SELECT frame, category, x, y, z, length, width, height, yaw, "  # noqa: S608
                f"{weight} FROM {table} WHERE NOT ({left_out}) ORDER BY frame, k"
            )
            self._boxes.update(_group(path, rows.execute(query).fetchall(), self.categories))

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __getitem__(self, index: int) -> Sample:
        """Return a frame with its labels and its points in the camera's view.

        Raises:
            DataError: if the frame cannot be read.
        """
        frame_id = self.frame_ids[index]
        frame = self._read(frame_id)
        boxes, categories, weights = self._boxes[frame_id]
        labeled = bool(self.labeled[index])
        points = frame.points[in_camera_view(frame)]
        sample = Sample(frame_id, labeled, points, boxes, categories, weights, self.zero_weight)
        return sample if labeled else _with_regions(sample, self._regions, self.categories)

    def collate(self, samples: Sequence[Sample]) -> LabelBatch:
        """Return samples as one batch of tensors: `DataLoader(..., collate_fn=labels.collate)`."""
        boxes, weights = [], []
        for sample in samples:
            kept = (sample.weights > 0) | sample.ignored
            categories = [self.categories.index(name) for name in sample.categories[kept].tolist()]
            boxes.append(np.column_stack([sample.boxes[kept], categories]))
            weights.append(sample.weights[kept])
        numbers = torch.from_numpy(np.concatenate(boxes))
        return LabelBatch(
            frame_ids=tuple(sample.frame_id for sample in samples),
            labeled=torch.tensor([sample.labeled for sample in samples]),
            points=torch.from_numpy(np.concatenate([sample.points for sample in samples])),
            point_frames=_frame_numbers([len(sample.points) for sample in samples]),
            boxes=numbers[:, :7].float(),
            box_frames=_frame_numbers([len(of_frame) for of_frame in weights]),
            categories=numbers[:, 7].long(),
            weights=torch.from_numpy(np.concatenate(weights)).float(),
        )


def _with_regions(sample: Sample, regions: IgnoredRegions, categories: Sequence[str]) -> Sample:
    """Return the sample with the regions of its frame, boxes of weight 0."""
    if sample.frame_id not in regions:
        return sample
    boxes, names = regions[sample.frame_id]
    known = np.isin(names, categories)
    count = int(known.sum())
    return replace(
        sample,
        boxes=np.concatenate([sample.boxes, boxes[known]]),
        categories=np.concatenate([sample.categories, names[known]]),
        weights=np.concatenate([sample.weights, np.zeros(count)]),
        regions=np.repeat([False, True], [len(sample.boxes), count]),
    )


def _frame_numbers(counts: Sequence[int]) -> torch.Tensor:
    """Return (sum of counts,) the frame of each row, as its number within the batch."""
    return torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))


_NO_BOXES = (np.zeros((0, 7)), as_categories([]), np.zeros(0))


def _group(
    path: Path, rows: list[tuple], categories: tuple[str, ...]
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return boxes, categories and weights of each frame; other categories are left out.

    A box of a neighbour category becomes an ignore region of the category that it looks like.

    Raises:
        DataError: if a box is not finite, or a weight is not in [0, 1].
    """
    by_frame: dict[str, list[tuple]] = {}
    for frame, category, *numbers in rows:
        similar = NEIGHBOURS.get(category) if category not in categories else None
        if similar in categories:
            by_frame.setdefault(frame, []).append((similar, *numbers[:-1], 0.0))
        elif category in categories:
            by_frame.setdefault(frame, []).append((category, *numbers))
    grouped = {}
    for frame, entries in by_frame.items():
        box_and_weight = _numbers(path, frame, [entry[1:] for entry in entries])
        names = as_categories([entry[0] for entry in entries])
        grouped[frame] = (box_and_weight[:, :7], names, box_and_weight[:, 7])
    return grouped


def _numbers(path: Path, frame: str, entries: list[tuple]) -> np.ndarray:
    """Return (m, 8) boxes and weights; raise DataError for the values of a damaged file."""
    try:
        numbers = np.array(entries, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.full((len(entries), 8), np.nan)
    if not np.isfinite(numbers).all() or not ((numbers[:, 7] >= 0) & (numbers[:, 7] <= 1)).all():
        raise DataError(
            f"{path}: frame {frame!r} has a box that is not finite or a weight that is not in "
            "[0, 1]; delete the file and export it again"
        )
    return numbers


def _kitti_reader(root: StrPath) -> Callable[[str], Frame]:
    from curate.datasets.kitti.dataset import KittiDataset

    return KittiDataset(root).read
