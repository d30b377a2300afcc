"""The camera's image and semantic map: one ray per pixel, shaded, textured and made noisy."""

from dataclasses import dataclass
from functools import cache
from typing import Self

import cv2
import numpy as np

from curate.datasets.synthetic.materials import TEXTURE, Material
from curate.datasets.synthetic.rig import IMAGE_SIZE, CameraRig
from curate.datasets.synthetic.scene import Caster, Scene

_TILE = 256  # pixels of the repeating texture
_HAZE_M = 420.0
_WINDOW = np.array([0.11, 0.13, 0.16], dtype=np.float32)
_MARKING = np.array([0.78, 0.78, 0.76], dtype=np.float32)


@dataclass(frozen=True)
class View:
    """What the camera sees.

    Attributes:
        image: (height, width, 3) uint8 RGB.
        semantic: (height, width) uint8 class ids, see `SEMANTIC_CLASSES`.
        things: (height, width) int32, the thing in each pixel, -1 for the sky.
    """

    image: np.ndarray
    semantic: np.ndarray
    things: np.ndarray


@dataclass(frozen=True)
class Light:
    """Sun, sky and exposure of one frame.

    Attributes:
        sun: (3,) unit vector towards the sun, LiDAR frame.
        direct: strength of the sun.
        ambient: strength of the sky.
        tint: (3,) colour balance.
        sky: (2, 3) RGB at the horizon and overhead.
        noise: standard deviation of the pixel noise, grey levels.
    """

    sun: np.ndarray
    direct: float
    ambient: float
    tint: np.ndarray
    sky: np.ndarray
    noise: float

    @classmethod
    def draw(cls, generator: np.random.Generator) -> Self:
        """From a bright to an overcast day, well or badly exposed."""
        azimuth, elevation = generator.uniform(-np.pi, np.pi), generator.uniform(0.35, 1.2)
        sun = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
        overcast, exposure = generator.random(), np.exp(generator.normal(0, 0.22))
        blue, grey = np.array([[0.8, 0.86, 0.92], [0.38, 0.55, 0.82]]), np.full((2, 3), 0.82)
        return cls(
            sun / np.linalg.norm(sun),
            direct=float(0.95 * exposure * (1 - 0.85 * overcast)),
            ambient=float(exposure * (0.5 + 0.4 * overcast)),
            tint=generator.normal(1, 0.04, size=3),
            sky=(blue + (grey - blue) * overcast) * exposure,
            noise=float(generator.uniform(1.5, 4.5)),
        )

    def shade(self, normals: np.ndarray, colours: np.ndarray) -> np.ndarray:
        """(m, 3) float32 colours of lit surfaces."""
        facing = np.clip(normals @ self.sun, 0, None)
        upward = 0.75 + 0.25 * normals[:, 2]
        strength = self.ambient * upward + self.direct * facing
        return np.asarray(colours * strength[:, None] * self.tint, dtype=np.float32)


def render(scene: Scene, caster: Caster, rig: CameraRig, generator: np.random.Generator) -> View:
    """The camera's view of a scene."""
    width, height = IMAGE_SIZE
    rays = rig.rays()
    hits = caster.first_hits(rays)
    light = Light.draw(generator)
    colours = np.empty((len(rays), 3), dtype=np.float32)
    seen = hits.triangle >= 0
    colours[~seen] = _sky(light, rays[~seen, 5])
    colours[seen] = _surfaces(scene, light, rays[seen], hits.distance[seen], hits.triangle[seen])
    things = np.full(len(rays), -1, dtype=np.int32)
    things[seen] = scene.things[hits.triangle[seen]]
    semantic = np.append(scene.thing_classes(), np.uint8(0))[things]  # the sky takes the last
    return View(
        _expose(colours.reshape(height, width, 3), light.noise, generator),
        semantic.reshape(height, width),
        things.reshape(height, width),
    )


def _sky(light: Light, upward: np.ndarray) -> np.ndarray:
    """(n, 3) colour of the sky by the z of the direction."""
    share = np.clip(upward * 3, 0, 1)[:, None]
    return np.asarray(light.sky[0] + (light.sky[1] - light.sky[0]) * share, dtype=np.float32)


