"""Meshes are closed, oriented outwards, and of the stated size."""

import numpy as np
import pytest

from curate.simulation import actors, scenery
from curate.simulation.materials import Material
from curate.simulation.meshes import box, cylinder, ellipsoid, frustum, merge, ring

STUFF = Material.METAL


def volume(mesh):
    """Return the signed volume: positive if triangles turn counter-clockwise seen from outside."""
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(float) for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize(
    ("mesh", "expected", "tolerance"),
    [
        (box((1, 2, 3), (4, 2, 1), STUFF), 8.0, 1e-5),
        (frustum((0, 0, 0), (2, 2, 3), (0.5, 0.5), STUFF), 7.0, 1e-5),
        (cylinder((0, 0, 0), (1, 2, 2), 0.5, STUFF, sides=64), np.pi * 0.25 * 3, 5e-3),
        (ellipsoid((5, 0, 0), (1, 2, 3), STUFF, sides=64), 8 * np.pi, 2e-2),
        (ring((0, 0, 1), 1.0, 0.2, 0.1, STUFF, sides=64), np.pi * 0.036, 5e-3),
    ],
)
def test_solids_have_their_volume(mesh, expected, tolerance):
    """The divergence theorem gives the textbook volume, with the outward sign."""
    assert volume(mesh) == pytest.approx(expected, rel=tolerance)


def test_merging_keeps_every_part():
    """Volumes add up, and each triangle keeps its material."""
    parts = [box((0, 0, 0), (1, 1, 1), Material.PAINT), box((3, 0, 0), (2, 1, 1), Material.GLASS)]
    merged = merge(parts)
    assert volume(merged) == pytest.approx(3.0)
    assert (merged.materials == np.repeat([Material.PAINT, Material.GLASS], 12)).all()


@pytest.mark.parametrize(
    ("category", "low", "high"),
    [
        ("Car", (3.0, 1.4, 1.2), (5.3, 2.1, 2.0)),
        ("Pedestrian", (0.25, 0.4, 0.95), (1.6, 1.1, 2.05)),
        ("Cyclist", (1.5, 0.4, 1.6), (2.0, 0.8, 2.05)),
    ],
)
def test_actors_have_plausible_and_different_sizes(category, low, high):
    """Length, width and height of every variant are typical for its kind, and they vary."""
    meshes = [actors.actor_mesh(category, number) for number in range(actors.VARIANTS[category])]
    sizes = np.array([mesh.size for mesh in meshes])
    assert (sizes >= low).all()
    assert (sizes <= high).all()
    assert (sizes.std(axis=0) > 0.01).all()
    assert all(volume(mesh) > 0 for mesh in meshes)


@pytest.mark.parametrize("kind", scenery.CLUTTER)
def test_clutter_stands_on_the_ground(kind):
    """It starts at or just below z = 0 and is not taller than the object that it resembles."""
    for number in range(scenery.VARIANTS):
        low, high = scenery.scenery_mesh(kind, number).bounds
        assert -0.4 <= low[2] <= 0.05
        assert 0.3 < high[2] < 3.0
