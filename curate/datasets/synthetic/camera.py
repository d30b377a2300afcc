"""The camera's image and semantic map: one ray per pixel, shaded, textured and made noisy."""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from curate.datasets.synthetic.materials import Material
from curate.datasets.synthetic.rig import IMAGE_SIZE, CameraRig
from curate.datasets.synthetic.scene import Caster, Scene

_TEXTURE = 256  # pixels of the repeating noise tile
_HAZE_M = 350.0


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


def render(scene: Scene, caster: Caster, rig: CameraRig, generator: np.random.Generator) -> View:
    """The camera's view of a scene."""
    rays = rig.rays()
    hits = caster.first_hits(rays)
    width, height = IMAGE_SIZE
    seen = hits.triangle >= 0
    triangle = np.where(seen, hits.triangle, 0)
    things = np.where(seen, scene.things[triangle], -1)
    semantic = np.where(seen, scene.thing_classes()[scene.things[triangle]], 0).astype(np.uint8)
    light = _Light.draw(generator)
    colours = light.shade(scene)[triangle]
    colours *= _texture(scene, rays, hits.distance, triangle, seen)[:, None]
    haze = np.where(seen, np.exp(-hits.distance / _HAZE_M), 0.0).astype(np.float32)[:, None]
    colours = light.sky(rays[:, 5]) * (1 - haze) + colours * haze
    image = _expose(colours.reshape(height, width, 3), light, generator)
    return View(image, semantic.reshape(height, width), things.reshape(height, width))
