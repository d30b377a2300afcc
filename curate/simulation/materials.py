"""Surface materials: their LiDAR properties, texture and default colour."""

from collections.abc import Mapping
from enum import IntEnum

import numpy as np


class Material(IntEnum):
    """The surface materials; the value is the row in the tables of this module."""

    ASPHALT = 0
    PAVEMENT = 1
    GRASS = 2
    PAINT = 3
    GLASS = 4
    RUBBER = 5
    TRIM = 6
    HEADLIGHT = 7
    TAILLIGHT = 8
    RETROREFLECTOR = 9
    SKIN = 10
    HAIR = 11
    UPPER_CLOTH = 12
    LOWER_CLOTH = 13
    SHOE = 14
    METAL = 15
    BARK = 16
    FOLIAGE = 17
    WALL = 18
    ROOF = 19
    CONCRETE = 20
    WOOD = 21


# (m, 4): LiDAR reflectivity 0 to 1, fraction of pulses lost at normal incidence, additional range
# noise in metres, fraction of the reflectivity that is proportional to the colour's brightness.
_LIDAR = np.array(
    [
        (0.24, 0.02, 0.00, 0.2),  # ASPHALT
        (0.33, 0.02, 0.00, 0.2),  # PAVEMENT
        (0.36, 0.03, 0.03, 0.2),  # GRASS
        (0.40, 0.05, 0.00, 0.9),  # PAINT
        (0.08, 0.65, 0.00, 0.0),  # GLASS
        (0.07, 0.12, 0.00, 0.0),  # RUBBER
        (0.10, 0.10, 0.00, 0.3),  # TRIM
        (0.60, 0.10, 0.00, 0.0),  # HEADLIGHT
        (0.70, 0.05, 0.00, 0.0),  # TAILLIGHT
        (0.99, 0.00, 0.00, 0.0),  # RETROREFLECTOR
        (0.38, 0.03, 0.00, 0.4),  # SKIN
        (0.20, 0.08, 0.01, 0.5),  # HAIR
        (0.40, 0.03, 0.01, 0.7),  # UPPER_CLOTH
        (0.34, 0.03, 0.01, 0.7),  # LOWER_CLOTH
        (0.25, 0.05, 0.00, 0.5),  # SHOE
        (0.38, 0.05, 0.00, 0.4),  # METAL
        (0.26, 0.03, 0.01, 0.3),  # BARK
        (0.42, 0.08, 0.05, 0.2),  # FOLIAGE
        (0.36, 0.02, 0.00, 0.6),  # WALL
        (0.28, 0.03, 0.00, 0.5),  # ROOF
        (0.36, 0.02, 0.00, 0.5),  # CONCRETE
        (0.34, 0.03, 0.00, 0.5),  # WOOD
    ]
)
REFLECTIVITY, LOSS, ROUGHNESS_M, COLOUR_SHARE = _LIDAR.T.astype(np.float32)

# (m, 2): contrast of the texture in the image, and its resolution in texels per metre.
TEXTURE = np.array(
    [
        (0.10, 24),  # ASPHALT
        (0.10, 12),  # PAVEMENT
        (0.30, 16),  # GRASS
        (0.03, 10),  # PAINT
        (0.12, 8),  # GLASS
        (0.10, 20),  # RUBBER
        (0.08, 20),  # TRIM
        (0.05, 20),  # HEADLIGHT
        (0.05, 20),  # TAILLIGHT
        (0.10, 30),  # RETROREFLECTOR
        (0.06, 30),  # SKIN
        (0.15, 40),  # HAIR
        (0.16, 25),  # UPPER_CLOTH
        (0.10, 25),  # LOWER_CLOTH
        (0.10, 30),  # SHOE
        (0.10, 8),  # METAL
        (0.25, 20),  # BARK
        (0.42, 14),  # FOLIAGE
        (0.08, 10),  # WALL
        (0.15, 12),  # ROOF
        (0.10, 14),  # CONCRETE
        (0.20, 14),  # WOOD
    ],
    dtype=np.float32,
)

# (m, 3): linear RGB, 0 to 1.
_COLOURS = np.array(
    [
        (0.30, 0.30, 0.31),  # ASPHALT
        (0.52, 0.51, 0.49),  # PAVEMENT
        (0.27, 0.38, 0.17),  # GRASS
        (0.55, 0.55, 0.56),  # PAINT
        (0.10, 0.13, 0.16),  # GLASS
        (0.05, 0.05, 0.05),  # RUBBER
        (0.12, 0.12, 0.13),  # TRIM
        (0.88, 0.88, 0.82),  # HEADLIGHT
        (0.62, 0.06, 0.06),  # TAILLIGHT
        (0.85, 0.85, 0.80),  # RETROREFLECTOR
        (0.76, 0.56, 0.44),  # SKIN
        (0.16, 0.11, 0.08),  # HAIR
        (0.40, 0.30, 0.30),  # UPPER_CLOTH
        (0.20, 0.22, 0.30),  # LOWER_CLOTH
        (0.14, 0.12, 0.11),  # SHOE
        (0.45, 0.46, 0.47),  # METAL
        (0.30, 0.23, 0.17),  # BARK
        (0.20, 0.33, 0.12),  # FOLIAGE
        (0.66, 0.60, 0.52),  # WALL
        (0.45, 0.25, 0.20),  # ROOF
        (0.58, 0.57, 0.55),  # CONCRETE
        (0.48, 0.35, 0.22),  # WOOD
    ],
    dtype=np.float32,
)


def palette(colours: Mapping[Material, np.ndarray] | None = None) -> np.ndarray:
    """Return the (m, 3) float32 RGB of all materials: the defaults, replaced by `colours`."""
    table = _COLOURS.copy()
    for material, colour in (colours or {}).items():
        table[material] = colour
    return table
