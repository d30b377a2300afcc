"""Rendering of the camera's image and semantic map: ray casting, shading, texture and noise."""

from dataclasses import dataclass
from functools import cache
from typing import Self

import cv2
import numpy as np

from curate.simulation.materials import TEXTURE
from curate.simulation.pixels import cast_pixels
from curate.simulation.rig import IMAGE_SIZE, CameraRig
from curate.simulation.scene import Caster, Scene
from curate.simulation.shading import TILE, Air, Markings, Surfaces, shade
from curate.simulation.street import Street

_WINDOW = np.array([0.11, 0.13, 0.16])
_LINE_PAINT = np.array([0.78, 0.78, 0.76])


@dataclass(frozen=True)
class View:
    """The image of a scene and its ground truth.

    Attributes:
        image: (height, width, 3) uint8 RGB.
        semantic: (height, width) uint8 class ids, see `SEMANTIC_CLASSES`.
        instances: (height, width) int32 instance number of each pixel, as in `Scene.instances`; -1
            is the sky.
    """

    image: np.ndarray
    semantic: np.ndarray
    instances: np.ndarray


@dataclass(frozen=True)
class Light:
    """Sun, sky and exposure of one frame.

    Attributes:
        sun: (3,) unit vector towards the sun, LiDAR frame.
        direct: strength of the sunlight.
        ambient: strength of the light from the sky.
        tint: (3,) colour balance.
        sky: (2, 3) RGB of the sky at the horizon and overhead.
        grain: strength of the pixel noise, in grey levels.
        grain_offset: row and column of the noise tile at which the image begins.
    """

    sun: np.ndarray
    direct: float
    ambient: float
    tint: np.ndarray
    sky: np.ndarray
    grain: float
    grain_offset: tuple[int, int]

    @classmethod
    def draw(cls, generator: np.random.Generator) -> Self:
        """Return the light of a random day, bright to overcast, with a random exposure."""
        azimuth, elevation = generator.uniform(-np.pi, np.pi), generator.uniform(0.35, 1.2)
        sun = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
        overcast, exposure = generator.random(), np.exp(generator.normal(0, 0.22))
        blue, grey = np.array([[0.8, 0.86, 0.92], [0.38, 0.55, 0.82]]), np.full((2, 3), 0.82)
        row, column = generator.integers(TILE, size=2)
        return cls(
            sun / np.linalg.norm(sun),
            direct=float(0.95 * exposure * (1 - 0.85 * overcast)),
            ambient=float(exposure * (0.5 + 0.4 * overcast)),
            tint=generator.normal(1, 0.04, size=3),
            sky=(blue + (grey - blue) * overcast) * exposure,
            grain=float(generator.uniform(2, 6)),
            grain_offset=(int(row), int(column)),
        )

    def shade(self, normals: np.ndarray, colours: np.ndarray) -> np.ndarray:
        """Return the (m, 3) float32 colours of (m, 3) surface colours under this light."""
        facing = np.clip(normals @ self.sun, 0, None)
        upward = 0.75 + 0.25 * normals[:, 2]
        strength = self.ambient * upward + self.direct * facing
        return np.asarray(colours * strength[:, None] * self.tint, dtype=np.float32)

    def air(self) -> Air:
        """Return sky, windows and grain in the form that the kernel needs."""
        window = _WINDOW * (0.6 + self.ambient)
        return Air(
            self.sky.astype(np.float32),
            window.astype(np.float32),
            np.float32(self.grain),
            self.grain_offset,
        )


def render(scene: Scene, caster: Caster, rig: CameraRig, generator: np.random.Generator) -> View:
    """Render the camera's view of a scene, in light drawn from `generator`."""
    hits = cast_pixels(caster, rig)
    light = Light.draw(generator)
    surfaces = Surfaces(
        light.shade(scene.normals, scene.colours),
        scene.normals,
        scene.materials,
        TEXTURE,
        _noise_tile(),
    )
    inverse, origin = (part.astype(np.float32) for part in rig.pixel_geometry())
    shape = IMAGE_SIZE[::-1]
    triangle = hits.triangle.reshape(shape)
    sharp = shade(
        inverse,
        origin,
        hits.distance.reshape(shape),
        triangle,
        surfaces,
        _markings(scene.street, light),
        light.air(),
    )
    # The sky has triangle -1, which selects the last entry of these tables.
    instances = np.append(scene.instances, np.int32(-1))[triangle]
    semantic = np.append(scene.instance_classes(), np.uint8(0))[instances]
    image = cv2.GaussianBlur(sharp, (3, 3), 0.55)  # the blur of the lens
    return View(image, semantic, instances)


def _markings(street: Street, light: Light) -> Markings:
    """Return the road markings of a street, interrupted where another street crosses."""
    s, d, _ = street.origin
    lines = street.axis_d + street.lane_m * np.arange(-street.lanes, street.lanes + 1) - d
    half = street.crossing_half_m + 1.5
    crossing = (
        np.zeros(2)
        if street.crossing_s is None
        else street.crossing_s - s + np.array([-half, half])
    )
    paint = _LINE_PAINT * (light.ambient + 0.6 * light.direct)
    return Markings(
        np.float32(np.cos(street.heading_rad)),
        np.float32(np.sin(street.heading_rad)),
        lines.astype(np.float32),
        crossing.astype(np.float32),
        paint.astype(np.float32),
    )


@cache
def _noise_tile() -> np.ndarray:
    """Return (256, 256) float32 noise of mean 0 and standard deviation 1 that tiles seamlessly."""
    generator = np.random.default_rng(0)
    tile = np.zeros((TILE, TILE))
    for cells, weight in ((256, 1.0), (64, 0.6), (16, 0.5)):
        coarse = generator.normal(size=(cells, cells))
        tile += weight * np.kron(coarse, np.ones((TILE // cells, TILE // cells)))
    return np.asarray((tile - tile.mean()) / tile.std(), dtype=np.float32)
