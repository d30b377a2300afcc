"""A scene as a single triangle mesh, and ray casting into it with Open3D's RaycastingScene."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from curate.detections import CATEGORIES
from curate.simulation.materials import palette
from curate.simulation.meshes import rotation_z
from curate.simulation.open3d_loader import load
from curate.simulation.population import Placement, Population
from curate.simulation.street import Street

SEMANTIC_CLASSES = {"Car": 1, "Pedestrian": 2, "Cyclist": 3}
"""Class ids of the semantic maps; 0 is background."""


@dataclass(frozen=True)
class Hits:
    """The first hits of rays.

    Attributes:
        distance: (n,) float32 in units of the ray's direction vector, inf without a hit.
        triangle: (n,) int32 rows of the scene's triangles, -1 without a hit.
    """

    distance: np.ndarray
    triangle: np.ndarray


@dataclass(frozen=True)
class Scene:
    """All triangles of a scene, in the LiDAR frame.

    Attributes:
        street: the street with its ground.
        placements: the objects on the street; their instance numbers count from 1.
        vertices: (n, 3) float32, in metres.
        triangles: (m, 3) uint32 rows of `vertices`.
        instances: (m,) int32 instance number of each triangle; 0 is the ground.
        materials: (m,) uint8, see `Material`.
        colours: (m, 3) float32 RGB, 0 to 1.
        normals: (m, 3) float32 outward unit normals.
    """

    street: Street
    placements: Sequence[Placement]
    vertices: np.ndarray
    triangles: np.ndarray
    instances: np.ndarray
    materials: np.ndarray
    colours: np.ndarray
    normals: np.ndarray

    @classmethod
    def draw(cls, generator: np.random.Generator) -> Self:
        """Return a random scene."""
        street = Street.draw(generator)
        placements = Population(street, generator).fill()
        return cls.assemble(street, placements)

    @classmethod
    def assemble(cls, street: Street, placements: Sequence[Placement]) -> Self:
        """Return the scene of a street and the objects on it."""
        ground = street.ground()
        meshes = [ground, *(placement.mesh for placement in placements)]
        vertices = [ground.vertices, *(map(_placed_vertices, placements))]
        colours = [palette()[ground.materials]]
        colours += [placement.palette[placement.mesh.materials] for placement in placements]
        offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
        triangles = [mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=True)]
        corners, rows = np.concatenate(vertices), np.concatenate(triangles)
        return cls(
            street,
            placements,
            corners,
            rows.astype(np.uint32),
            np.repeat(np.arange(len(meshes), dtype=np.int32), [len(part) for part in triangles]),
            np.concatenate([mesh.materials for mesh in meshes]),
            np.concatenate(colours),
            _normals(corners, rows),
        )

    def actors(self) -> list[int]:
        """Return the instance numbers of cars, pedestrians and cyclists."""
        numbered = enumerate(self.placements, start=1)
        return [number for number, placement in numbered if placement.kind in CATEGORIES]

    def instance_classes(self) -> np.ndarray:
        """Return the uint8 semantic class of each instance number, including the ground."""
        kinds = ["ground", *(placement.kind for placement in self.placements)]
        return np.array([SEMANTIC_CLASSES.get(kind, 0) for kind in kinds], dtype=np.uint8)

    def instance_vertices(self, number: int) -> np.ndarray:
        """Return the (n, 3) vertices of one object in the LiDAR frame."""
        return _placed_vertices(self.placements[number - 1])


class Caster:
    """Casts rays into a mesh on one thread; several worker processes run at the same time.

    Args:
        vertices: (n, 3) float32.
        triangles: (m, 3) uint32 rows of `vertices`.
    """

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray) -> None:
        self._open3d: Any = load()
        self._scene = self._open3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles))

    def first_hits(self, rays: np.ndarray) -> Hits:
        """Return the first hit of (n, 6) float32 rays: origin and direction in the LiDAR frame."""
        hits = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        # "No hit" is the highest uint32, which is -1 when viewed as int32.
        triangle = hits["primitive_ids"].numpy().view(np.int32)
        return Hits(hits["t_hit"].numpy(), triangle)

    def all_hits(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return all hits of (n, 6) float32 rays: for each hit, the row of the ray and triangle."""
        hits = self._scene.list_intersections(self._tensor(rays), nthreads=1)
        ray, triangle = hits["ray_ids"].numpy(), hits["primitive_ids"].numpy()
        return ray.astype(np.int64), triangle.astype(np.int64)

    def _tensor(self, values: np.ndarray) -> Any:
        return self._open3d.core.Tensor.from_numpy(np.ascontiguousarray(values))


def _placed_vertices(placement: Placement) -> np.ndarray:
    """Return the (n, 3) float32 vertices of a placement in the LiDAR frame."""
    scaled = placement.mesh.vertices * placement.scale.astype(np.float32)
    rotated = scaled @ rotation_z(placement.yaw_rad).T.astype(np.float32)
    return np.asarray(rotated + placement.position.astype(np.float32))


def _normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return (m, 3) unit normals; zero for triangles without area."""
    first, second, third = (vertices[triangles[:, corner]] for corner in range(3))
    normals = np.cross(second - first, third - first)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.maximum(length, 1e-12), dtype=np.float32)
