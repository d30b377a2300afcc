"""Levels of difficulty: which objects and detections count at each, and why others do not.

KITTI's levels (Geiger et al., CVPR 2012) need 2D boxes, occlusion and truncation. The levels by
LiDAR points and the ranges of distance need none of these, so they suit data without images. They
follow the Waymo Open Dataset (Sun et al., CVPR 2020): level 1 has more than 5 points, level 2 also
those with 1 to 5; the ranges are 0-30, 30-50 and above 50 m.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Literal, Protocol

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.errors import ConfigError
from curate.evaluation.kitti_rules import (
    DIFFICULTIES,
    MAX_OCCLUSIONS,
    MAX_TRUNCATIONS,
    MIN_HEIGHTS,
)
from curate.shapes import Bool, Int

Kind = Literal["kitti", "points", "distance"]

MINIMUM_POINTS = (6, 1)
DISTANCE_LIMITS = (30.0, 50.0)

REASONS = (
    "counts",
    "no 2D box",
    "outside the image",
    "too small",
    "occluded",
    "truncated",
    "no points",
    "few points",
    "other distance",
)
"""Why an object or detection does not count; the first that applies. Index 0: it counts."""

_COUNTS = REASONS.index("counts")
NO_BOX = REASONS.index("no 2D box")


class Difficulty(Protocol):
    """The levels of difficulty of an evaluation.

    Attributes:
        kind: "kitti", "points" or "distance".
        levels: the name of each level.
        in_image: whether detections are also compared with the objects in the image.
        beyond_is_ignored: whether a detection that does not count is ignored like in KITTI's rules.
            Otherwise it can match an object, and is only no false positive without one.
    """

    @property
    def kind(self) -> Kind:
        """See the attributes of the class."""
        ...

    @property
    def levels(self) -> tuple[str, ...]:
        """See the attributes of the class."""
        ...

    @property
    def in_image(self) -> bool:
        """See the attributes of the class."""
        ...

    @property
    def beyond_is_ignored(self) -> bool:
        """See the attributes of the class."""
        ...

    def limits(self) -> tuple[str, ...]:
        """Return the limits of each level in words."""
        ...

    def whole(self) -> "tuple[Difficulty, int]":
        """Return levels of the same kind, and the index of the one with the most objects."""
        ...

    def object_reasons(
        self, objects: KittiObjects, level: int, points: Int[np.ndarray, " n"] | None
    ) -> Int[np.ndarray, " n"]:
        """Return (n,) int8 index into `REASONS` of each object.

        Args:
            objects: n objects of any category.
            level: index into `levels`.
            points: (n,) LiDAR points in each object's box; None if they were not counted.
        """
        ...

    def result_reasons(self, results: KittiObjects, level: int) -> Int[np.ndarray, " n"]:
        """Return (n,) index into `REASONS` of each detection."""
        ...


@dataclass(frozen=True)
class KittiDifficulty:
    """KITTI's easy, moderate and hard; each includes the easier ones."""

    kind: ClassVar[Kind] = "kitti"
    levels: ClassVar[tuple[str, ...]] = DIFFICULTIES
    in_image: ClassVar[bool] = True
    beyond_is_ignored: ClassVar[bool] = True

    def limits(self) -> tuple[str, ...]:
        """See `Difficulty.limits`."""
        return tuple(
            f"2D box above {height:g} px, occlusion up to {occluded}, "
            f"truncation up to {truncated:g}"
            for height, occluded, truncated in zip(
                MIN_HEIGHTS, MAX_OCCLUSIONS, MAX_TRUNCATIONS, strict=True
            )
        )

    def whole(self) -> tuple["KittiDifficulty", int]:
        """See `Difficulty.whole`."""
        return self, len(self.levels) - 1

    def object_reasons(
        self,
        objects: KittiObjects,
        level: int,
        points: Int[np.ndarray, " n"] | None,  # noqa: ARG002
    ) -> Int[np.ndarray, " n"]:
        """See `Difficulty.object_reasons`."""
        heights = objects.boxes_2d[:, 3] - objects.boxes_2d[:, 1]
        return _first_reason(
            {
                "outside the image": _is_outside(objects),
                "no 2D box": ~(heights > 0),
                "too small": heights <= MIN_HEIGHTS[level],
                "occluded": objects.occluded > MAX_OCCLUSIONS[level],
                "truncated": objects.truncated > MAX_TRUNCATIONS[level],
            },
            len(objects),
        )

    def result_reasons(self, results: KittiObjects, level: int) -> Int[np.ndarray, " n"]:
        """See `Difficulty.result_reasons`."""
        heights = np.abs(results.boxes_2d[:, 3] - results.boxes_2d[:, 1])
        return _first_reason(
            {
                "outside the image": _is_outside(results),
                "no 2D box": ~(heights > 0),
                "too small": heights < MIN_HEIGHTS[level],
            },
            len(results),
        )


