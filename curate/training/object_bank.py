"""Ground-truth sampling: objects of labeled frames pasted into other frames (SECOND, Sensors 2018).

An object is rotated about the sensor's vertical axis to a new azimuth. It keeps its distance to the
sensor, so the density of its points stays realistic. The new place must be visible and free: no box
overlaps it, not even one of weight 0, and it contains no points except ground. The object is moved
vertically onto the ground there, and hides the points behind it.
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

# Candidates drawn per requested object; crowded frames get fewer objects than requested.
_TRIES = 2
# A place counts as hidden if more scene points are in front of it than this share of the object's
# own points.
_HIDDEN_SHARE = 0.3
# Height of an object's lowest part, which the checks ignore: ground points are in front of every
# object and in every place.
_GROUND_METRES = 0.25
# A place with a larger height difference to the object's original place is a roof or a wall.
_HIGHEST_STEP_METRES = 0.7


@dataclass(frozen=True)
class BankObject:
    """One object: its category, (7,) box and (n, 4) points, in the LiDAR frame of its frame."""

    category: str
    box: Float[np.ndarray, " 7"]
    points: Float32[np.ndarray, "n 4"]


@dataclass(frozen=True)
class ObjectBank:
    """The objects of the labeled frames by category.

    Attributes:
        objects: the objects of each category, in the order of the frames.
    """

    objects: dict[str, tuple[BankObject, ...]]

    @classmethod
    def build(
        cls, samples: Iterable[Sample], categories: tuple[str, ...], fewest_points: int = 5
    ) -> Self:
        """Return a bank of the objects in labeled samples.

        Args:
            samples: samples of labeled frames.
            categories: categories of the bank.
            fewest_points: objects with fewer points are left out.

        Raises:
            LeakageError: if a sample is not from the labeled split.
        """
        objects: dict[str, list[BankObject]] = {category: [] for category in categories}
        for sample in samples:
            if not sample.labeled:
                raise LeakageError(
                    f"object bank: frame {sample.frame_id} is not in the labeled split; "
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
        """Return up to `count` random objects of each category, in random order."""
        drawn = [
            objects[i]
            for objects in self.objects.values()
            for i in generator.permutation(len(objects))[:count]
        ]
        return [drawn[i] for i in generator.permutation(len(drawn))]


def paste_objects(
    sample: Sample, bank: ObjectBank, count: int, generator: np.random.Generator
) -> Sample:
    """Return the sample with up to `count` pasted objects of each category, each with weight 1."""
    drawn = bank.draw(_TRIES * count, generator)
    if not drawn or len(sample.points) == 0:
        return sample
    scene = _Scene(sample.points, sum(len(candidate.points) for candidate in drawn))
    rotations = _rotations(drawn, scene.azimuths, generator)
    boxes = np.concatenate(
        [
            rotation.apply_to_boxes(candidate.box[None])
            for rotation, candidate in zip(rotations, drawn, strict=True)
        ]
    )
    lifts = sample.ground.at(boxes[:, :2]) - (boxes[:, 2] - boxes[:, 5] / 2)
    lifts = np.where(np.isnan(lifts), 0.0, lifts)
    boxes[:, 2] += lifts
    outlines = _Outlines.of(boxes)
    blocked = np.any(bev_iou(boxes, sample.boxes) > 0, axis=1)
    blocked |= np.abs(lifts) > _HIGHEST_STEP_METRES
    blocked |= _occupied(boxes, sample.points)
    overlaps = np.greater(bev_iou(boxes, boxes), 0)
    remaining = dict.fromkeys(bank.objects, count)
    accepted: list[int] = []
    for k, candidate in enumerate(drawn):
        if blocked[k] or not remaining[candidate.category]:
            continue
        points = _lift(rotations[k].apply_to_points(candidate.points), lifts[k])
        if scene.insert(outlines, k, points):
            accepted.append(k)
            blocked |= overlaps[k]
            remaining[candidate.category] -= 1
    names = [drawn[k].category for k in accepted]
    return replace(
        sample,
        points=scene.visible_points(),
        boxes=np.concatenate([sample.boxes, boxes[accepted]]),
        categories=as_categories([*sample.categories.tolist(), *names]),
        weights=np.concatenate([sample.weights, np.ones(len(accepted))]),
        regions=None
        if sample.regions is None
        else np.concatenate([sample.regions, np.full(len(accepted), False)]),
    )


@dataclass(frozen=True)
class _Outlines:
    """Outlines of n boxes as seen by the sensor.

    Attributes:
        azimuth: (n, 2) lowest and highest azimuth, radians.
        slope: (n, 2) lowest and highest slope; slope is height over horizontal distance.
        distance: (n,) horizontal distance of the nearest corner, metres.
        above_ground: (n,) slope above which a point in front of the box is not ground.
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

    def cover(self, rows: list[int], view: np.ndarray) -> np.ndarray:
        """Return (p,) bool: whether a point is inside one of these outlines, at any distance.

        Args:
            rows: rows of the outlines.
            view: (3, p) points, see `_sensor_view`.
        """
        within = [
            (values[:, None] >= bounds[rows, 0]) & (values[:, None] <= bounds[rows, 1])
            for values, bounds in ((view[0], self.azimuth), (view[1], self.slope))
        ]
        return np.asarray((within[0] & within[1]).any(axis=1))

    def row(self, k: int) -> np.ndarray:
        """Return the outline of box k in the form of the kernel `hide_behind`."""
        return np.array([*self.azimuth[k], *self.slope[k], self.distance[k], self.above_ground[k]])


