"""Cut-and-paste: objects of the labeled frames, set into other frames (SECOND, Sensors 2018).

An object keeps its distance to the sensor, so that its points stay as dense as the sensor would
have seen them, and is turned about the sensor's vertical axis to a place that is free and open to
view. There it hides what lies behind it, as it would have done.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from curate.detections import as_categories
from curate.errors import LeakageError
from curate.geometry.boxes import box_corners
from curate.geometry.overlap import bev_iou
from curate.geometry.points_in_boxes import box_of_points
from curate.geometry.similarity import Similarity
from curate.training.labels import Sample

# Tries per object that is asked for; crowded frames get fewer objects.
_TRIES = 2
# The place is hidden where scene points before it outnumber this share of the object's own points.
_HIDDEN_SHARE = 0.3
# The lowest part of an object is not looked at for that: the ground is in front of everything.
_GROUND_METRES = 0.25


@dataclass(frozen=True)
class BankObject:
    """One object: its category, its (7,) box and its (n, 4) points, where they were seen."""

    category: str
    box: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class ObjectBank:
    """The objects of the labeled frames by category.

    Attributes:
        objects: of each category, in the order of the frames.
    """

    objects: dict[str, tuple[BankObject, ...]]

    @classmethod
    def build(
        cls, samples: Iterable[Sample], categories: tuple[str, ...], fewest_points: int = 5
    ) -> Self:
        """The objects in labeled samples that have enough points to be recognised.

        Raises:
            LeakageError: a sample is not of the labeled split.
        """
        objects: dict[str, list[BankObject]] = {category: [] for category in categories}
        for sample in samples:
            if not sample.labeled:
                raise LeakageError(
                    f"object bank: frame {sample.frame_id} is not of the labeled split; "
                    "the bank is built from labeled frames only"
                )
            owner = box_of_points(sample.points, sample.boxes)
            for k in np.flatnonzero(~sample.ignored):
                points = sample.points[owner == k]
                if len(points) >= fewest_points:
                    category = str(sample.categories[k])
                    objects[category].append(BankObject(category, sample.boxes[k], points))
        return cls({category: tuple(found) for category, found in objects.items()})

    def draw(self, count: int, generator: np.random.Generator) -> list[BankObject]:
        """Up to `count` objects of each category, in random order."""
        drawn = [
            objects[i]
            for objects in self.objects.values()
            for i in generator.permutation(len(objects))[:count]
        ]
        return [drawn[i] for i in generator.permutation(len(drawn))]


def paste_objects(
    sample: Sample, bank: ObjectBank, count: int, generator: np.random.Generator
) -> Sample:
    """The sample with up to `count` more objects of each category, each with weight 1."""
    if count == 0 or len(sample.points) == 0:
        return sample
    scene = _Scene(sample.points)
    placed = [
        _turned(found, scene.azimuths, generator) for found in bank.draw(_TRIES * count, generator)
    ]
    free = _free(placed, sample.boxes)
    wanted = dict.fromkeys(bank.objects, count)
    accepted: list[BankObject] = []
    for k in free:
        candidate = placed[k]
        if not wanted[candidate.category] or _overlaps(candidate, accepted):
            continue
        if scene.insert(candidate):
            accepted.append(candidate)
            wanted[candidate.category] -= 1
    if not accepted:
        return sample
    return replace(
        sample,
        points=np.concatenate([scene.left(), *(found.points for found in accepted)]),
        boxes=np.concatenate([sample.boxes, np.stack([found.box for found in accepted])]),
        categories=as_categories(
            [*sample.categories.tolist(), *(found.category for found in accepted)]
        ),
        weights=np.concatenate([sample.weights, np.ones(len(accepted))]),
    )


class _Scene:
    """The points of a frame as the sensor sees them; pasted objects take points away."""

    def __init__(self, points: np.ndarray) -> None:
        self._points = points
        self._azimuth = np.arctan2(points[:, 1], points[:, 0])
        self._distance = np.hypot(points[:, 0], points[:, 1])
        self._slope = points[:, 2] / np.maximum(self._distance, 1e-3)
        self._kept = np.ones(len(points), dtype=bool)
        self.azimuths = (float(self._azimuth.min()), float(self._azimuth.max()))

    def insert(self, candidate: BankObject) -> bool:
        """Makes room for the object, unless its place is hidden from the sensor."""
        corners = box_corners(candidate.box[None])[0]
        azimuth = np.arctan2(corners[:, 1], corners[:, 0])
        distance = np.hypot(corners[:, 0], corners[:, 1])
        slope = corners[:, 2] / np.maximum(distance, 1e-3)
        low, high = azimuth.min(), azimuth.max()
        if low < self.azimuths[0] or high > self.azimuths[1]:
            return False
        behind_its_outline = np.flatnonzero(
            (self._azimuth >= low)
            & (self._azimuth <= high)
            & (self._slope >= slope.min())
            & (self._slope <= slope.max())
            & self._kept
        )
        before = self._distance[behind_its_outline] < distance.min()
        above_ground = (candidate.box[2] - candidate.box[5] / 2 + _GROUND_METRES) / distance.min()
        hiding = before & (self._slope[behind_its_outline] > above_ground)
        if np.count_nonzero(hiding) > _HIDDEN_SHARE * len(candidate.points):
            return False
        self._kept[behind_its_outline[~before]] = False
        return True

    def left(self) -> np.ndarray:
        """The points that no pasted object has taken the place of or hidden."""
        return self._points[self._kept]


def _turned(
    found: BankObject, azimuths: tuple[float, float], generator: np.random.Generator
) -> BankObject:
    """The object at a random azimuth of the view, mirrored or not."""
    mirror = bool(generator.random() < 0.5)
    now = np.arctan2(found.box[1], found.box[0]) * (-1 if mirror else 1)
    turn = Similarity(mirror, float(generator.uniform(*azimuths) - now))
    return replace(
        found,
        box=turn.apply_to_boxes(found.box[None])[0],
        points=turn.apply_to_points(found.points),
    )


def _free(placed: list[BankObject], boxes: np.ndarray) -> np.ndarray:
    """Indices of the objects that overlap none of the boxes."""
    if not placed:
        return np.zeros(0, dtype=np.int64)
    overlap = bev_iou(np.stack([found.box for found in placed]), boxes)
    return np.flatnonzero(~(overlap > 0).any(axis=1))


def _overlaps(candidate: BankObject, accepted: list[BankObject]) -> bool:
    if not accepted:
        return False
    others = np.stack([found.box for found in accepted])
    return bool((bev_iou(candidate.box[None], others) > 0).any())
