"""Exported labels as a torch dataset, for this project's trainer or anyone else's.

Needs the exported file and the frames it names, nothing else of this project's machinery:

    labels = WeightedLabels(Path("labels.sqlite"))
    for sample in labels:
        loss = sum(sample.weights * my_loss(sample.points, sample.boxes, sample.categories))
"""

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from torch.utils.data import Dataset

from curate.detections import as_categories
from curate.detectors.base import Sample
from curate.errors import DataError
from curate.exporters.label_file import (
    check_leakage,
    open_label_file,
    read_categories,
    read_meta,
    read_zero_weight,
)
from curate.frames import Frame
from curate.geometry.projection import in_view

# Ground truth that looks like a category without being one: neither object nor background of it.
NEIGHBOURS: Final = {"Van": "Car", "Person_sitting": "Pedestrian"}


class WeightedLabels(Dataset[Sample]):
    """The frames of an exported label file with their boxes and weights, in the order of frames.

    Args:
        path: the SQLite file.
        read: gives the frame of an id; by default the frames of the data set that the file names,
            in KITTI's layout below its root.
        root: where that data set lies now, if it has moved since the export.

    Raises:
        DataError: the file is missing, damaged, or no label file of this version.
        LeakageError: it holds ground truth of frames that are not labeled.
    """

    def __init__(
        self,
        path: Path,
        *,
        read: Callable[[str], Frame] | None = None,
        root: Path | None = None,
    ) -> None:
        with open_label_file(path) as rows:
            self._load(rows, path)
        self._read = read or _kitti_reader(root or Path(self.meta["root"]))

    def _load(self, rows: sqlite3.Connection, path: Path) -> None:
        self.meta = read_meta(rows, path)
        check_leakage(rows, path)
        self.categories = read_categories(self.meta, path)
        self.zero_weight = read_zero_weight(self.meta, path)
        frames = rows.execute("SELECT frame, split FROM frame ORDER BY frame").fetchall()
        self.frame_ids: tuple[str, ...] = tuple(frame for frame, _ in frames)
        self.labeled = np.array([split == "labeled" for _, split in frames], dtype=bool)
        self._boxes = dict.fromkeys(self.frame_ids, _NO_BOXES)
        # What a person rejected is background, also where a weight of 0 is to be ignored.
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
        """Reads the frame's points.

        Raises:
            DataError: the frame cannot be read.
        """
        frame_id = self.frame_ids[index]
        frame = self._read(frame_id)
        seen = in_view(frame.points, frame.calibration, frame.image_size)
        boxes, categories, weights = self._boxes[frame_id]
        labeled = bool(self.labeled[index])
        points = frame.points[seen]
        return Sample(frame_id, labeled, points, boxes, categories, weights, self.zero_weight)


_NO_BOXES = (np.zeros((0, 7)), as_categories([]), np.zeros(0))


def _group(
    path: Path, rows: list[tuple], known: tuple[str, ...]
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Boxes, categories and weights of each frame; unknown categories are left out.

    Raises:
        DataError: a box is not finite, or a weight not in [0, 1].
    """
    by_frame: dict[str, list[tuple]] = {}
    for frame, category, *numbers in rows:
        neighbour = NEIGHBOURS.get(category) if category not in known else None
        if neighbour in known:
            by_frame.setdefault(frame, []).append((neighbour, *numbers[:-1], 0.0))
        elif category in known:
            by_frame.setdefault(frame, []).append((category, *numbers))
    grouped = {}
    for frame, entries in by_frame.items():
        numbers_of = _numbers(path, frame, [entry[1:] for entry in entries])
        names = as_categories([entry[0] for entry in entries])
        grouped[frame] = (numbers_of[:, :7], names, numbers_of[:, 7])
    return grouped


def _numbers(path: Path, frame: str, entries: list[tuple]) -> np.ndarray:
    """(m, 8) boxes and weights; a damaged file may hold anything in their place."""
    try:
        numbers = np.array(entries, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.full((len(entries), 8), np.nan)
    if not np.isfinite(numbers).all() or not ((numbers[:, 7] >= 0) & (numbers[:, 7] <= 1)).all():
        raise DataError(
            f"{path}: frame {frame!r} has a box that is not finite or a weight that is not in "
            "[0, 1]; delete it and export it again"
        )
    return numbers


def _kitti_reader(root: Path) -> Callable[[str], Frame]:
    from curate.datasets.kitti.dataset import KittiDataset

    return KittiDataset(root).read
