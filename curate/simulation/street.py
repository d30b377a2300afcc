"""The ground of one scene: a street with lanes, kerbs and pavements, and its height profile.

Road coordinates are s along the street and d to its left, in metres. The sensors are at s = d = 0,
1.73 m above the road, until the vehicle moves. The street's heading is within a few degrees of the
LiDAR's x axis.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from curate.simulation.materials import Material
from curate.simulation.meshes import Mesh

SENSOR_HEIGHT_M = 1.73
_FAR_M = 400.0


@dataclass(frozen=True)
class Street:
    """One street, perhaps with a crossing.

    Attributes:
        heading_rad: direction of the street in the LiDAR frame.
        lanes: number of lanes per direction.
        lane_m: width of a lane.
        parking_left_m: width of the parking strip on the left; 0 if there is none.
        parking_right_m: width of the parking strip on the right; 0 if there is none.
        pavement_m: width of each pavement.
        yard_m: distance from the pavement to the buildings.
        crossing_s: coordinate s of the crossing street's axis; None if there is none.
        crossing_half_m: half the width of the crossing street.
        slope: rise per metre along s and along d.
        wave: amplitude in metres, wavelength in metres and phase of the height profile.
        origin: s and d of the sensors, and their rise in metres, since they were at s = d = 0.
    """

    heading_rad: float
    lanes: int
    lane_m: float
    parking_left_m: float
    parking_right_m: float
    pavement_m: float
    yard_m: float
    crossing_s: float | None
    crossing_half_m: float
    slope: tuple[float, float]
    wave: tuple[float, float, float]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def draw(cls, generator: np.random.Generator) -> Self:
        """Return a random street."""
        parking = generator.random(2) < 0.65
        return cls(
            heading_rad=float(np.clip(generator.normal(0, 0.07), -0.25, 0.25)),
            lanes=1 if generator.random() < 0.75 else 2,
            lane_m=float(generator.uniform(3.0, 3.7)),
            parking_left_m=2.3 * float(parking[0]),
            parking_right_m=2.3 * float(parking[1]),
            pavement_m=float(generator.uniform(2.0, 4.5)),
            yard_m=float(generator.uniform(2.5, 9.0)),
            crossing_s=float(generator.uniform(13, 48)) if generator.random() < 0.4 else None,
            crossing_half_m=float(generator.uniform(3.5, 5.5)),
            slope=(float(generator.normal(0, 0.006)), float(generator.normal(0, 0.008))),
            wave=(
                float(generator.uniform(0, 0.12)),
                float(generator.uniform(35, 80)),
                float(generator.uniform(0, 2 * np.pi)),
            ),
        )

    @property
    def axis_d(self) -> float:
        """Coordinate d of the line between the directions; the sensors are in the right lane."""
        return (self.lanes - 0.5) * self.lane_m

    @property
    def left_d(self) -> float:
        """Coordinate d of the kerb on the left."""
        return self.axis_d + self.lanes * self.lane_m + self.parking_left_m

    @property
    def right_d(self) -> float:
        """Coordinate d of the kerb on the right."""
        return self.axis_d - self.lanes * self.lane_m - self.parking_right_m

    def in_crossing(self, s: np.ndarray | float, margin: float = 0.0) -> np.ndarray:
        """Return whether s is within the crossing street, extended by a margin in metres."""
        if self.crossing_s is None:
            return np.zeros(np.shape(s), dtype=bool)
        return np.abs(np.asarray(s) - self.crossing_s) < self.crossing_half_m + margin

    def to_lidar(self, s: float, d: float) -> np.ndarray:
        """Return the (3,) x, y, z of a point on the ground in the LiDAR frame."""
        kerb = 0.0 if self.right_d < d < self.left_d else self._kerb_m
        height = np.interp(s, self._knots_s, self._profile) + self.slope[1] * d + kerb
        return np.array([*self._from_sensors(s, d), height - self.origin[2]])

    def _from_sensors(self, s: Any, d: Any) -> tuple[Any, Any]:
        """Return x and y in the LiDAR frame of points in road coordinates."""
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        s, d = s - self.origin[0], d - self.origin[1]
        return cos * s - sin * d, sin * s + cos * d

    def ground(self) -> Mesh:
        """Return the mesh of the ground: asphalt, pavements and yards."""
        s, d = np.meshgrid(self._knots_s, self._knots_d, indexing="ij")
        outside = (d < self.right_d - 1e-6) | (d > self.left_d + 1e-6)
        z = np.interp(s, self._knots_s, self._profile) + self.slope[1] * d
        z += outside * self._kerb_m
        vertices = np.stack([*self._from_sensors(s, d), z - self.origin[2]], axis=-1)
        rows, columns = s.shape
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        first = np.stack([corner, corner + columns, corner + columns + 1], axis=1)
        second = np.stack([corner, corner + columns + 1, corner + 1], axis=1)
        middle_s = (self._knots_s[:-1] + self._knots_s[1:]) / 2
        middle_d = (self._knots_d[:-1] + self._knots_d[1:]) / 2
        materials = self._surface(*np.meshgrid(middle_s, middle_d, indexing="ij")).ravel()
        return Mesh(
            vertices.reshape(-1, 3).astype(np.float32),
            np.concatenate([first, second]),
            np.concatenate([materials, materials]),
        )

    def _surface(self, s: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return the uint8 material of the ground at points in road coordinates."""
        road = ((d > self.right_d) & (d < self.left_d)) | self.in_crossing(s)
        beside = (d > self.right_d - self.pavement_m) & (d < self.left_d + self.pavement_m)
        surface = np.where(beside, Material.PAVEMENT, Material.GRASS)
        return np.where(road, Material.ASPHALT, surface).astype(np.uint8)

    @property
    def _kerb_m(self) -> float:
        """Height of the pavement above the road; 0 in a scene with a crossing street."""
        return 0.11 if self.crossing_s is None else 0.0

    @cached_property
    def _knots_s(self) -> np.ndarray:
        """Coordinates s of the mesh vertices along the street."""
        knots = np.concatenate([np.arange(-20, 112, 4.0), [140, 200, _FAR_M]])
        if self.crossing_s is not None:
            edges = self.crossing_s + self.crossing_half_m * np.array([-1, 1])
            knots = np.sort(np.concatenate([knots, edges]))
        return knots

    @cached_property
    def _knots_d(self) -> np.ndarray:
        """Coordinates d of the mesh vertices across the street; each kerb has two."""
        outer = self.pavement_m
        left = [self.left_d, self.left_d + 0.02, self.left_d + outer, 40, 90, _FAR_M]
        right = [self.right_d, self.right_d - 0.02, self.right_d - outer, -40, -90, -_FAR_M]
        return np.sort(np.array([*left, *right]))

    @cached_property
    def _profile(self) -> np.ndarray:
        """Height of the ground at d = 0 at each knot of s."""
        amplitude, length, phase = self.wave
        swing = np.sin(2 * np.pi * self._knots_s / length + phase) - np.sin(phase)
        rise = self.slope[0] * self._knots_s + amplitude * swing
        level = rise[np.searchsorted(self._knots_s, 0.0)] + SENSOR_HEIGHT_M
        return np.asarray(rise - level)
