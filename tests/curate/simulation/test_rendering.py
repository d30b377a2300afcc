"""The simulated sweep and image on handmade scenes."""

import numpy as np

from curate.geometry.projection import project_points
from curate.simulation.camera import render
from curate.simulation.lidar import MAX_RANGE_M, SECTOR_DEG, sweep
from curate.simulation.materials import Material
from curate.simulation.meshes import box
from curate.simulation.pixels import cast_pixels
from curate.simulation.rig import IMAGE_SIZE
from curate.simulation.scene import Caster, Scene
from curate.simulation.street import SENSOR_HEIGHT_M


def points_of(scene, seed=0):
    """Return the sweep of a scene."""
    return sweep(scene, Caster(scene.vertices, scene.triangles), np.random.default_rng(seed))


def test_an_empty_street_returns_level_ground(scene_of):
    """All points are at the ground's height, within the noise, and within the sector."""
    points = points_of(scene_of())
    near = points[np.hypot(points[:, 0], points[:, 1]) < 10]
    azimuths = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    assert points.dtype == np.float32
    assert np.abs(np.median(near[near[:, 1] > -1.5][:, 2]) + SENSOR_HEIGHT_M) < 0.02
    assert np.abs(azimuths).max() <= SECTOR_DEG / 2 + 0.5
    assert np.linalg.norm(points[:, :3], axis=1).max() < MAX_RANGE_M + 0.2
    assert points[:, 3].min() >= 0
    assert points[:, 3].max() < 1


def test_a_wall_is_measured_at_its_distance_with_noise(scene_of):
    """Ranges to a flat wall scatter by about two centimetres."""
    wall = box((0, 0, 2), (0.2, 12, 4), Material.CONCRETE)
    points = points_of(scene_of((wall, 20.1, 0.0, 0.0)))
    on_wall = points[(points[:, 2] > -1.5) & (np.abs(points[:, 1]) < 5)]
    assert abs(on_wall[:, 0].mean() - 20.0) < 0.005
    assert 0.01 < on_wall[:, 0].std() < 0.03


def test_far_and_dark_surfaces_lose_more_pulses(scene_of):
    """A dark wall returns fewer pulses from 70 m than from 10 m."""

    def share(distance):
        wall = box((0, 0, 10), (0.2, 300, 40), Material.TRIM)
        points = points_of(scene_of((wall, distance + 0.1, 0.0, 0.0)))
        inside = points[np.abs(points[:, 1]) < 0.3 * distance]
        beams = np.sum(inside[:, 2] > -1.5)
        azimuths = 2 * np.degrees(np.arctan(0.3)) / 0.18
        lowest = np.degrees(np.arctan(-1.5 / distance))
        return beams / azimuths / np.sum(2 - np.arange(32) / 3 > lowest)

    assert share(70.0) < 0.75 * share(10.0)


def test_retroreflectors_have_high_intensity(scene_of):
    """A plate of retroreflector returns more intensity than rubber."""
    plates = [box((0, 0, 1), (0.1, 3, 2), kind) for kind in (Material.RETROREFLECTOR, 5)]
    points = points_of(scene_of((plates[0], 12.0, 3.0, 0.0), (plates[1], 12.0, -3.0, 0.0)))
    raised = points[(points[:, 2] > -1.4) & (points[:, 0] < 13)]
    assert raised[raised[:, 1] > 0, 3].mean() > 0.7
    assert raised[raised[:, 1] < 0, 3].mean() < 0.2


def test_the_sparse_cast_agrees_with_a_ray_per_pixel(rig):
    """Filling between equal pixels changes less than one pixel in a hundred."""
    scene = Scene.draw(np.random.default_rng(3))
    caster = Caster(scene.vertices, scene.triangles)
    sparse = cast_pixels(caster, rig)
    full = caster.first_hits(rig.rays(np.arange(IMAGE_SIZE[0] * IMAGE_SIZE[1])))
    same = sparse.triangle == full.triangle
    assert same.mean() > 0.99
    hit = same & (full.distance < 150)
    np.testing.assert_allclose(sparse.distance[hit], full.distance[hit], rtol=0.02)


def test_pixels_agree_with_the_projection(scene_of, rig):
    """The middle of a car's side, projected by the calibration, is a pixel of the car."""
    scene = scene_of(("Car", 15.0, 3.0, 0.3))
    view = render(scene, Caster(scene.vertices, scene.triangles), rig, np.random.default_rng(0))
    middle = np.array([[15.0, 3.0, -SENSOR_HEIGHT_M + 0.6]])
    (column, row), _ = project_points(middle, rig.calibration)[0][0], None
    assert view.semantic[round(row), round(column)] == 1
    pixels, _ = project_points(scene.instance_vertices(1), rig.calibration)
    rows, columns = np.nonzero(view.semantic)
    assert columns.min() >= pixels[:, 0].min() - 1
    assert columns.max() <= pixels[:, 0].max() + 1
    assert rows.min() >= pixels[:, 1].min() - 1
    assert rows.max() <= pixels[:, 1].max() + 1
    assert (view.instances[view.semantic == 1] == 1).all()


def test_light_and_noise_differ_between_frames(scene_of, rig):
    """The same scene under another generator has another brightness and noise."""
    scene = scene_of(("Car", 15.0, 3.0, 0.3))
    caster = Caster(scene.vertices, scene.triangles)
    images = [render(scene, caster, rig, np.random.default_rng(seed)).image for seed in range(6)]
    assert np.std([image.mean() for image in images]) > 5
    assert images[0].shape == (375, 1242, 3)
    assert images[0].dtype == np.uint8
