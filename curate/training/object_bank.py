"""Cut-and-paste: objects of the labeled frames, set into other frames (SECOND, Sensors 2018).

An object keeps its distance to the sensor, so that its points stay as dense as the sensor would
have seen them, and is turned about the sensor's vertical axis to a place that is open to view and
free: no box overlaps it, also none of weight 0, and no point lies in it but of the ground. There it
stands on the ground as it stood before, and hides what lies behind it.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from curate.detections import as_categories
from curate.detectors.base import Sample
from curate.errors import LeakageError
from curate.geometry.boxes import box_corners
from curate.geometry.overlap import bev_iou
from curate.geometry.points_in_boxes import box_of_points, count_points_in_boxes
from curate.geometry.similarity import Similarity
from curate.shapes import Float, Float32

# Tries per object that is asked for; crowded frames get fewer objects.
_TRIES = 2
# The place is hidden where scene points before it outnumber this share of the object's own points.
_HIDDEN_SHARE = 0.3
# The lowest part of an object is not looked at: ground is before everything and in every place.
_GROUND_METRES = 0.25
# A place this much higher or lower than where the object stood is a roof or a wall, not ground.
_HIGHEST_STEP_METRES = 0.7


@dataclass(frozen=True)
class BankObject:
    """One object: its category, its (7,) box and its (n, 4) points, where they were seen."""

    category: str
    box: Float[np.ndarray, " 7"]
    points: Float32[np.ndarray, "n 4"]


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
        """Return the objects in labeled samples that have enough points to be recognised.

        Raises:
            LeakageError: if a sample is not of the labeled split.
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
    """Return the sample with up to `count` more objects of each category, each with weight 1."""
    drawn = bank.draw(_TRIES * count, generator)
    if not drawn or len(sample.points) == 0:
        return sample
    scene = _Scene(sample.points)
    turns = _turns(drawn, scene.azimuths, generator)
    boxes = np.concatenate(
        [turn.apply_to_boxes(found.box[None]) for turn, found in zip(turns, drawn, strict=True)]
    )
    lifts = sample.ground.at(boxes[:, :2]) - (boxes[:, 2] - boxes[:, 5] / 2)
    lifts = np.where(np.isnan(lifts), 0.0, lifts)
    boxes[:, 2] += lifts
    outlines = _Outlines.of(boxes)
    blocked = np.any(bev_iou(boxes, sample.boxes) > 0, axis=1)
    blocked |= np.abs(lifts) > _HIGHEST_STEP_METRES
    blocked |= _occupied(boxes, sample.points)
    meets = np.greater(bev_iou(boxes, boxes), 0)
    wanted = dict.fromkeys(bank.objects, count)
    accepted: list[int] = []
    for k, found in enumerate(drawn):
        if blocked[k] or not wanted[found.category]:
            continue
        points = _lifted(turns[k].apply_to_points(found.points), lifts[k])
        if scene.insert(outlines, k, points):
            accepted.append(k)
            blocked |= meets[k]
            wanted[found.category] -= 1
    names = [drawn[k].category for k in accepted]
    return replace(
        sample,
        points=scene.left(),
        boxes=np.concatenate([sample.boxes, boxes[accepted]]),
        categories=as_categories([*sample.categories.tolist(), *names]),
        weights=np.concatenate([sample.weights, np.ones(len(accepted))]),
    )


@dataclass(frozen=True)
class _Outlines:
    """Where boxes appear to the sensor: n intervals of azimuth and slope, and their distance.

    Slope is height over distance. `above_ground` is the slope above which the ground before the
    object does not reach.
    """

    azimuth: np.ndarray
    slope: np.ndarray
    distance: np.ndarray
    above_ground: np.ndarray

    @classmethod
    def of(cls, boxes: np.ndarray) -> Self:
        """Return the outlines of (n, 7) boxes in front of the sensor."""
        corners = box_corners(boxes)
        azimuth = np.arctan2(corners[..., 1], corners[..., 0])
        distance = np.maximum(np.hypot(corners[..., 0], corners[..., 1]), 1e-3)
        slope = corners[..., 2] / distance
        nearest = distance.min(axis=1)
        return cls(
            np.stack([azimuth.min(axis=1), azimuth.max(axis=1)], axis=1),
            np.stack([slope.min(axis=1), slope.max(axis=1)], axis=1),
            nearest,
            (boxes[:, 2] - boxes[:, 5] / 2 + _GROUND_METRES) / nearest,
        )

    def cover(self, which: list[int], seen: "_Seen") -> np.ndarray:
        """(p,) bool, whether a point appears within one of some outlines, whatever its distance."""
        within = [
            (values >= bounds[which, :1].T) & (values <= bounds[which, 1:].T)
            for values, bounds in (
                (seen.azimuth[:, None], self.azimuth),
                (seen.slope[:, None], self.slope),
            )
        ]
        return np.asarray((within[0] & within[1]).any(axis=1))


