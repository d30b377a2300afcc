"""Motion of a simulated sequence: the vehicle with the sensors, and the objects on the street.

A sequence begins in a scene as single frames have it. Cars in a lane share a speed, those at the
kerb are parked; pedestrians and cyclists go where they face. An object moves only if it meets no
other one during the sequence; otherwise it stands, and so may those behind it. The vehicle follows
its lane: with the street at the angle h in the first frame, its heading relative to the street is
-h * exp(-t / tau), so that it straightens within a second or so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from curate.simulation.population import Placement, Population, footprint
from curate.simulation.scene import Scene
from curate.simulation.street import SENSOR_HEIGHT_M, Street

RATE_HZ = 10.0
"""Frames per second of a sequence."""
_REACH_M = 40.0  # the vehicle drives at most this far: the street is populated for 92 m
_LATERAL_M = 0.8  # largest shift within the lane while the vehicle straightens
_STRAIGHTEN_S = 1.0
# Objects that no other object walks into or drives through; trees may overhang, walls of buildings
# are beyond the pavement.
_PASSABLE = ("shadow", "tree", "building")


@dataclass(frozen=True)
class Motion:
    """Motion with constant speed and turn rate, in road coordinates.

    Attributes:
        direction_rad: direction of travel at time 0, counter-clockwise from the street's direction.
        speed: in m/s.
        turn_rate: in rad/s.
    """

    direction_rad: float = 0.0
    speed: float = 0.0
    turn_rate: float = 0.0

    def shifts(self, times: np.ndarray) -> np.ndarray:
        """Return the (T, 2) shifts along s and d since time 0."""
        turned = self.turn_rate * times
        # The chord of an arc: sin(a) / a times its length, in the direction halfway.
        chord = self.speed * times * np.sinc(turned / (2 * np.pi))
        middle = self.direction_rad + turned / 2
        return np.column_stack([chord * np.cos(middle), chord * np.sin(middle)])


@dataclass(frozen=True)
class Vehicle:
    """The vehicle with the sensors.

    Attributes:
        heading_rad: direction of the street in the LiDAR frame at time 0.
        speed: in m/s.
    """

    heading_rad: float
    speed: float

    @property
    def _tau(self) -> float:
        """Time in which the vehicle straightens, in seconds."""
        lateral = self.speed * abs(self.heading_rad) * _STRAIGHTEN_S
        return _STRAIGHTEN_S * min(1.0, _LATERAL_M / max(lateral, _LATERAL_M))

    def places(self, times: np.ndarray) -> np.ndarray:
        """Return the (T, 2) road coordinates s and d."""
        shift = 1 - np.exp(-times / self._tau)
        d = -self.speed * self.heading_rad * self._tau * shift
        return np.column_stack([self.speed * times, d])

    def street_headings(self, times: np.ndarray) -> np.ndarray:
        """Return the (T,) directions of the street in the LiDAR frame."""
        if self.speed == 0:
            return np.full(len(times), self.heading_rad)
        return np.asarray(self.heading_rad * np.exp(-times / self._tau))


@dataclass(frozen=True)
class World:
    """A street with moving objects, seen from a moving vehicle.

    Attributes:
        street: the street at time 0.
        placements: the objects at time 0.
        motions: the motion of each object.
        vehicle: the motion of the sensors.
    """

    street: Street
    placements: Sequence[Placement]
    motions: Sequence[Motion]
    vehicle: Vehicle

    @classmethod
    def draw(
        cls, layout: np.random.Generator, generator: np.random.Generator, times: np.ndarray
    ) -> Self:
        """Return a random world.

        Args:
            layout: generator of the scene at time 0; the same one gives `Scene.draw`.
            generator: generator of the motion.
            times: times of all frames, in seconds from 0.
        """
        street = Street.draw(layout)
        placements = Population(street, layout).fill()
        traffic = _Traffic(street, placements, times)
        vehicle = traffic.set_in_motion(generator)
        return cls(street, placements, traffic.motions, vehicle)

    def scene(self, time: float) -> Scene:
        """Return the scene at a time, in the LiDAR frame at that time."""
        times = np.array([time])
        (s, d), (heading,) = self.vehicle.places(times)[0], self.vehicle.street_headings(times)
        height = self.street.to_lidar(s, d)[2] + SENSOR_HEIGHT_M
        street = replace(self.street, heading_rad=float(heading), origin=(s, d, height))
        moved = [
            self._moved(placement, motion, street, time)
            for placement, motion in zip(self.placements, self.motions, strict=True)
        ]
        return Scene.assemble(street, moved)

    def _moved(
        self, placement: Placement, motion: Motion, street: Street, time: float
    ) -> Placement:
        """Return an object at a time, in the LiDAR frame of the street at that time."""
        s, d = _on_street(self.street, placement)
        above = placement.position[2] - self.street.to_lidar(s, d)[2]
        shift = motion.shifts(np.array([time]))[0]
        position = street.to_lidar(s + shift[0], d + shift[1]) + np.array([0, 0, above])
        turned = street.heading_rad - self.street.heading_rad + motion.turn_rate * time
        yaw = float(np.mod(placement.yaw_rad + turned + np.pi, 2 * np.pi) - np.pi)
        return replace(placement, position=position, yaw_rad=yaw)

    def pose(self, time: float) -> np.ndarray:
        """Return the (4, 4) transform from the LiDAR frame at a time to that at time 0."""
        times = np.array([time])
        (s, d), (heading,) = self.vehicle.places(times)[0], self.vehicle.street_headings(times)
        turn = self.street.heading_rad - heading
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        pose[:3, 3] = self.street.to_lidar(s, d)
        pose[2, 3] += SENSOR_HEIGHT_M
        return pose


class _Traffic:
    """Sets the objects of a scene in motion, one by one, without collisions.

    Attributes:
        motions: the motion of each object; all stand at first.
    """

    def __init__(self, street: Street, placements: Sequence[Placement], times: np.ndarray) -> None:
        self._street, self._placements, self._times = street, placements, times
        self.motions = [Motion() for _ in placements]
        self._places = np.array([_on_street(street, each) for each in placements]).reshape(-1, 2)
        self._yaws = np.array([each.yaw_rad - street.heading_rad for each in placements])
        outlines = [self._outline(i) for i in range(len(placements))]
        ego = np.array([[x, 0.0, 1.6] for x in np.arange(-4, 5.1, 1.5)])
        self._outlines = [*outlines, ego]
        self._owner = np.repeat(
            np.arange(len(outlines) + 1), [len(each) for each in self._outlines]
        )
        standing = [self._discs(i, self.motions[i]) for i in range(len(outlines))]
        self._paths = np.concatenate([*standing, np.tile(ego, (len(times), 1, 1))], axis=1)

    def set_in_motion(self, generator: np.random.Generator) -> Vehicle:
        """Draw all motions, and return that of the vehicle with the sensors."""
        speed = float(np.clip(generator.normal(8, 3), 3, 14) * (generator.random() > 0.15))
        speed = min(speed, _REACH_M / max(float(self._times[-1]), 1.0))
        lanes = np.clip(generator.normal(9, 3, size=2 * self._street.lanes), 3, 16)
        lanes[0] = speed
        wanted = [self._wanted(i, lanes, generator) for i in range(len(self._placements))]
        ahead = [
            place @ [np.cos(motion.direction_rad), np.sin(motion.direction_rad)]
            for place, motion in zip(self._places, wanted, strict=True)
        ]
        for i in np.argsort(-np.array(ahead), kind="stable"):  # those in front first
            if wanted[i].speed and self._try(int(i), self._discs(int(i), wanted[i])):
                self.motions[i] = wanted[i]
                if i + 1 < len(self.motions) and self._placements[i + 1].kind == "shadow":
                    self.motions[i + 1] = wanted[i]
        ego = self._outlines[-1]
        for share in (1.0, 0.6, 0.3):
            vehicle = Vehicle(self._street.heading_rad, share * speed)
            path = ego + np.pad(vehicle.places(self._times), ((0, 0), (0, 1)))[:, None]
            if self._try(len(self.motions), path):
                return vehicle
        return Vehicle(self._street.heading_rad, 0.0)

    def _wanted(self, i: int, lanes: np.ndarray, generator: np.random.Generator) -> Motion:
        """Return the motion of an object if nothing is in its way."""
        street, kind, (s, d), yaw = self._street, self._placements[i].kind, *self._at(i)
        noise, stands = generator.normal(size=2), generator.random() < 0.15
        if kind == "Car":
            on_road = abs(d - street.axis_d) < street.lanes * street.lane_m
            if on_road and abs(np.sin(yaw)) < 0.15:
                lane = int(np.clip(round(d / street.lane_m), 0, len(lanes) - 1))
                return Motion(0.0 if np.cos(yaw) > 0 else np.pi, float(lanes[lane]))
            if street.in_crossing(s) and abs(np.cos(yaw)) < 0.3:
                return Motion(yaw, float(np.clip(6 + 2 * noise[0], 2, 10)) * (not stands))
        on_pavement = street.right_d - street.pavement_m < d < street.left_d + street.pavement_m
        if kind == "Pedestrian" and on_pavement:
            speed = float(np.clip(1.3 + 0.3 * noise[0], 0.5, 2.2)) * (not stands)
            return Motion(yaw, speed, 0.08 * float(noise[1]) * bool(speed))
        if kind == "Cyclist":
            speed = float(np.clip(4.5 + noise[0], 2, 8)) * (not stands)
            return Motion(yaw, speed, 0.03 * float(noise[1]) * bool(speed))
        return Motion()

    def _at(self, i: int) -> tuple[np.ndarray, float]:
        return self._places[i], float(self._yaws[i])

    def _outline(self, i: int) -> np.ndarray:
        """Return (n, 3) discs x, y, radius that cover an object, around its place and yaw 0."""
        placement = self._placements[i]
        if placement.kind in _PASSABLE:
            return np.zeros((0, 3))
        extent = placement.mesh.size[:2] * placement.scale[:2]
        return footprint(np.zeros(3), 0.0, extent, 0.0)

    def _discs(self, i: int, motion: Motion) -> np.ndarray:
        """Return (T, n, 3) discs s, d, radius of an object at all times."""
        outline, (place, yaw) = self._outlines[i], self._at(i)
        yaws = yaw + motion.turn_rate * self._times
        cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        x, y, radius = outline.T
        s, d = (place + motion.shifts(self._times)).T[:, :, None]
        return np.stack(
            [
                s + cos * x - sin * y,
                d + sin * x + cos * y,
                np.broadcast_to(radius, cos.shape[:1] + x.shape),
            ],
            axis=2,
        )

    def _try(self, i: int, path: np.ndarray) -> bool:
        """Move an object along a path if it meets no other one; return whether it does."""
        others = self._paths[:, self._owner != i]
        distance = np.linalg.norm(path[:, :, None, :2] - others[:, None, :, :2], axis=3)
        if (distance < path[:, :, None, 2] + others[:, None, :, 2]).any():
            return False
        self._paths[:, self._owner == i] = path
        return True


def _on_street(street: Street, placement: Placement) -> np.ndarray:
    """Return the road coordinates s and d of an object at time 0."""
    cos, sin = np.cos(street.heading_rad), np.sin(street.heading_rad)
    x, y = placement.position[:2]
    return np.array([cos * x + sin * y, cos * y - sin * x])
