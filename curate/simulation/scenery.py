"""Meshes of scenery: trees, poles, buildings, and clutter of the size of cars and people.

The clutter makes detection realistic. In the point cloud, a container or a dense hedge resembles a
car, a bin or a clipped shrub resembles a pedestrian, and a rack of bicycles resembles a cyclist.
The image shows the difference.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from curate.simulation.actors import bicycle
from curate.simulation.materials import Material
from curate.simulation.meshes import (
    Mesh,
    box,
    cylinder,
    ellipsoid,
    frustum,
    merge,
    rotation_z,
)

VARIANTS = 24
"""Number of different meshes of each kind of scenery."""

CAR_SIZED = ("container", "hedge", "trailer", "stack")
PERSON_SIZED = ("bin", "shrub", "column", "sign", "cabinet")
CYCLIST_SIZED = ("rack", "scooter")
CLUTTER = CAR_SIZED + PERSON_SIZED + CYCLIST_SIZED


@cache
def scenery_mesh(kind: str, variant: int) -> Mesh:
    """Return mesh number `variant` of a kind of scenery; it is the same in every process."""
    stream = list(_BUILDERS).index(kind)
    return _BUILDERS[kind](np.random.default_rng([100 + stream, variant]))


@cache
def shadow_mesh() -> Mesh:
    """Return a flat octagon of length and width 1, the shape of a shadow."""
    blunt = np.array([[0.5, 0.3], [0.3, 0.5], [-0.3, 0.5], [-0.5, 0.3]])
    outline = np.concatenate([blunt, -blunt])
    fan = np.arange(1, len(outline) - 1)
    return Mesh(
        np.column_stack([outline, np.zeros(len(outline))]).astype(np.float32),
        np.stack([np.zeros_like(fan), fan, fan + 1], axis=1),
        np.full(len(fan), Material.PAVEMENT, dtype=np.uint8),
    )


def scenery_colours(kind: str, generator: np.random.Generator) -> dict[Material, np.ndarray]:
    """Return random colours for one piece of scenery."""
    green = np.array([0.20, 0.33, 0.12]) * generator.uniform(0.6, 1.3, size=3)
    colours = {Material.FOLIAGE: green, Material.BARK: np.full(3, generator.uniform(0.15, 0.35))}
    if kind == "building":
        hues = [(0.72, 0.66, 0.55), (0.6, 0.58, 0.56), (0.55, 0.33, 0.26), (0.75, 0.72, 0.68)]
        hues += [(0.62, 0.5, 0.36), (0.5, 0.55, 0.58)]
        colours[Material.WALL] = np.array(hues[generator.integers(len(hues))])
        colours[Material.WALL] *= generator.uniform(0.75, 1.15)
        colours[Material.ROOF] = np.array([0.4, 0.26, 0.22]) * generator.uniform(0.5, 1.2)
        return colours
    colours[Material.CONCRETE] = np.full(3, generator.uniform(0.4, 0.68))
    if kind in ("pole", "sign"):
        colours[Material.METAL] = np.full(3, generator.uniform(0.15, 0.6))
        return colours
    coats = [(0.12, 0.3, 0.2), (0.5, 0.28, 0.1), (0.2, 0.28, 0.42), (0.5, 0.5, 0.48)]
    coats += [(0.6, 0.5, 0.15), (0.35, 0.12, 0.1), (0.3, 0.3, 0.3)]
    colours[Material.METAL] = np.array(coats[generator.integers(len(coats))])
    colours[Material.WOOD] = np.array([0.48, 0.35, 0.22]) * generator.uniform(0.6, 1.3)
    return colours


def _tree(generator: np.random.Generator) -> Mesh:
    """Return a trunk and a crown of several clumps."""
    trunk, radius = generator.uniform(1.8, 3.2), generator.uniform(0.10, 0.26)
    parts = [
        cylinder((0, 0, -0.3), (0, 0, trunk + 1.0), radius, Material.BARK, end_radius=radius * 0.7)
    ]
    spread = generator.uniform(1.0, 2.0)
    for _ in range(generator.integers(3, 6)):
        centre = generator.normal(
            (0, 0, trunk + spread), (0.5 * spread, 0.5 * spread, 0.4 * spread)
        )
        parts.append(_clump(generator, centre, spread * generator.uniform(0.6, 1.0, size=3)))
    return merge(parts)


def _clump(
    generator: np.random.Generator, centre: np.ndarray, radii: np.ndarray, sides: int = 8
) -> Mesh:
    """Return an ellipsoid of leaves with a ragged surface."""
    smooth = ellipsoid((0, 0, 0), radii, Material.FOLIAGE, sides=sides)
    ragged = smooth.vertices * generator.uniform(0.8, 1.12, size=(len(smooth.vertices), 1))
    return Mesh((ragged + centre).astype(np.float32), smooth.triangles, smooth.materials)


def _pole(generator: np.random.Generator) -> Mesh:
    """Return a lamp post or a plain mast."""
    height, radius = generator.uniform(4.5, 8.0), generator.uniform(0.06, 0.13)
    parts = [cylinder((0, 0, -0.3), (0, 0, height), radius, Material.METAL, sides=6)]
    if generator.random() < 0.6:
        arm = (1.3, 0, height + 0.2)
        parts.append(cylinder((0, 0, height - 0.1), arm, 0.05, Material.METAL, sides=5))
        parts.append(box((1.4, 0, height + 0.2), (0.6, 0.25, 0.12), Material.METAL))
    return merge(parts)


def _building(generator: np.random.Generator) -> Mesh:
    """Return a building with a flat or gabled roof and its front at y = 0; it extends to y > 0."""
    length, depth = generator.uniform(8, 20), generator.uniform(7, 12)
    height = generator.uniform(4, 14)
    parts = [box((0, depth / 2, height / 2 - 0.5), (length, depth, height + 1), Material.WALL)]
    if generator.random() < 0.6:
        rise = generator.uniform(1.5, 4)
        roof_centre = (0, depth / 2, height + rise / 2 - 0.01)
        size = (length + 0.6, depth + 0.6, rise)
        parts.append(frustum(roof_centre, size, (1.0, 0.05), Material.ROOF))
    for _ in range(generator.integers(0, 3)):  # bays and porches in front of the wall
        x = generator.uniform(-0.4, 0.4) * length
        tall = generator.uniform(2.2, max(2.3, height * 0.8))
        wide = generator.uniform(1.2, 3)
        parts.append(box((x, -0.2, tall / 2 - 0.4), (wide, 1.0, tall + 0.8), Material.WALL))
    return merge(parts)


def _wall(generator: np.random.Generator) -> Mesh:
    """Return a low garden wall along x."""
    size = (generator.uniform(5, 12), 0.25, generator.uniform(0.6, 1.5) + 0.3)
    return box((0, 0, size[2] / 2 - 0.3), size, Material.CONCRETE)


def _container(generator: np.random.Generator) -> Mesh:
    """Return a skip or a closed container with ribs."""
    length, width, height = generator.normal((4.0, 1.75, 1.5), (0.4, 0.12, 0.15))
    taper = (generator.uniform(1.0, 1.2) if generator.random() < 0.5 else 1.0, 1.0)
    body = frustum((0, 0, height / 2 + 0.08), (length, width, height), taper, Material.METAL)
    parts = [body, box((0, 0, 0.05), (length * 0.8, width * 0.8, 0.3), Material.TRIM)]
    for x in np.linspace(-0.4, 0.4, 4) * length:
        rib = (0.12, width + 0.12, height * 0.9)
        parts.append(box((x, 0, height / 2 + 0.08), rib, Material.METAL))
    return merge(parts)


def _hedge(generator: np.random.Generator) -> Mesh:
    """Return a dense, clipped hedge with the outline of a car."""
    length, width, height = generator.normal((3.9, 1.65, 1.5), (0.5, 0.15, 0.15))
    parts = [
        frustum(
            (0, 0, 0.45 * height - 0.15),
            (length, width, 0.9 * height + 0.3),
            (0.95, 0.9),
            Material.FOLIAGE,
        )
    ]
    for share in generator.uniform(-0.42, 0.42, size=5):
        radii = np.array([0.7, 0.5 * width, 0.3])
        centre = np.array([share * length, 0, 0.88 * height])
        parts.append(_clump(generator, centre, radii))
    return merge(parts)


def _trailer(generator: np.random.Generator) -> Mesh:
    """Return a trailer: a body on wheels with a canvas cover that is shaped like a cabin."""
    length, width, height = generator.normal((3.7, 1.7, 1.55), (0.35, 0.1, 0.12))
    return merge(
        [
            frustum((0, 0, 0.55), (length, width, 0.7), (0.98, 0.98), Material.WOOD),
            frustum(
                (generator.uniform(-0.3, 0.1), 0, 0.9 + (height - 0.9) / 2),
                (length * generator.uniform(0.55, 0.8), width * 0.95, height - 0.88),
                (0.75, 0.8),
                Material.METAL,
            ),
            *(
                cylinder((x, y, 0.27), (x, y * 1.1, 0.27), 0.27, Material.TRIM)
                for x in (-0.9, 0.9)
                for y in (-0.75, 0.75)
            ),
        ]
    )


def _stack(generator: np.random.Generator) -> Mesh:
    """Return a stack of crates and boards."""
    parts, level = [], 0.0
    footprint = generator.normal((3.6, 1.6), (0.4, 0.15))
    for _ in range(generator.integers(2, 5)):
        high = generator.uniform(0.3, 0.7)
        size = (*(footprint * generator.uniform(0.6, 1.0, size=2)), high)
        shift = generator.uniform(-0.2, 0.2, size=2)
        parts.append(box((*shift, level + high / 2), size, Material.WOOD))
        level += high
        if level > 1.3:
            break
    return merge(parts)


def _bin(generator: np.random.Generator) -> Mesh:
    """Return a tall waste bin, round or square, with a lid."""
    height, radius = generator.uniform(1.1, 1.7), generator.uniform(0.25, 0.36)
    if generator.random() < 0.5:
        body = cylinder((0, 0, 0), (0, 0, height), radius, Material.METAL, end_radius=radius * 1.1)
    else:
        size = (2 * radius, 1.8 * radius, height)
        body = frustum((0, 0, height / 2), size, (1.15, 1.15), Material.METAL)
    lid = ellipsoid((0, 0, height), (radius * 1.1, radius * 1.1, 0.12), Material.TRIM)
    return merge([body, lid])


def _shrub(generator: np.random.Generator) -> Mesh:
    """Return a clipped shrub or a small tree: a slim body with a round top."""
    height, radius = generator.normal((1.7, 0.3), (0.15, 0.05))
    radii = np.array([radius, radius, 0.34 * height])
    parts = [
        cylinder((0, 0, 0), (0, 0, 0.5 * height), 0.12, Material.BARK, sides=6),
        _clump(generator, np.array([0, 0, 0.5 * height]), radii),
        _clump(generator, np.array([0, 0, 0.9 * height]), np.array([0.14, 0.14, 0.16])),
    ]
    return merge(parts)


def _column(generator: np.random.Generator) -> Mesh:
    """Return a stone column or a hydrant with a head."""
    height, radius = generator.uniform(1.3, 1.8), generator.uniform(0.16, 0.28)
    neck = 0.82 * height
    head = (0, 0, 0.92 * height)
    return merge(
        [
            cylinder((0, 0, 0), (0, 0, neck), radius, Material.CONCRETE, end_radius=radius * 0.85),
            ellipsoid(head, (radius * 0.7, radius * 0.7, 0.09 * height), Material.CONCRETE),
        ]
    )


def _sign(generator: np.random.Generator) -> Mesh:
    """Return a road sign on a post, or a low board."""
    height = generator.uniform(1.7, 2.6)
    post = cylinder((0, 0, -0.2), (0, 0, height), 0.04, Material.METAL, sides=6)
    board = (0.04, generator.uniform(0.45, 0.7), generator.uniform(0.45, 0.9))
    plate = box((-0.06, 0, height - board[2] / 2), board, Material.RETROREFLECTOR)
    if generator.random() < 0.5:
        return merge([post, plate])
    low = box((-0.06, 0, 0.75), (0.08, 0.55, 1.0), Material.WOOD)
    return merge([post, plate, low])


def _cabinet(generator: np.random.Generator) -> Mesh:
    """Return a meter, parcel or cable cabinet."""
    size = generator.normal((0.45, 0.6, 1.45), (0.08, 0.12, 0.2))
    return merge(
        [
            box((0, 0, size[2] / 2), size, Material.METAL),
            frustum(
                (0, 0, size[2] + 0.04),
                (size[0] + 0.1, size[1] + 0.1, 0.1),
                (0.6, 0.6),
                Material.TRIM,
            ),
        ]
    )


def _rack(generator: np.random.Generator) -> Mesh:
    """Return one to four bicycles side by side without riders, in some variants with a shrub."""
    parts = []
    for index in range(generator.integers(1, 5)):
        tilt = rotation_z(generator.normal(0, 0.08))
        parts.append(bicycle(generator).moved(tilt, (generator.normal(0, 0.08), 0.5 * index, 0)))
    if generator.random() < 0.5:
        parts.append(_clump(generator, np.array([-0.2, 0.2, 1.25]), np.array([0.3, 0.3, 0.45])))
    return merge(parts)


def _scooter(generator: np.random.Generator) -> Mesh:
    """Return a motor scooter under a canvas cover."""
    height = generator.normal(1.4, 0.15)
    return merge(
        [
            frustum((0, 0, 0.4), (1.7, 0.55, 0.8), (0.8, 0.7), Material.METAL),
            frustum(
                (-0.05, 0, 0.78 + (height - 0.8) / 2),
                (0.9, 0.45, height - 0.78),
                (0.4, 0.6),
                Material.METAL,
            ),
            *(_tyre(x) for x in (-0.6, 0.6)),
        ]
    )


def _tyre(x: float) -> Mesh:
    """Return a small wheel at x."""
    return cylinder((x, -0.07, 0.25), (x, 0.07, 0.25), 0.25, Material.RUBBER)


_BUILDERS: dict[str, Callable[[np.random.Generator], Mesh]] = {
    "tree": _tree,
    "pole": _pole,
    "building": _building,
    "wall": _wall,
    "container": _container,
    "hedge": _hedge,
    "trailer": _trailer,
    "stack": _stack,
    "bin": _bin,
    "shrub": _shrub,
    "column": _column,
    "sign": _sign,
    "cabinet": _cabinet,
    "rack": _rack,
    "scooter": _scooter,
}
