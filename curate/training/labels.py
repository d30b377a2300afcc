"""Exported labels as a torch dataset, for this project's trainer or anyone else's.

Needs the exported file and the frames it names, nothing else of this project's machinery:

    labels = WeightedLabels(Path("labels.sqlite"))
    for sample in labels:
        loss = sum(sample.weights * my_loss(sample.points, sample.boxes, sample.categories))
"""

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from torch.utils.data import Dataset

from curate.detections import as_categories
from curate.errors import DataError
from curate.exporters.sqlite import FORMAT_VERSION, refuse_leakage
from curate.frames import Frame
from curate.geometry.ground import GroundMap
from curate.geometry.projection import in_view

# Ground truth that looks like a category without being one: neither object nor background of it.
NEIGHBOURS: Final = {"Van": "Car", "Person_sitting": "Pedestrian"}


@dataclass(frozen=True)
class Sample:
    """One frame to learn from.

    Attributes:
        frame_id: name of the frame.
        labeled: whether the boxes are ground truth (X_l) or pseudo-labels (X_u).
        points: (n, 4) float32 inside the camera's view, LiDAR frame.
        boxes: (m, 7) in the LiDAR frame.
        categories: (m,) str.
        weights: (m,) v in [0, 1]: 1 for ground truth. 0 is an ignore region, neither object nor
            background.
    """

    frame_id: str
    labeled: bool
    points: np.ndarray
    boxes: np.ndarray
    categories: np.ndarray
    weights: np.ndarray

    @property
    def ignored(self) -> np.ndarray:
        """(m,) bool, which boxes are ignore regions."""
        return np.asarray(self.weights == 0)

    @cached_property
    def ground(self) -> GroundMap:
        """The height of the ground; a training asks for it in every pass."""
        return GroundMap.of(self.points)


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
        if not path.is_file():
            raise DataError(f"{path}: no such label file; export the labels first")
        try:
            with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as rows:
                self._load(rows, path)
        except sqlite3.DatabaseError as error:
            raise DataError(f"{path}: not a label file: {error}; export it again") from None
        self._read = read or _kitti_reader(root or Path(self.meta["root"]))

    def _load(self, rows: sqlite3.Connection, path: Path) -> None:
        self.meta = dict(rows.execute("SELECT key, value FROM meta"))
        version = self.meta.get("format_version")
        if version != str(FORMAT_VERSION):
            raise DataError(
                f"{path}: label format {version}, this version reads {FORMAT_VERSION}; export again"
            )
        refuse_leakage(rows, path)
        self.categories: tuple[str, ...] = tuple(json.loads(self.meta["categories"]))
        frames = rows.execute("SELECT frame, split FROM frame ORDER BY frame").fetchall()
        self.frame_ids: tuple[str, ...] = tuple(frame for frame, _ in frames)
        self.labeled = np.array([split == "labeled" for _, split in frames], dtype=bool)
        self._boxes = dict.fromkeys(self.frame_ids, _NO_BOXES)
        for table, weight in (("ground_truth", "1.0"), ("weighted_labels", "weight")):
            query = (
                "SELECT frame, category, x, y, z, length, width, height, yaw, "  # noqa: S608
                f"{weight} FROM {table} ORDER BY frame, k"
            )
            self._boxes.update(_group(rows.execute(query).fetchall(), self.categories))

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
        return Sample(frame_id, labeled, frame.points[seen], boxes, categories, weights)


_NO_BOXES = (np.zeros((0, 7)), as_categories([]), np.zeros(0))


def _group(
    rows: list[tuple], known: tuple[str, ...]
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Boxes, categories and weights of each frame; unknown categories are left out."""
    by_frame: dict[str, list[tuple]] = {}
    for frame, category, *numbers in rows:
        neighbour = NEIGHBOURS.get(category) if category not in known else None
        if neighbour in known:
            by_frame.setdefault(frame, []).append((neighbour, *numbers[:-1], 0.0))
        elif category in known:
            by_frame.setdefault(frame, []).append((category, *numbers))
    grouped = {}
    for frame, entries in by_frame.items():
        numbers_of = np.array([entry[1:] for entry in entries], dtype=np.float64)
        names = as_categories([entry[0] for entry in entries])
        grouped[frame] = (numbers_of[:, :7], names, numbers_of[:, 7])
    return grouped


def _kitti_reader(root: Path) -> Callable[[str], Frame]:
    from curate.datasets.kitti import KittiDataset

    return KittiDataset(root).read