class _Scene:
    """The points of a frame from the sensor's view; pasted objects hide points behind them.

    Args:
        points: (n, 4) points of the frame.
        more: highest number of points that are pasted.
    """

    def __init__(self, points: np.ndarray, more: int) -> None:
        self._count = len(points)
        self._points = np.empty((self._count + more, points.shape[1]), dtype=points.dtype)
        self._view = np.empty((3, len(self._points)), dtype=points.dtype)
        self._visible = np.zeros(len(self._points), dtype=bool)
        self._points[: self._count], self._visible[: self._count] = points, True
        self._view[:, : self._count] = _sensor_view(points)
        self._pasted: list[int] = []
        azimuth = self._view[0, : self._count]
        self.azimuths = (float(azimuth.min()), float(azimuth.max()))

    def insert(self, outlines: _Outlines, k: int, points: np.ndarray) -> bool:
        """Insert the points of object k; return False if it would be hidden or cut off.

        Args:
            outlines: outlines of all candidate objects.
            k: row of the object in the outlines.
            points: (n, 4) points of the object at its new place.
        """
        from curate.training.occlusion_kernel import hide_behind

        low, high = outlines.azimuth[k]
        if low < self.azimuths[0] or high > self.azimuths[1]:
            return False
        # The points that are not pasted yet are not visible, so the kernel skips them.
        most_in_front = _HIDDEN_SHARE * len(points)
        if not hide_behind(self._view, self._visible, outlines.row(k), most_in_front):
            return False
        view = _sensor_view(points)
        nearer = [j for j in self._pasted if outlines.distance[j] < outlines.distance[k]]
        new = slice(self._count, self._count + len(points))
        self._points[new], self._view[:, new] = points, view
        self._visible[new] = ~outlines.cover(nearer, view)
        self._count = new.stop
        self._pasted.append(k)
        return True

    def visible_points(self) -> np.ndarray:
        """Return the points of frame and pasted objects that no pasted object hides."""
        return self._points[self._visible]


def _sensor_view(points: np.ndarray) -> np.ndarray:
    """Return (3, n) azimuth, slope and horizontal distance of (n, >=3) points from the sensor."""
    distance = np.hypot(points[:, 0], points[:, 1])
    slope = points[:, 2] / np.maximum(distance, 1e-3)
    return np.stack([np.arctan2(points[:, 1], points[:, 0]), slope, distance])


def _occupied(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (n,) bool: whether the place of each of (n, 7) boxes has points above the ground."""
    above_ground = boxes.copy()
    above_ground[:, 2] += _GROUND_METRES / 2
    above_ground[:, 5] -= _GROUND_METRES
    return np.asarray(count_points_in_boxes(points, above_ground) > 0)


def _lift(points: np.ndarray, lift: float) -> np.ndarray:
    """Raise points by `lift` in place, and return them."""
    points[:, 2] += lift
    return points


def _rotations(
    drawn: list[BankObject], azimuths: tuple[float, float], generator: np.random.Generator
) -> list[Similarity]:
    """Return a transform of each object to a random azimuth of the view; half are mirrored."""
    mirrors = generator.random(len(drawn)) < 0.5
    goals = generator.uniform(*azimuths, len(drawn))
    current = [np.arctan2(candidate.box[1], candidate.box[0]) for candidate in drawn]
    return [
        Similarity(bool(mirror), float(goal + azimuth if mirror else goal - azimuth))
        for mirror, goal, azimuth in zip(mirrors, goals, current, strict=True)
    ]
