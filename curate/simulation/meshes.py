"""Triangle meshes built from boxes, cylinders, ellipsoids and rings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from curate.simulation.materials import Material


@dataclass(frozen=True)
class Mesh:
    """Triangles with a material each; corners are counter-clockwise seen from outside.

    Attributes:
        vertices: (n, 3) float32, in metres.
        triangles: (m, 3) int64 rows of `vertices`.
        materials: (m,) uint8, see `Material`.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    materials: np.ndarray

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest x, y, z, each (3,)."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    @property
    def size(self) -> np.ndarray:
        """The (3,) extent along x, y and z in metres."""
        low, high = self.bounds
        return np.asarray(high - low)

    def standing_on_origin(self) -> Self:
        """Return the mesh, moved so that its bounds are centred in x and y and start at z = 0."""
        low, high = self.bounds
        base = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
        return replace(self, vertices=(self.vertices - base).astype(np.float32))

    def moved(self, rotation: np.ndarray, translation: ArrayLike) -> Self:
        """Return the mesh, rotated by a (3, 3) matrix and then translated."""
        vertices = self.vertices @ rotation.T.astype(np.float32)
        return replace(self, vertices=vertices + np.asarray(translation, dtype=np.float32))


def merge(parts: Sequence[Mesh]) -> Mesh:
    """Join several meshes into one."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate(
            [part.triangles + offset for part, offset in zip(parts, offsets, strict=True)]
        ),
        np.concatenate([part.materials for part in parts]),
    )


def rotation_z(angle_rad: float) -> np.ndarray:
    """Return the (3, 3) matrix of a counter-clockwise rotation about z."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def box(centre: ArrayLike, size: ArrayLike, material: Material) -> Mesh:
    """Return an axis-aligned box; `size` is its extent along x, y and z in metres."""
    return frustum(centre, size, (1.0, 1.0), material)


def frustum(
    centre: ArrayLike,
    size: ArrayLike,
    top_scale: tuple[float, float],
    material: Material,
    *,
    top_shift: float = 0.0,
) -> Mesh:
    """Return a box with its top scaled in x and y, and shifted along x by `top_shift` metres."""
    vertices, triangles = _unit_box()
    shaped = vertices.copy()
    top = shaped[:, 2] > 0
    shaped[top, :2] *= top_scale
    shaped = shaped * np.asarray(size, dtype=np.float32)
    shaped[top, 0] += top_shift
    return _mesh(shaped + np.asarray(centre, dtype=np.float32), triangles, material)


def ellipsoid(centre: ArrayLike, radii: ArrayLike, material: Material, *, sides: int = 8) -> Mesh:
    """Return an ellipsoid with axes along x, y and z."""
    vertices, triangles = _unit_sphere(sides)
    shaped = vertices * np.asarray(radii, dtype=np.float32)
    return _mesh(shaped + np.asarray(centre, dtype=np.float32), triangles, material)


def cylinder(
    start: ArrayLike,
    end: ArrayLike,
    radius: float,
    material: Material,
    *,
    end_radius: float | None = None,
    sides: int = 8,
) -> Mesh:
    """Return a cylinder from `start` to `end`, or a truncated cone if `end_radius` is given."""
    vertices, triangles = _unit_cylinder(sides)
    origin = np.asarray(start, dtype=np.float64)
    axis = np.asarray(end, dtype=np.float64) - origin
    across = _perpendicular(axis)
    upward = np.cross(axis / np.linalg.norm(axis), across)
    radii = radius + vertices[:, 2:] * ((radius if end_radius is None else end_radius) - radius)
    shaped = (
        origin
        + vertices[:, 2:] * axis
        + radii * (vertices[:, :1] * across + vertices[:, 1:2] * upward)
    )
    return _mesh(shaped.astype(np.float32), triangles, material)


def ring(
    centre: ArrayLike,
    radius: float,
    thickness: float,
    width: float,
    material: Material,
    *,
    sides: int = 14,
) -> Mesh:
    """Return a ring in the x-z plane with an outer `radius`, a radial `thickness` and a `width`."""
    angles = np.arange(sides) * 2 * np.pi / sides
    circle = np.stack([np.cos(angles), np.zeros(sides), np.sin(angles)], axis=1)
    side = np.array([0.0, width / 2, 0.0])
    inner = radius - thickness
    loops = [radius * circle - side, radius * circle + side, inner * circle + side]
    loops.append(inner * circle - side)
    here = np.arange(sides)
    there = np.roll(here, -1)
    quads = [
        np.stack([a * sides + here, b * sides + here, b * sides + there, a * sides + there], axis=1)
        for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))
    ]
    vertices = np.concatenate(loops) + np.asarray(centre)
    return _mesh(vertices.astype(np.float32), _split(np.concatenate(quads)), material)


def _mesh(vertices: np.ndarray, triangles: np.ndarray, material: Material) -> Mesh:
    """Return a mesh of a single material."""
    return Mesh(vertices, triangles, np.full(len(triangles), material, dtype=np.uint8))


def _perpendicular(axis: np.ndarray) -> np.ndarray:
    """Return a unit vector perpendicular to `axis`."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    across = np.cross(axis, helper)
    return np.asarray(across / np.linalg.norm(across))


def _split(quads: np.ndarray) -> np.ndarray:
    """Split (n, 4) quadrilaterals into (2n, 3) triangles."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


@cache
def _unit_box() -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and triangles of a box with corners at +-0.5."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    return corners.astype(np.float32), _split(quads)


@cache
def _unit_cylinder(sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed cylinder of radius 1 about the z axis, from z = 0 to 1."""
    angles = np.arange(sides) * 2 * np.pi / sides
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    lower = np.column_stack([circle, np.zeros(sides)])
    upper = np.column_stack([circle, np.ones(sides)])
    here = np.arange(sides)
    there = np.roll(here, -1)
    mantle = _split(np.stack([here, there, there + sides, here + sides], axis=1))
    fan = np.arange(1, sides - 1)
    top = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1) + sides
    bottom = np.stack([np.zeros_like(fan), fan + 1, fan], axis=1)
    vertices = np.concatenate([lower, upper]).astype(np.float32)
    return vertices, np.concatenate([mantle, top, bottom])


@cache
def _unit_sphere(sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a sphere of radius 1 about the origin, divided by longitude and latitude."""
    bands = max(3, sides // 2)
    latitudes = np.linspace(-np.pi / 2, np.pi / 2, bands + 1)[1:-1]
    angles = np.arange(sides) * 2 * np.pi / sides
    rows = [
        np.column_stack(
            [
                np.cos(lat) * np.cos(angles),
                np.cos(lat) * np.sin(angles),
                np.full(sides, np.sin(lat)),
            ]
        )
        for lat in latitudes
    ]
    vertices = np.concatenate([*rows, [[0, 0, -1], [0, 0, 1]]]).astype(np.float32)
    here = np.arange(sides)
    there = np.roll(here, -1)
    south, north, last = len(vertices) - 2, len(vertices) - 1, (len(rows) - 1) * sides
    quads = [
        np.stack([here, there, there + sides, here + sides], axis=1) + row * sides
        for row in range(len(rows) - 1)
    ]
    caps = [
        np.stack([there, here, np.full(sides, south)], axis=1),
        np.stack([here + last, there + last, np.full(sides, north)], axis=1),
    ]
    return vertices, np.concatenate([_split(np.concatenate(quads)), *caps])