@dataclass(frozen=True)
class PointDifficulty:
    """Levels by the LiDAR points in an object's box; each includes the easier ones.

    Attributes:
        minimum_points: the points that an object of each level must have, falling.
    """

    minimum_points: tuple[int, ...] = MINIMUM_POINTS
    kind: ClassVar[Kind] = "points"
    in_image: ClassVar[bool] = False
    beyond_is_ignored: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Raise ConfigError unless the numbers are positive and fall."""
        numbers = self.minimum_points
        if not numbers or min(numbers) < 1 or any(a <= b for a, b in pairwise(numbers)):
            raise ConfigError(
                f"minimum points {_listed(numbers)}: give whole numbers from 1, the largest first, "
                "such as 6,1"
            )

    @property
    def levels(self) -> tuple[str, ...]:
        """The name of each level."""
        return tuple(f"level {number}" for number in range(1, len(self.minimum_points) + 1))

    def limits(self) -> tuple[str, ...]:
        """See `Difficulty.limits`."""
        return tuple(
            f"at least {least} LiDAR {'points' if least > 1 else 'point'} in the box"
            for least in self.minimum_points
        )

    def whole(self) -> tuple["PointDifficulty", int]:
        """See `Difficulty.whole`."""
        return self, len(self.levels) - 1

    def object_reasons(
        self, objects: KittiObjects, level: int, points: Int[np.ndarray, " n"] | None
    ) -> Int[np.ndarray, " n"]:
        """See `Difficulty.object_reasons`.

        Raises:
            ConfigError: if the points were not counted.
        """
        if points is None:
            raise ConfigError("levels by LiDAR points need the number of points in each object")
        least = self.minimum_points[level]
        return _first_reason({"no points": points < 1, "few points": points < least}, len(objects))

    def result_reasons(self, results: KittiObjects, level: int) -> Int[np.ndarray, " n"]:  # noqa: ARG002
        """See `Difficulty.result_reasons`; all detections count."""
        return _first_reason({}, len(results))


@dataclass(frozen=True)
class DistanceDifficulty:
    """Ranges of the distance on the ground between the sensor and the centre of a box.

    Attributes:
        limits_metres: the distances between two ranges, rising. A range includes its lower limit.
    """

    limits_metres: tuple[float, ...] = DISTANCE_LIMITS
    kind: ClassVar[Kind] = "distance"
    in_image: ClassVar[bool] = False
    beyond_is_ignored: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Raise ConfigError unless the limits are positive and rise."""
        edges = (0.0, *self.limits_metres)
        if not all(a < b < np.inf for a, b in pairwise(edges)):
            raise ConfigError(
                f"distances {_listed(self.limits_metres)}: give metres above 0, the smallest "
                "first, such as 30,50"
            )

    @property
    def _edges(self) -> tuple[float, ...]:
        return (0.0, *self.limits_metres, np.inf)

    @property
    def levels(self) -> tuple[str, ...]:
        """The name of each range."""
        return tuple(
            f"{low:g}-{high:g} m" if high < np.inf else f"{low:g}+ m"
            for low, high in pairwise(self._edges)
        )

    def limits(self) -> tuple[str, ...]:
        """See `Difficulty.limits`."""
        return tuple(
            f"from {low:g} m" if high == np.inf else f"from {low:g} to below {high:g} m"
            for low, high in pairwise(self._edges)
        )

    def whole(self) -> tuple["DistanceDifficulty", int]:
        """See `Difficulty.whole`; a single range from 0 m."""
        return DistanceDifficulty(()), 0

    def object_reasons(
        self,
        objects: KittiObjects,
        level: int,
        points: Int[np.ndarray, " n"] | None,  # noqa: ARG002
    ) -> Int[np.ndarray, " n"]:
        """See `Difficulty.object_reasons`."""
        return self.result_reasons(objects, level)

    def result_reasons(self, results: KittiObjects, level: int) -> Int[np.ndarray, " n"]:
        """See `Difficulty.result_reasons`."""
        distances = np.hypot(results.locations[:, 0], results.locations[:, 2])
        low, high = self._edges[level : level + 2]
        inside: Bool[np.ndarray, " n"] = (distances >= low) & (distances < high)
        return _first_reason({"other distance": ~inside}, len(results))


KITTI = KittiDifficulty()


def open_difficulty(
    kind: Kind,
    minimum_points: Sequence[int] = MINIMUM_POINTS,
    distance_limits: Sequence[float] = DISTANCE_LIMITS,
) -> Difficulty:
    """Return the levels of a kind.

    Args:
        kind: "kitti", "points" or "distance".
        minimum_points: see `PointDifficulty`.
        distance_limits: see `DistanceDifficulty`.

    Raises:
        ConfigError: if the kind is unknown, or its limits are invalid.
    """
    if kind == "kitti":
        return KITTI
    if kind == "points":
        return PointDifficulty(tuple(minimum_points))
    if kind == "distance":
        return DistanceDifficulty(tuple(distance_limits))
    raise ConfigError(f"difficulty {kind!r}: use kitti, points or distance")


def _first_reason(applies: dict[str, np.ndarray], count: int) -> np.ndarray:
    """Return (count,) int8 index of the first reason that applies, else that of "counts"."""
    reasons = np.full(count, _COUNTS, dtype=np.int8)
    for reason, where in reversed(applies.items()):
        reasons[where] = REASONS.index(reason)
    return reasons


def _is_outside(objects: KittiObjects) -> np.ndarray:
    """Return (n,) bool: the 2D box is the placeholder of a box outside the image, all -1."""
    return np.asarray((objects.boxes_2d == -1).all(axis=1))


def _listed(numbers: Sequence[float]) -> str:
    return ",".join(f"{number:g}" for number in numbers) or "(none)"