def _surfaces(
    scene: Scene, light: Light, rays: np.ndarray, distance: np.ndarray, triangle: np.ndarray
) -> np.ndarray:
    """(n, 3) colours of the surfaces that rays hit."""
    colours = light.shade(scene.normals, scene.colours)[triangle]
    points = rays[:, :3] + rays[:, 3:] * distance[:, None]
    material, normal = scene.materials[triangle], scene.normals[triangle]
    flat = np.abs(normal[:, 2]) > 0.7
    across = np.where(flat, points[:, 0], normal[:, 0] * points[:, 1] - normal[:, 1] * points[:, 0])
    along = np.where(flat, points[:, 1], points[:, 2])
    _paint_markings(scene, light, colours, points, material)
    _paint_windows(light, colours, across, along, (material == Material.WALL) & ~flat)
    amplitude, scale = TEXTURE[material].T
    column = (across * scale).astype(np.int32) & (_TILE - 1)
    row = (along * scale).astype(np.int32) & (_TILE - 1)
    amplitude = amplitude * np.exp(distance * np.float32(-1 / 40))
    colours *= (1 + amplitude * _texture_tile()[row, column])[:, None]
    haze = np.exp(distance * np.float32(-1 / _HAZE_M))[:, None]
    return np.asarray(light.sky[0] * (1 - haze) + colours * haze, dtype=np.float32)


def _paint_markings(
    scene: Scene, light: Light, colours: np.ndarray, points: np.ndarray, material: np.ndarray
) -> None:
    """Dashed lines between lanes, a line along the parking strips."""
    street = scene.street
    road = np.flatnonzero((material == Material.ASPHALT) & (points[:, 2] < 0))
    s, d = street.to_road(points[road, 0], points[road, 1])
    edges = street.axis_d + street.lane_m * np.arange(-street.lanes, street.lanes + 1)
    nearest = np.abs(d[:, None] - edges.astype(np.float32)).argmin(axis=1)
    on_line = np.abs(d - edges[nearest]) < 0.08
    inner = (nearest > 0) & (nearest < len(edges) - 1)
    dashed = np.mod(s, 9.0) < 4.0
    painted = road[on_line & (dashed | ~inner) & ~street.in_crossing(s, 1.5)]
    colours[painted] = _MARKING * (light.ambient + 0.6 * light.direct)


def _paint_windows(
    light: Light, colours: np.ndarray, across: np.ndarray, along: np.ndarray, wall: np.ndarray
) -> None:
    """Dark windows in rows on the walls of buildings."""
    rows = np.flatnonzero(wall)
    column, storey = np.mod(across[rows], 2.7), np.mod(along[rows] + 1.7, 2.9)
    window = (column > 0.8) & (column < 1.95) & (storey > 0.9) & (storey < 2.3)
    colours[rows[window]] = _WINDOW * (0.6 + light.ambient)


def _expose(colours: np.ndarray, noise: float, generator: np.random.Generator) -> np.ndarray:
    """Blur of the lens, gamma, pixel noise, and rounding to uint8."""
    softened = cv2.GaussianBlur(colours, (3, 3), 0.55)
    levels = 255 * np.sqrt(np.clip(softened, 0, 1))  # gamma 2
    grain = generator.standard_normal(levels.shape[:2], dtype=np.float32) * np.float32(noise)
    return np.clip(levels + grain[..., None], 0, 255).astype(np.uint8)


@cache
def _texture_tile() -> np.ndarray:
    """(256, 256) float32 noise of mean 0 and deviation 1 that repeats without a seam."""
    generator = np.random.default_rng(0)
    tile = np.zeros((_TILE, _TILE))
    for cells, weight in ((256, 1.0), (64, 0.8), (16, 0.7)):
        coarse = generator.normal(size=(cells, cells))
        tile += weight * np.kron(coarse, np.ones((_TILE // cells, _TILE // cells)))
    return np.asarray((tile - tile.mean()) / tile.std(), dtype=np.float32)
