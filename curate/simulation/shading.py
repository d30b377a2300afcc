"""Compiled kernels of the camera: the rays of the pixels, and the colours of what they hit."""

from typing import NamedTuple

import numpy as np
from numba import njit

from curate.simulation.materials import Material

TILE = 256  # pixels of the repeating texture and grain
_Real = float | np.floating

_HAZE_M, _TEXTURE_M, _FAR_M = 420.0, 40.0, 512
_BARE, _LINE, _WINDOW = range(3)
_ASPHALT, _WALL = int(Material.ASPHALT), int(Material.WALL)


class Surfaces(NamedTuple):
    """The properties of the scene's m triangles that the kernel needs.

    Attributes:
        lit: (m, 3) float32 RGB of the lit surface.
        normals: (m, 3) float32 unit normals.
        materials: (m,) uint8, see `Material`.
        texture: (k, 2) float32 contrast and texels per metre of each material.
        tile: (256, 256) float32 noise of mean 0 and standard deviation 1.
    """

    lit: np.ndarray
    normals: np.ndarray
    materials: np.ndarray
    texture: np.ndarray
    tile: np.ndarray


class Markings(NamedTuple):
    """The road markings, in road coordinates (see `street`).

    Attributes:
        cos: cosine of the street's heading.
        sin: sine of the street's heading.
        lines_d: (n,) float32 coordinates d of the lines, from right to left; inner lines are
            dashed.
        crossing_s: (2,) float32 coordinates s at which a crossing street begins and ends; equal if
            there is none.
        colour: (3,) float32 RGB of the lit paint.
    """

    cos: np.float32
    sin: np.float32
    lines_d: np.ndarray
    crossing_s: np.ndarray
    colour: np.ndarray


class Air(NamedTuple):
    """Sky, haze, windows and the sensor's grain.

    Attributes:
        sky: (2, 3) float32 RGB of the sky at the horizon and overhead.
        window: (3,) float32 RGB of window panes.
        grain: strength of the pixel noise, in grey levels.
        grain_offset: row and column of the noise tile at which the image begins.
    """

    sky: np.ndarray
    window: np.ndarray
    grain: np.float32
    grain_offset: tuple[int, int]


