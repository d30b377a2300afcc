"""A toy world for pipeline tests: small frames in KITTI's layout and a simple detector."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from curate.datasets.kitti.calibration import write_calibration
from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.labels import from_annotations, write_objects
from curate.detections import Annotations, Detections
from curate.errors import CurateError, DataError
from curate.frames import Calibration, Frame
from curate.priors.base import (
    Column,
    Evidence,
    EvidenceSource,
    Measured,
    SequenceFrame,
    SequenceSource,
)
from curate.segmenters.base import SemanticMap

IMAGE_SIZE = (120, 40)
SIZES = {"Car": (4.0, 1.8, 1.6), "Pedestrian": (0.8, 0.6, 1.7), "Cyclist": (1.8, 0.6, 1.7)}
# The toy detector recognises a category by the brightness of its points.
INTENSITIES = {"Car": 0.9, "Pedestrian": 0.8, "Cyclist": 0.7}


def toy_calibration() -> Calibration:
    """Return the calibration of a camera at the LiDAR's origin that looks along x."""
    projection = np.array([[60.0, 0, 60, 0], [0, 60, 20, 0], [0, 0, 1, 0]])
    lidar_to_camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    return Calibration(projection, lidar_to_camera)


def empty_frame(name: str) -> Frame:
    """Return a frame with a name and nothing else."""
    return Frame(name, np.zeros((0, 4), np.float32), toy_calibration(), IMAGE_SIZE)


def write_toy_kitti(root: Path, frames: int, val: int = 0, *, labels: bool = True) -> None:
    """Write frames 000000.. with one object per category, each a cloud of equally bright points."""
    for folder in ("velodyne", "image_2", "calib", "label_2"):
        (root / "training" / folder).mkdir(parents=True, exist_ok=True)
    names = [f"{i:06d}" for i in range(frames)]
    for i, name in enumerate(names):
        _write_frame(root / "training", name, np.random.default_rng(i), labels=labels)
    (root / "ImageSets").mkdir(exist_ok=True)
    (root / "ImageSets" / "train.txt").write_text("\n".join(names[: frames - val]) + "\n")
    (root / "ImageSets" / "val.txt").write_text("\n".join(names[frames - val :]) + "\n")


def toy_document(root: Path, weights_file: Path) -> dict:
    """Return the settings of a toy workspace."""
    return {
        "dataset": {"root": root},
        "detector": {"name": "support.toys:ToyDetector", "path": weights_file},
        "segmenter": {"name": "support.toys:ToySegmenter", "path": weights_file},
    }


def _write_frame(folder: Path, name: str, rng: np.random.Generator, *, labels: bool) -> None:
    import cv2

    categories = np.array(list(SIZES))
    boxes = np.array([
        [rng.uniform(8, 25), rng.uniform(-4, 4), -0.8, *SIZES[c], rng.uniform(-3, 3)]
        for c in categories
    ])  # fmt: skip
    boxes[:, 1] += np.array([-6, 0, 6])
    ground = rng.uniform([2, -20, -1.7, 0], [40, 20, -1.7, 0.5], (400, 4))
    points = [ground]
    for box, category in zip(boxes, categories, strict=True):
        inside = rng.uniform(-0.45, 0.45, (int(rng.integers(20, 60)), 3)) * box[3:6]
        turn = np.array([[np.cos(box[6]), np.sin(box[6])], [-np.sin(box[6]), np.cos(box[6])]])
        inside[:, :2] = inside[:, :2] @ turn
        brightness = np.full(len(inside), INTENSITIES[category])
        points.append(np.column_stack([inside + box[:3], brightness]))
    np.concatenate(points).astype(np.float32).tofile(folder / "velodyne" / f"{name}.bin")
    image = rng.integers(0, 255, (IMAGE_SIZE[1], IMAGE_SIZE[0], 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "image_2" / f"{name}.png"), image)
    write_calibration(folder / "calib" / f"{name}.txt", toy_calibration())
    if labels:
        nothing = np.zeros(3)
        truth = Annotations(
            boxes, categories, nothing, nothing.astype(np.int64), nothing,
            np.tile([0.0, 0, 100, 39], (3, 1)),
        )  # fmt: skip
        write_objects(
            folder / "label_2" / f"{name}.txt", from_annotations(truth, toy_calibration())
        )


def wait_if_requested() -> None:
    """Let a test stop the process during its work, or make it wait at a gate, which is a file.

    A process that has reached the gate writes another file beside it, named by its number.
    """
    time.sleep(float(os.environ.get("TOY_DELAY_S", "0")))
    gate = Path(os.environ.get("TOY_GATE", "/no gate"))
    while gate.exists():
        arrival(gate, os.getpid()).touch()
        time.sleep(0.02)


def arrival(gate: Path, process: int) -> Path:
    """Return the file that a process writes at a gate."""
    return gate.with_name(f"{gate.name}-{process}")


class ToyDetector:
    """Find the bright clouds; the score is the share of 60 points that it saw.

    Args:
        path: a file; a frame whose name is in it raises.
    """

    def __init__(self, path: Path) -> None:
        self.poison = set(Path(path).read_text().split())

    def predict(self, frame: Frame) -> Detections:
        """Return one box per category."""
        wait_if_requested()
        if frame.frame_id in self.poison:
            raise RuntimeError("CUDA error: an illegal memory access\nwas encountered")
        found = []
        for category, intensity in INTENSITIES.items():
            cloud = frame.points[np.abs(frame.points[:, 3] - intensity) < 0.01, :3]
            if len(cloud):
                found.append((category, min(len(cloud) / 60, 1.0), cloud.mean(axis=0)))
        boxes = [[*centre, *SIZES[category], 0.0] for category, _, centre in found]
        return Detections(
            np.array(boxes, dtype=np.float64).reshape(-1, 7),
            np.array([score for _, score, _ in found], dtype=np.float64),
            np.array([category for category, _, _ in found], dtype=np.str_),
        )


