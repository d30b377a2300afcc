"""Random placement of objects along a street: traffic, parked cars, people, clutter, buildings."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from curate.simulation import actors, scenery
from curate.simulation.materials import Material, palette
from curate.simulation.meshes import Mesh
from curate.simulation.street import Street

_HALF_VIEW_RAD = np.deg2rad(56)
_REACH_M = 92.0


@dataclass(frozen=True)
class Placement:
    """One mesh in the scene.

    Attributes:
        kind: a category ("Car", ...) or a kind of scenery ("tree", ...).
        mesh: the mesh, which faces +x and stands on z = 0.
        position: (3,) position of the mesh's origin in the LiDAR frame, in metres.
        yaw_rad: yaw, counter-clockwise from the LiDAR's x axis.
        scale: (3,) scale along the axes of the mesh.
        palette: (m, 3) RGB of the materials.
    """

    kind: str
    mesh: Mesh
    position: np.ndarray
    yaw_rad: float
    scale: np.ndarray
    palette: np.ndarray


@dataclass
class Population:
    """Places objects on a street at random, without overlaps.

    Attributes:
        street: the street to fill.
        generator: the random generator.
        placements: the objects placed so far.
    """

    street: Street
    generator: np.random.Generator
    placements: list[Placement] = field(default_factory=list)
    _discs: np.ndarray = field(
        default_factory=lambda: np.array([[x, 0.0, 1.6] for x in np.arange(-4, 5.1, 1.5)])
    )

    def fill(self) -> Sequence[Placement]:
        """Place all objects and return them."""
        self._traffic()
        self._crossing_traffic()
        self._people()
        self._riders()
        for side in (-1, 1):
            self._parked(side)
            self._pavement_clutter(side)
            self._yard(side)
            self._buildings(side)
        return self.placements

    def _traffic(self) -> None:
        """Place cars in the lanes, with a random density for each lane."""
        street, generator = self.street, self.generator
        for lane in range(2 * street.lanes):
            onward = lane < street.lanes
            d = lane * street.lane_m
            gap = generator.uniform(14, 75)
            s = 7 + generator.exponential(gap)
            while s < _REACH_M:
                turned = generator.random() < 0.05
                swerve = generator.uniform(-0.9, 0.9) if turned else generator.normal(0, 0.03)
                yaw = (0.0 if onward else np.pi) + swerve
                self._place("Car", s, d + generator.normal(0, 0.25), yaw)
                s += 5.5 + generator.exponential(gap)

    def _crossing_traffic(self) -> None:
        """Place cars and cyclists on the crossing street, if there is one."""
        street, generator = self.street, self.generator
        if street.crossing_s is None:
            return
        for side in (-1, 1):
            s = street.crossing_s - side * street.crossing_half_m / 2
            for _ in range(generator.poisson(0.8)):
                d = generator.uniform(-30, 30)
                self._place("Car", s, d, side * np.pi / 2 + generator.normal(0, 0.05))
            for _ in range(generator.poisson(0.35)):
                d = generator.uniform(-20, 20)
                self._place("Cyclist", s + side * 1.2, d, side * np.pi / 2)

    def _people(self) -> None:
        """Place pedestrians, alone or in groups, mostly on the pavements."""
        street, generator = self.street, self.generator
        for _ in range(generator.poisson(generator.choice([1.5, 3.2, 5.6]))):
            s = 5 + 70 * generator.random() ** 1.4
            onward = generator.choice([0.0, np.pi])
            place = generator.random()
            if place < 0.78:
                side = generator.choice([-1, 1])
                d = self._beside(side, generator.uniform(0.3, 1.0) * street.pavement_m)
                yaw = onward + generator.normal(0, 0.25)
            elif place < 0.92:
                d = generator.uniform(street.right_d, street.left_d)
                yaw = onward + np.pi / 2 + generator.normal(0, 0.2)
            else:
                d = self._beside(generator.choice([-1, 1]), street.pavement_m + 1.0)
                yaw = generator.uniform(-np.pi, np.pi)
            for member in range(generator.choice([1, 2, 3], p=[0.68, 0.24, 0.08])):
                shift = generator.normal(0, 0.2), generator.uniform(0.6, 0.85) * member
                self._place("Pedestrian", s + shift[0], d + shift[1], yaw, margin=0.0)

    def _riders(self) -> None:
        """Place cyclists at the edge of the lanes, on the pavements, or crossing the street."""
        street, generator = self.street, self.generator
        for _ in range(generator.poisson(generator.choice([1.0, 2.6, 4.2]))):
            s = 5 + 65 * generator.random() ** 1.3
            side = generator.choice([-1, 1])
            along = 0.0 if side < 0 else np.pi
            place = generator.random()
            if place < 0.6:
                lane_edge = street.lanes * street.lane_m - generator.uniform(0.4, 1.1)
                d, yaw = street.axis_d + side * lane_edge, along + generator.normal(0, 0.06)
            elif place < 0.85:
                d = self._beside(side, generator.uniform(0.4, 0.9) * street.pavement_m)
                yaw = generator.choice([0.0, np.pi]) + generator.normal(0, 0.1)
            else:
                d = generator.uniform(street.right_d - 2, street.left_d + 2)
                yaw = generator.choice([-1, 1]) * np.pi / 2 + generator.normal(0, 0.3)
            self._place("Cyclist", s, d, yaw)

    def _parked(self, side: int) -> None:
        """Place a row of parked cars, car-sized clutter and gaps along the kerb."""
        street, generator = self.street, self.generator
        if (street.parking_left_m if side > 0 else street.parking_right_m) == 0:
            return
        full = generator.beta(1.2, 2.6) * 0.8
        s = generator.uniform(3, 9)
        while s < 70:
            d = self._beside(side, -1.1 + generator.normal(0, 0.1))
            yaw = (0.0 if generator.random() < 0.75 + 0.2 * (side < 0) else np.pi) + (
                generator.normal(0, 0.03)
            )
            draw = generator.random()
            if not street.in_crossing(s, 3.0):
                if draw < full:
                    self._place("Car", s, d, yaw)
                elif draw < full + 0.09:
                    self._place(str(generator.choice(scenery.CAR_SIZED)), s, d, yaw)
            s += generator.uniform(5.2, 6.6)

    def _pavement_clutter(self, side: int) -> None:
        """Place person-sized and cyclist-sized clutter, trees and poles on the pavement."""
        street, generator = self.street, self.generator
        for kinds, rate in ((scenery.PERSON_SIZED, 2.6), (scenery.CYCLIST_SIZED, 0.7)):
            for _ in range(generator.poisson(rate)):
                s = 6 + 60 * generator.random() ** 1.3
                if street.in_crossing(s, 1.0):
                    continue
                d = self._beside(side, generator.choice([0.35, 0.6, 0.9]) * street.pavement_m)
                yaw = generator.choice([0.0, np.pi / 2, np.pi, -np.pi / 2])
                self._place(str(generator.choice(kinds)), s, d, yaw + generator.normal(0, 0.15))
        if generator.random() < 0.7:
            self._row(side, "tree", 0.5, generator.uniform(9, 22))
        self._row(side, "pole", 0.4, generator.uniform(18, 40))

    def _yard(self, side: int) -> None:
        """Place cars, clutter, walls and trees between the pavement and the buildings."""
        street, generator = self.street, self.generator
        for kinds, rate in (
            (("Car",), 0.8),
            (scenery.CAR_SIZED, 1.3),
            (scenery.PERSON_SIZED, 0.8),
            (("wall", "tree", "tree"), 2.0),
        ):
            for _ in range(generator.poisson(rate)):
                s = generator.uniform(8, 70)
                if street.in_crossing(s, 3.0):
                    continue
                inward = street.pavement_m + generator.uniform(0.6, max(0.7, street.yard_m - 1.0))
                kind = str(generator.choice(kinds))
                quarter = 0 if kind == "wall" else generator.integers(4)
                yaw = quarter * np.pi / 2 + generator.normal(0, 0.1)
                self._place(kind, s, self._beside(side, inward), yaw)

    def _buildings(self, side: int) -> None:
        """Place a row of buildings with gaps."""
        street, generator = self.street, self.generator
        s = generator.uniform(-6, 6)
        d = self._beside(side, street.pavement_m + street.yard_m)
        while s < 110:
            back = generator.uniform(0, 2.0)
            yaw = 0.0 if side > 0 else np.pi
            if generator.random() < 0.85 and not street.in_crossing(s, 9.0):
                self._place("building", s, d + side * back, yaw, apart=False)
            s += generator.uniform(14, 22)

    def _row(self, side: int, kind: str, inward: float, spacing: float) -> None:
        """Place evenly spaced trees or poles along the kerb."""
        s = self.generator.uniform(4, 4 + spacing)
        while s < _REACH_M:
            if not self.street.in_crossing(s, 1.0):
                self._place(kind, s, self._beside(side, inward), -side * np.pi / 2)
            s += spacing

    def _beside(self, side: int, outward: float) -> float:
        """Return the road coordinate d at `outward` metres beyond a kerb (+1 left, -1 right)."""
        return self.street.left_d + outward if side > 0 else self.street.right_d - outward

    def _place(
        self, kind: str, s: float, d: float, yaw: float, *, margin: float = 0.25, apart: bool = True
    ) -> None:
        """Place a random mesh of a kind, unless it is out of view or overlaps another object."""
        generator = self.generator
        mesh = self._mesh(kind)
        scale = generator.uniform(0.93, 1.03) * generator.uniform(0.97, 1.03, size=3)
        position = self.street.to_lidar(s, d)
        yaw_rad = float(np.mod(self.street.heading_rad + yaw + np.pi, 2 * np.pi) - np.pi)
        extent = mesh.size[:2] * scale[:2]
        if not _in_view(position, float(extent.max())):
            return
        discs = footprint(position, yaw_rad, extent, margin)
        if apart and self._overlaps(discs):
            return
        if apart and kind != "tree":
            self._discs = np.concatenate([self._discs, discs])
        if kind in actors.VARIANTS:
            colours = actors.actor_colours(kind, generator)
        else:
            colours = scenery.scenery_colours(kind, generator)
        self.placements.append(Placement(kind, mesh, position, yaw_rad, scale, palette(colours)))
        if kind in actors.VARIANTS or kind in scenery.CLUTTER:
            self.placements.append(_shadow(position, yaw_rad, extent))

    def _mesh(self, kind: str) -> Mesh:
        """Return a random mesh of a kind."""
        if kind in actors.VARIANTS:
            variant = int(self.generator.integers(actors.VARIANTS[kind]))
            return actors.actor_mesh(kind, variant)
        return scenery.scenery_mesh(kind, int(self.generator.integers(scenery.VARIANTS)))

    def _overlaps(self, discs: np.ndarray) -> bool:
        """Return whether any of (n, 3) discs x, y, radius overlaps a disc of a placed object."""
        distance = np.linalg.norm(self._discs[:, None, :2] - discs[None, :, :2], axis=2)
        return bool((distance < self._discs[:, None, 2] + discs[None, :, 2]).any())


def _shadow(position: np.ndarray, yaw_rad: float, extent: np.ndarray) -> Placement:
    """Return the dark patch on the ground under an object."""
    return Placement(
        "shadow",
        scenery.shadow_mesh(),
        position + np.array([0, 0, 0.02]),
        yaw_rad,
        np.array([*(extent * 1.05 + 0.06), 1.0]),
        palette({Material.PAVEMENT: np.full(3, 0.1)}),
    )


def _in_view(position: np.ndarray, extent: float) -> bool:
    """Return whether an object may be within the sensors' field of view."""
    distance = float(np.hypot(position[0], position[1]))
    if distance > _REACH_M + extent:
        return False
    margin = np.arctan2(extent, max(distance, 0.1))
    return bool(abs(np.arctan2(position[1], position[0])) < _HALF_VIEW_RAD + margin)


def footprint(
    position: np.ndarray, yaw_rad: float, extent: np.ndarray, margin: float
) -> np.ndarray:
    """Return (n, 3) discs x, y, radius along the longer side of a rectangle (length, width).

    They cover it approximately. For example, a car of 4 x 2 m gets two discs with a radius of 1 m
    plus the margin, centred 1 m in front of and 1 m behind the centre of the car.
    """
    long, short = float(extent.max()), float(extent.min())
    radius = short / 2 + margin
    reach = max(0.0, (long - short) / 2)
    along = np.linspace(-reach, reach, max(1, int(np.ceil(2 * reach / max(short, 0.3))) + 1))
    turn = yaw_rad if extent[0] >= extent[1] else yaw_rad + np.pi / 2
    return np.column_stack(
        [
            position[0] + along * np.cos(turn),
            position[1] + along * np.sin(turn),
            np.full(len(along), radius),
        ]
    )
