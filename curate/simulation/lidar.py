"""Simulation of a 64-beam LiDAR sweep with range noise, intensity and lost pulses.

The beams are those of the Velodyne HDL-64E, which recorded KITTI: 32 beams downward from +2 degrees
in steps of 1/3 degree, then 32 in steps of 1/2 degree, with 2,000 pulses per turn and beam. A KITTI
sweep covers 360 degrees. A simulated sweep covers only 110 degrees around the driving direction:
the camera's field of view (about 81 degrees) and a margin on both sides. All labeled objects are
inside.
"""

import numpy as np

from curate.simulation.materials import COLOUR_SHARE, LOSS, REFLECTIVITY, ROUGHNESS_M
from curate.simulation.scene import Caster, Scene

SECTOR_DEG = 110.0
AZIMUTH_STEP_DEG = 0.18
MAX_RANGE_M = 80.0
_RANGE_NOISE_M = 0.02
_ELEVATIONS_RAD = np.deg2rad(
    np.concatenate([2.0 - np.arange(32) / 3, 2.0 - 32 / 3 - 0.17 - np.arange(32) / 2])
)


def sweep(scene: Scene, caster: Caster, generator: np.random.Generator) -> np.ndarray:
    """Simulate one sweep.

    Returns:
        (n, 4) float32: x, y, z in metres in the LiDAR frame, and intensity in [0, 1].
    """
    directions = _directions(generator)
    rays = np.concatenate([np.zeros_like(directions), directions], axis=1)
    hits = caster.first_hits(rays)
    in_range = np.flatnonzero(hits.distance < MAX_RANGE_M)
    distance, triangle = hits.distance[in_range], hits.triangle[in_range]
    directions, material = directions[in_range], scene.materials[triangle]
    incidence = np.abs(np.einsum("ij,ij->i", scene.normals[triangle], directions))

    noise = generator.standard_normal((3, len(in_range)), dtype=np.float32)
    noisy = distance + noise[0] * (_RANGE_NOISE_M + ROUGHNESS_M[material])
    brightness = scene.colours[triangle].mean(axis=1)
    intensity = _intensity(material, brightness, incidence, distance, noise[1])
    kept = generator.random(len(in_range)) > _loss(material, incidence, distance, intensity)
    points = np.column_stack([directions * noisy[:, None], intensity])[kept]
    return np.ascontiguousarray(points, dtype=np.float32)


def _directions(generator: np.random.Generator) -> np.ndarray:
    """Return (n, 3) float32 unit directions, beam by beam, with small random elevation errors."""
    start = generator.uniform(0, AZIMUTH_STEP_DEG)
    half = SECTOR_DEG / 2
    azimuths = np.deg2rad(np.arange(half - start, -half, -AZIMUTH_STEP_DEG)).astype(np.float32)
    jitter = generator.normal(0, np.deg2rad(0.02), size=len(_ELEVATIONS_RAD))
    elevations = (_ELEVATIONS_RAD + jitter).astype(np.float32)
    cos = np.cos(elevations)[:, None]
    grid = np.empty((len(elevations), len(azimuths), 3), dtype=np.float32)
    grid[..., 0] = cos * np.cos(azimuths)
    grid[..., 1] = cos * np.sin(azimuths)
    grid[..., 2] = np.sin(elevations)[:, None]
    return grid.reshape(-1, 3)


def _intensity(
    material: np.ndarray,
    brightness: np.ndarray,
    incidence: np.ndarray,
    distance: np.ndarray,
    noise: np.ndarray,
) -> np.ndarray:
    """Return (n,) intensities: the reflectivity, lower at oblique incidence and at distance."""
    share = COLOUR_SHARE[material]
    reflectivity = REFLECTIVITY[material] * (1 - share + 1.8 * share * brightness)
    returned = reflectivity * (0.45 + 0.55 * incidence) * np.exp(-distance / 140)
    return np.asarray(np.clip(returned + 0.03 * noise, 0, 0.99))


def _loss(
    material: np.ndarray, incidence: np.ndarray, distance: np.ndarray, intensity: np.ndarray
) -> np.ndarray:
    """Return (n,) the probability that a pulse is lost.

    It depends on the material, grazing incidence, and low intensity at long range.
    """
    grazing = np.exp(-incidence / 0.02)
    faint = np.clip((distance - 25) / 90, 0, 1) * np.clip(1.2 - 3 * intensity, 0, 1)
    kept = (1 - LOSS[material]) * (1 - 0.5 * grazing) * (1 - faint)
    return np.asarray(1 - kept)