class ToyBatchDetector(ToyDetector):
    """The same detector for batches; a frame that raises spoils its batch."""

    @classmethod
    def batch_size(cls, device: str) -> int:
        """Return how many frames it prefers."""
        return 5

    def predict_batch(self, frames: Sequence[Frame]) -> list[Detections | CurateError]:
        """Return the boxes of each frame; a frame with no points has an error of its own."""
        found = [self.predict(frame) for frame in frames]
        return [
            each if len(frame.points) else DataError(f"frame {frame.frame_id}: no points")
            for frame, each in zip(frames, found, strict=True)
        ]


class RayDetector(ToyDetector):
    """The toy detector with headings along the ray from the sensor: they turn with the cloud."""

    def predict(self, frame: Frame) -> Detections:
        """Return one box per category."""
        found = super().predict(frame)
        found.boxes[:, 6] = np.arctan2(found.boxes[:, 1], found.boxes[:, 0])
        return found


class ToySegmenter:
    """Segment the left half of every image as car and the right half as person."""

    needs_image = True

    def __init__(self, path: Path) -> None:
        self.path = path

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the semantic map."""
        wait_if_requested()
        width, height = frame.image_size
        class_ids = np.ones((height, width), dtype=np.uint8)
        class_ids[:, width // 2 :] = 2
        return SemanticMap(class_ids, {"Car": (1,), "Pedestrian": (2,), "Cyclist": (1, 2)})


class ToyImageSegmenter(ToySegmenter):
    """Segment the bright pixels as car and the others as person; each call adds a line to a file.

    Args:
        path: a file; beside it, the calls are counted.
        bright: the lowest red value of a bright pixel.
        seen: the calls are counted in a file of this name.
    """

    map_version = 1

    def __init__(self, path: Path, *, bright: int = 128, seen: str = "segmented.txt") -> None:
        super().__init__(path)
        self.bright = bright
        self.seen = path.with_name(seen)

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the semantic map."""
        found = super().segment(frame)
        with self.seen.open("a") as file:
            file.write(f"{frame.frame_id}\n")
        class_ids = np.where(frame.image[..., 0] >= self.bright, np.uint8(1), np.uint8(2))
        return SemanticMap(class_ids, found.category_classes)


@dataclass(frozen=True)
class ToyPrior(EvidenceSource):
    """A user-supplied prior: an integer and a real number are measured."""

    plenty: float = 12.0
    name: ClassVar[str] = "toy"
    columns: ClassVar[tuple[Column, ...]] = (
        Column("near_points", "int32", "1", "LiDAR points within 5 m of the centre"),
        Column("nearest", "float64", "m", "distance of the nearest LiDAR point", optional=True),
        Column("rho_toy", "float64", "1", "toy prior: near_points / plenty, at most 1"),
    )
    rho_column: ClassVar[str | None] = "rho_toy"
    measured_columns: ClassVar[tuple[str, ...]] = ("near_points", "nearest")

    def measure(self, frame: Frame, detections: Detections) -> Measured:
        """Return distances from the centres."""
        centres = detections.boxes[:, None, :3]
        apart = np.linalg.norm(frame.points[None, :, :3] - centres, axis=-1)
        nearest = apart.min(axis=1, initial=np.inf)
        return {
            "near_points": (apart < 5).sum(axis=1),
            "nearest": np.where(np.isfinite(nearest), nearest, np.nan),
        }

    def rate(self, detections: Detections, measured: Measured) -> Evidence:
        """Return the trust from the measured count."""
        rho = np.minimum(np.asarray(measured["near_points"]) / self.plenty, 1.0)
        return {**measured, "rho_toy": rho}


class ToyPriorAgain(ToyPrior):
    """Another class with the same name."""


class ToyTracks(SequenceSource):
    """A user-supplied source that counts how often a category occurs in the whole sequence."""

    name: ClassVar[str] = "toy_tracks"
    columns: ClassVar[tuple[Column, ...]] = (
        Column("occurrences", "int64", "1", "labels of the category in the sequence"),
        Column("first_frame", "name", "", "first frame of the sequence"),
    )

    def score_sequence(self, frames: Sequence[SequenceFrame]) -> Sequence[Evidence]:
        """Count over all frames."""
        names = np.concatenate([frame.detections.categories for frame in frames])
        return [
            {
                "occurrences": np.array([(names == each).sum() for each in found.categories]),
                "first_frame": np.full(len(found), frames[0].frame_id),
            }
            for found in (frame.detections for frame in frames)
        ]


class ToySequences(KittiDataset):
    """A KITTI dataset in which three neighbouring frames are a sequence."""

    @staticmethod
    def sequence_name(frame_id: str) -> str:
        """Return the sequence of a frame."""
        return f"drive-{int(frame_id) // 3:04d}"

    def sequence_of(self, frame_id: str) -> str:
        """See `curate.datasets.base.Sequenced`."""
        return self.sequence_name(frame_id)
