"""Compiled kernels of the camera: the rays of its pixels, and the colour of what they hit."""

from typing import NamedTuple

import numpy as np
from numba import njit

from curate.datasets.synthetic.materials import Material

TILE = 256  # pixels of the repeating texture and grain
_HAZE_M = 420.0
_ASPHALT, _WALL = int(Material.ASPHALT), int(Material.WALL)


class Surfaces(NamedTuple):
    """What the kernel needs of the scene's m triangles.

    Attributes:
        lit: (m, 3) float32 RGB of the lit surface.
        normals: (m, 3) float32.
        materials: (m,) uint8.
        texture: (k, 2) float32 strength and pixels per metre by material.
        tile: (256, 256) float32 noise of mean 0 and deviation 1.
    """

    lit: np.ndarray
    normals: np.ndarray
    materials: np.ndarray
    texture: np.ndarray
    tile: np.ndarray


class Markings(NamedTuple):
    """Where the road is painted, in road coordinates.

    Attributes:
        cos: of the street's heading.
        sin: of the street's heading.
        lines_d: (n,) float32 d of the lines, from right to left; the inner ones are dashed.
        crossing_s: (2,) float32 where a crossing street begins and ends; NaN for none.
        colour: (3,) float32 of the paint, lit.
    """

    cos: float
    sin: float
    lines_d: np.ndarray
    crossing_s: np.ndarray
    colour: np.ndarray


class Air(NamedTuple):
    """Sky, haze, windows and the sensor's grain.

    Attributes:
        sky: (2, 3) float32 RGB at the horizon and overhead.
        window: (3,) float32 RGB of window panes.
        grain: strength of the noise, grey levels.
        grain_offset: rows and columns by which the grain is shifted.
    """

    sky: np.ndarray
    window: np.ndarray
    grain: float
    grain_offset: tuple[int, int]


@njit(cache=True, nogil=True)
def pixel_rays(inverse: np.ndarray, origin: np.ndarray, pixels: np.ndarray, width: int) -> np.ndarray:
    """Rays through pixel centres.

    Args:
        inverse: (3, 3) from homogeneous pixels to directions.
        origin: (3,) the camera's centre.
        pixels: (n,) row * width + column; integers are centres.
        width: of the image.

    Returns:
        (n, 6) float32 origin and unit direction.
    """
    rays = np.empty((len(pixels), 6), dtype=np.float32)
    for i in range(len(pixels)):
        row, column = divmod(pixels[i], width)
        x = inverse[0, 0] * column + inverse[0, 1] * row + inverse[0, 2]
        y = inverse[1, 0] * column + inverse[1, 1] * row + inverse[1, 2]
        z = inverse[2, 0] * column + inverse[2, 1] * row + inverse[2, 2]
        length = np.sqrt(x * x + y * y + z * z)
        rays[i, 0], rays[i, 1], rays[i, 2] = origin[0], origin[1], origin[2]
        rays[i, 3], rays[i, 4], rays[i, 5] = x / length, y / length, z / length
    return rays


@njit(cache=True, nogil=True)
def _is_painted(x: float, y: float, markings: Markings) -> bool:
    """Whether a place on the asphalt carries a line."""
    d = markings.cos * y - markings.sin * x
    last = len(markings.lines_d) - 1
    for line in range(last + 1):
        if abs(d - markings.lines_d[line]) < 0.08:
            s = markings.cos * x + markings.sin * y
            if markings.crossing_s[0] < s < markings.crossing_s[1]:
                return False
            return line in (0, last) or s % 9.0 < 4.0
    return False


@njit(cache=True, nogil=True)
def _is_window(across: float, along: float) -> bool:
    """Whether a place on a wall lies in a window, by metres across the wall and of height."""
    column, storey = across % 2.7, (along + 1.7) % 2.9
    return 0.8 < column < 1.95 and 0.9 < storey < 2.3


@njit(cache=True, nogil=True)
def shade(
    rays: np.ndarray,
    distance: np.ndarray,
    triangle: np.ndarray,
    width: int,
    surfaces: Surfaces,
    markings: Markings,
    air: Air,
) -> np.ndarray:
    """The image.

    Args:
        rays: (n, 6) float32, row by row.
        distance: (n,) float32 metres along each ray.
        triangle: (n,) int32 what it hits, -1 for the sky.
        width: of the image.
        surfaces: of the scene.
        markings: of the road.
        air: and the sensor.

    Returns:
        (n / width, width, 3) uint8 RGB.
    """
    image = np.empty((len(rays) // width, width, 3), dtype=np.uint8)
    colour = np.empty(3, dtype=np.float32)
    for i in range(len(rays)):
        row, column = divmod(i, width)
        if triangle[i] < 0:
            share = min(max(3 * rays[i, 5], 0.0), 1.0)
            for k in range(3):
                colour[k] = air.sky[0, k] + (air.sky[1, k] - air.sky[0, k]) * share
        else:
            _surface(colour, rays[i], distance[i], triangle[i], surfaces, markings, air)
        grain_row, grain_column = row + air.grain_offset[0], column + air.grain_offset[1]
        grain = air.grain * surfaces.tile[grain_row % TILE, grain_column % TILE]
        for k in range(3):  # gamma 2
            level = 255 * np.sqrt(min(max(colour[k], 0.0), 1.0)) + grain
            image[row, column, k] = np.uint8(min(max(level, 0.0), 255.0))
    return image


@njit(cache=True, nogil=True)
def _surface(
    colour: np.ndarray,
    ray: np.ndarray,
    distance: float,
    triangle: int,
    surfaces: Surfaces,
    markings: Markings,
    air: Air,
) -> None:
    """Writes the colour of one hit: paint or window or lit surface, texture, haze."""
    x = ray[0] + ray[3] * distance
    y = ray[1] + ray[4] * distance
    z = ray[2] + ray[5] * distance
    normal, material = surfaces.normals[triangle], surfaces.materials[triangle]
    flat = abs(normal[2]) > 0.7
    across = x if flat else normal[0] * y - normal[1] * x
    along = y if flat else z
    for k in range(3):
        colour[k] = surfaces.lit[triangle, k]
    if material == _ASPHALT and _is_painted(x, y, markings):
        for k in range(3):
            colour[k] = markings.colour[k]
    elif material == _WALL and not flat and _is_window(across, along):
        for k in range(3):
            colour[k] = air.window[k]
    scale = surfaces.texture[material, 1]
    texel = surfaces.tile[int(np.floor(across * scale)) % TILE, int(np.floor(along * scale)) % TILE]
    contrast = 1 + surfaces.texture[material, 0] * np.exp(-distance / 40) * texel
    haze = np.exp(-distance / _HAZE_M)
    for k in range(3):
        colour[k] = air.sky[0, k] * (1 - haze) + colour[k] * contrast * haze