class _Scene:
    """The points of a frame as the sensor sees them; what is pasted hides others and is hidden."""

    def __init__(self, points: np.ndarray) -> None:
        self._points, self._seen = points, _Seen.of(points)
        self._kept = np.ones(len(points), dtype=bool)
        self._pasted: list[int] = []
        azimuth = self._seen.azimuth
        self.azimuths = (float(azimuth.min()), float(azimuth.max()))

    def insert(self, outlines: _Outlines, k: int, points: np.ndarray) -> bool:
        """Put the points of object k in that are seen, unless it would be hidden or cut off."""
        low, high = outlines.azimuth[k]
        if low < self.azimuths[0] or high > self.azimuths[1]:
            return False
        azimuth = self._seen.azimuth
        in_sector = np.flatnonzero((azimuth >= low) & (azimuth <= high) & self._kept)
        slope, distance = self._seen.slope[in_sector], self._seen.distance[in_sector]
        covered = (slope >= outlines.slope[k, 0]) & (slope <= outlines.slope[k, 1])
        before = distance < outlines.distance[k]
        hiding = covered & before & (slope > outlines.above_ground[k])
        if np.count_nonzero(hiding) > _HIDDEN_SHARE * len(points):
            return False
        own = _Seen.of(points)
        nearer = [j for j in self._pasted if outlines.distance[j] < outlines.distance[k]]
        hidden = outlines.cover(nearer, own)
        self._kept[in_sector[covered & ~before]] = False
        self._points = np.concatenate([self._points, points])
        self._seen = self._seen.and_also(own)
        self._kept = np.concatenate([self._kept, ~hidden])
        self._pasted.append(k)
        return True

    def left(self) -> np.ndarray:
        """Return the points that no pasted object has taken the place of or hidden."""
        return self._points[self._kept]


@dataclass(frozen=True)
class _Seen:
    """Where n points appear to the sensor: azimuth, slope and distance over the ground."""

    azimuth: np.ndarray
    slope: np.ndarray
    distance: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> Self:
        """Of (n, >=3) points."""
        distance = np.hypot(points[:, 0], points[:, 1])
        slope = points[:, 2] / np.maximum(distance, 1e-3)
        return cls(np.arctan2(points[:, 1], points[:, 0]), slope, distance)

    def and_also(self, more: Self) -> Self:
        """These points, then more."""
        names = ("azimuth", "slope", "distance")
        return type(self)(*(np.append(getattr(self, of), getattr(more, of)) for of in names))


def _occupied(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (n,) bool, whether there is more than ground where (n, 7) boxes would stand."""
    above_ground = boxes.copy()
    above_ground[:, 2] += _GROUND_METRES / 2
    above_ground[:, 5] -= _GROUND_METRES
    return np.asarray(count_points_in_boxes(points, above_ground) > 0)


def _lifted(points: np.ndarray, lift: float) -> np.ndarray:
    """Return the points, higher by `lift`; changes them in place."""
    points[:, 2] += lift
    return points


def _turns(
    drawn: list[BankObject], azimuths: tuple[float, float], generator: np.random.Generator
) -> list[Similarity]:
    """What brings each object to a random azimuth of the view, mirrored or not."""
    mirrors = generator.random(len(drawn)) < 0.5
    goals = generator.uniform(*azimuths, len(drawn))
    now = [np.arctan2(found.box[1], found.box[0]) for found in drawn]
    return [
        Similarity(bool(mirror), float(goal + azimuth if mirror else goal - azimuth))
        for mirror, goal, azimuth in zip(mirrors, goals, now, strict=True)
    ]
