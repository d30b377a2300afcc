"""Frames as tools without images write them: labels with zeros for everything in the image."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from curate.datasets.kitti.calibration import write_calibration
from curate.datasets.kitti.labels import from_detections, write_objects
from curate.detections import Detections
from curate.frames import Calibration
from support.toys import SIZES, toy_calibration

IMAGE_SIZE = (1200, 400)
POINTS = {"Car": 8, "Pedestrian": 3, "Cyclist": 0}
"""LiDAR points in each object, by category."""


@dataclass(frozen=True)
class LidarOnly:
    """A data set in KITTI's layout, and results that are right.

    Attributes:
        root: the data set.
        results: folder of KITTI result files.
        frames: number of frames; each has one object per category.
    """

    root: Path
    results: Path
    frames: int

    @property
    def labels(self) -> Path:
        """The folder of label files."""
        return self.root / "training" / "label_2"

    def rewrite_labels(self, old: str, new: str) -> None:
        """Replace a text in every label file."""
        for path in self.labels.iterdir():
            path.write_text(path.read_text().replace(old, new))

    def alone(self, folder: Path) -> Path:
        """Move the labels into a folder without anything beside it, and return it."""
        folder.mkdir(parents=True)
        return self.labels.rename(folder / "gt")


def sharp_calibration() -> Calibration:
    """Return a calibration with which every object is higher than 25 pixels."""
    calibration = toy_calibration()
    return replace(calibration, projection=np.diag([10.0, 10.0, 1.0]) @ calibration.projection)


def write_lidar_only(folder: Path, frames: int = 6) -> LidarOnly:
    """Write the frames, and results with correct boxes and scores from 0.9 down."""
    made = LidarOnly(folder / "kitti", folder / "results", frames)
    training = made.root / "training"
    for name in ("velodyne", "image_2", "calib", "label_2"):
        (training / name).mkdir(parents=True)
    made.results.mkdir()
    calibration = sharp_calibration()
    for i in range(frames):
        name, boxes = f"{i:06d}", _boxes(i)
        found = Detections(boxes, np.array([0.9, 0.8, 0.7]), np.array(list(SIZES)))
        objects = from_detections(found, calibration, IMAGE_SIZE)
        write_objects(made.results / f"{name}.txt", objects)
        lines = []
        for row, category in enumerate(SIZES):
            shape = (*objects.dimensions[row], *objects.locations[row], objects.rotations_y[row])
            numbers = " ".join(f"{number:.4f}" for number in shape)
            lines.append(f"{category} 0 0 0 0 0 0 0 {numbers}\n")
        (training / "label_2" / f"{name}.txt").write_text("".join(lines))
        write_calibration(training / "calib" / f"{name}.txt", calibration)
        image = np.zeros((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), dtype=np.uint8)
        cv2.imwrite(str(training / "image_2" / f"{name}.png"), image)
        inside = np.repeat(boxes[:, :3], list(POINTS.values()), axis=0)
        ground = np.array([[5.0, y, -1.7] for y in range(-20, 20)])
        points = np.concatenate([inside, ground])
        points = np.column_stack([points, np.full(len(points), 0.5)]).astype(np.float32)
        points.tofile(training / "velodyne" / f"{name}.bin")
    return made


def _boxes(i: int) -> np.ndarray:
    """Return the boxes of frame i; the car moves away from 12 m by 5 m per frame."""
    places = ((12.0 + 5 * i, 3.0), (9.0, -2.5), (15.0, 0.0))
    return np.array(
        [[x, y, -0.8, *size, 0.3 + i] for (x, y), size in zip(places, SIZES.values(), strict=True)]
    )