@njit(cache=True, nogil=True)
def pixel_rays(
    inverse: np.ndarray, origin: np.ndarray, pixels: np.ndarray, width: int
) -> np.ndarray:
    """Return the rays through pixel centres.

    Args:
        inverse: (3, 3) matrix from homogeneous pixels to directions.
        origin: (3,) camera centre.
        pixels: (n,) row * width + column; integer coordinates are pixel centres.
        width: width of the image in pixels.

    Returns:
        (n, 6) float32: origin and unit direction.
    """
    rays = np.empty((len(pixels), 6), dtype=np.float32)
    for i in range(len(pixels)):
        row, column = divmod(pixels[i], width)
        rays[i, 0], rays[i, 1], rays[i, 2] = origin[0], origin[1], origin[2]
        rays[i, 3], rays[i, 4], rays[i, 5] = _direction(inverse, row, column)
    return rays


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _direction(inverse: np.ndarray, row: _Real, column: _Real) -> tuple[_Real, _Real, _Real]:
    """Return the unit direction of a pixel's ray."""
    x = inverse[0, 0] * column + inverse[0, 1] * row + inverse[0, 2]
    y = inverse[1, 0] * column + inverse[1, 1] * row + inverse[1, 2]
    z = inverse[2, 0] * column + inverse[2, 1] * row + inverse[2, 2]
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@njit(cache=True, nogil=True, fastmath=True)
def shade(
    inverse: np.ndarray,
    origin: np.ndarray,
    distance: np.ndarray,
    triangle: np.ndarray,
    surfaces: Surfaces,
    markings: Markings,
    air: Air,
) -> np.ndarray:
    """Return the shaded image.

    Args:
        inverse: (3, 3) float32 matrix from homogeneous pixels to directions.
        origin: (3,) float32 camera centre.
        distance: (height, width) float32 distance along each pixel's ray, in metres.
        triangle: (height, width) int32 triangle that each ray hits, -1 for the sky.
        surfaces: surfaces of the scene.
        markings: markings of the road.
        air: sky, haze, windows and sensor noise.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    height, width = triangle.shape
    image = np.empty((height, width, 3), dtype=np.uint8)
    # Tables by whole metres of distance: contrast of textures, and transmission of the haze.
    texture_contrast = np.exp(-np.arange(_FAR_M) / np.float32(_TEXTURE_M)).astype(np.float32)
    transmission = np.exp(-np.arange(_FAR_M) / np.float32(_HAZE_M)).astype(np.float32)
    for row in range(height):
        for column in range(width):
            hit, reach = triangle[row, column], distance[row, column]
            ray_x, ray_y, ray_z = _direction(inverse, np.float32(row), np.float32(column))
            grain_row = (row + air.grain_offset[0]) & (TILE - 1)
            grain_column = (column + air.grain_offset[1]) & (TILE - 1)
            grain = air.grain * surfaces.tile[grain_row, grain_column]
            if hit < 0:
                share = min(max(np.float32(3) * ray_z, np.float32(0)), np.float32(1))
                for k in range(3):
                    level = air.sky[0, k] + (air.sky[1, k] - air.sky[0, k]) * share
                    image[row, column, k] = _grey_level(level, grain)
                continue
            x, y = origin[0] + ray_x * reach, origin[1] + ray_y * reach
            z = origin[2] + ray_z * reach
            kind, across, along = _paint(x, y, z, hit, surfaces, markings)
            texel = _texel(across, along, surfaces.materials[hit], surfaces)
            metre = min(int(reach), _FAR_M - 1)
            contrast = 1 + texture_contrast[metre] * texel
            for k in range(3):
                colour = surfaces.lit[hit, k]
                if kind == _LINE:
                    colour = markings.colour[k]
                elif kind == _WINDOW:
                    colour = air.window[k]
                clear = transmission[metre]
                level = air.sky[0, k] * (1 - clear) + colour * contrast * clear
                image[row, column, k] = _grey_level(level, grain)
    return image


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _grey_level(colour: _Real, grain: _Real) -> np.uint8:
    """Convert linear light to a grey level: gamma 2, added noise, clipped to 0 to 255."""
    clipped = min(max(np.float32(colour), np.float32(0)), np.float32(1))
    level = np.float32(255) * np.sqrt(clipped) + grain
    return np.uint8(min(max(level, np.float32(0)), np.float32(255)))


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _texel(across: _Real, along: _Real, material: int, surfaces: Surfaces) -> _Real:
    """Return the texture of a material at a point on a surface; `across` and `along` in metres."""
    scale = surfaces.texture[material, 1]
    # The offset makes the numbers positive, so that truncation rounds down.
    column = int((across + np.float32(1024)) * scale) & (TILE - 1)
    row = int((along + np.float32(1024)) * scale) & (TILE - 1)
    texel: _Real = surfaces.texture[material, 0] * surfaces.tile[row, column]
    return texel


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _paint(
    x: _Real, y: _Real, z: _Real, hit: int, surfaces: Surfaces, markings: Markings
) -> tuple[int, _Real, _Real]:
    """Return what covers a point of a surface (line, window or nothing), and its texture position.

    Windows repeat on walls every 2.7 m horizontally and 2.9 m vertically.
    """
    flat = abs(surfaces.normals[hit, 2]) > np.float32(0.7)
    if flat:
        if surfaces.materials[hit] == _ASPHALT and _is_painted(x, y, markings):
            return _LINE, x, y
        return _BARE, x, y
    across = surfaces.normals[hit, 0] * y - surfaces.normals[hit, 1] * x
    if surfaces.materials[hit] == _WALL:
        column = _fraction(across / np.float32(2.7))
        storey = _fraction((z + np.float32(1.7)) / np.float32(2.9))
        if 0.3 < column < 0.72 and 0.31 < storey < 0.8:
            return _WINDOW, across, z
    return _BARE, across, z


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _fraction(value: _Real) -> _Real:
    """Return the fractional part, 0 to 1; the modulo operator is slower."""
    whole: _Real = np.floor(value)
    return value - whole


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _is_painted(x: _Real, y: _Real, markings: Markings) -> bool:
    """Return whether a point on the asphalt is on a line."""
    d = markings.cos * y - markings.sin * x
    last = len(markings.lines_d) - 1
    for line in range(last + 1):
        if abs(d - markings.lines_d[line]) < np.float32(0.08):
            s = markings.cos * x + markings.sin * y
            if markings.crossing_s[0] < s < markings.crossing_s[1]:
                return False
            return line in (0, last) or bool(_fraction(s / np.float32(9)) < 0.45)
    return False
