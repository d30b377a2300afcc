"""Ground-truth semantic maps of simulated frames, degraded by an error model.

The errors of a frame are drawn from a generator seeded with (seed, frame id), or for several
cameras (seed, camera, frame id), in this order:

1. Missed instances: every connected region of a class is erased with probability
   `missed_instance`, or `missed_small_instance` if it has fewer than `small_px` pixels.
2. Class confusion: a remaining region changes its class with probability `confused`: pedestrian
   and cyclist into each other, a car into either.
3. Boundary errors: the outline of a region is shrunk or grown by a whole number of pixels, uniform
   between -`boundary_px` and +`boundary_px`. It shrinks by at most a third of the smaller of its
   height and width.
4. Missed patches: a Poisson number (mean `patches`) of ellipses with half axes of 3 to
   `patch_px` pixels, centred on object pixels, become background.
5. False blobs: a Poisson number (mean `blobs`) of ellipses with half axes of 4 to `blob_px` pixels,
   centred anywhere in the lower two thirds of the image, become a random class.
"""

import hashlib
from dataclasses import asdict, dataclass, fields

import cv2
import numpy as np

from curate.errors import ConfigError
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.ranges import NotNegative
from curate.segmenters.base import Segmenter, SemanticMap
from curate.segmenters.classes import class_map
from curate.segmenters.saved import SavedSegmenter

_BACKGROUND, _CAR, _PEDESTRIAN, _CYCLIST = range(4)
_CONFUSED_WITH = {
    _CAR: (_PEDESTRIAN, _CYCLIST),
    _PEDESTRIAN: (_CYCLIST,),
    _CYCLIST: (_PEDESTRIAN,),
}


@dataclass(frozen=True)
class ErrorModel:
    """Rates and sizes of the errors; the module docstring describes each.

    Raises:
        ConfigError: if a value is negative, a probability is above 1, or a number of pixels is not
            an integer.
    """

    missed_instance: float = 0.06
    missed_small_instance: float = 0.20
    small_px: int = 250
    confused: float = 0.05
    boundary_px: int = 2
    patches: float = 5.0
    patch_px: int = 18
    blobs: float = 2.0
    blob_px: int = 25

    def __post_init__(self) -> None:
        """Check the values."""
        for name, value in asdict(self).items():
            highest = 1.0 if name.startswith(("missed", "confused")) else np.inf
            is_number = isinstance(value, int | float)
            if not (is_number and 0 <= value <= highest):
                raise ConfigError(
                    f"degraded segmenter: {name} is {value!r}, expected 0 to {highest:g}"
                )
            if name.endswith("_px") and not isinstance(value, int):
                raise ConfigError(f"degraded segmenter: {name} is {value}, expected an integer")


class DegradedSegmenter(Segmenter):
    """A `Segmenter` that reads the maps of a simulated data set and degrades them.

    Args:
        directory: the folder semantic_2 of the data set.
        seed: seed of the random errors.
        rates: values of `ErrorModel` that differ from the defaults.

    Raises:
        DataError: if the folder does not exist.
        ConfigError: if a rate is unknown or out of range.
    """

    needs_image = False
    needs_points = False

    def __init__(self, directory: StrPath, *, seed: int = 0, **rates: NotNegative) -> None:
        self.seed = seed
        options = {field.name for field in fields(ErrorModel)}
        if unknown := sorted(set(rates) - options):
            raise ConfigError(
                f"degraded segmenter: unknown option {unknown[0]!r}; "
                f"use one of {', '.join(sorted(options))}"
            )
        self.errors = ErrorModel(**rates)  # type: ignore[arg-type] # it checks the types
        self._truth = SavedSegmenter(directory, class_map("simulated"))
        self.classes = self._truth.classes

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's degraded map; it depends on seed, frame id and camera only.

        Raises:
            DataError: if the ground-truth map is missing, or does not fit the frame's image.
        """
        truth = self._truth.segment(frame)
        name = f"{frame.camera}/{frame.frame_id}" if frame.camera else frame.frame_id
        digest = hashlib.sha256(name.encode()).digest()
        generator = np.random.default_rng([self.seed, int.from_bytes(digest[:8], "little")])
        return SemanticMap(degrade(truth.class_ids, self.errors, generator), truth.category_classes)


def degrade(
    class_ids: np.ndarray, errors: ErrorModel, generator: np.random.Generator
) -> np.ndarray:
    """Return a copy of (height, width) uint8 class ids with random errors added."""
    degraded = np.zeros_like(class_ids)
    for class_id in (_CAR, _PEDESTRIAN, _CYCLIST):
        count, regions, stats, _ = cv2.connectedComponentsWithStats(
            (class_ids == class_id).astype(np.uint8)
        )
        for region in range(1, count):
            small = stats[region, cv2.CC_STAT_AREA] < errors.small_px
            missed = errors.missed_small_instance if small else errors.missed_instance
            if generator.random() < missed:
                continue
            painted = class_id
            if generator.random() < errors.confused:
                painted = int(generator.choice(_CONFUSED_WITH[class_id]))
            _paint_region(degraded, regions == region, stats[region], painted, errors, generator)
    objects = np.flatnonzero(class_ids)
    if len(objects):
        for _ in range(generator.poisson(errors.patches)):
            row, column = divmod(int(generator.choice(objects)), class_ids.shape[1])
            _paint_ellipse(degraded, column, row, (3, errors.patch_px), _BACKGROUND, generator)
    height, width = class_ids.shape
    for _ in range(generator.poisson(errors.blobs)):
        column, row = int(generator.integers(width)), int(generator.integers(height // 3, height))
        class_id = int(generator.integers(_CAR, _CYCLIST + 1))
        _paint_ellipse(degraded, column, row, (4, errors.blob_px), class_id, generator)
    return degraded


def _paint_region(
    degraded: np.ndarray,
    region: np.ndarray,
    stats: np.ndarray,
    class_id: int,
    errors: ErrorModel,
    generator: np.random.Generator,
) -> None:
    """Paint a region with its outline moved in or out by a random number of pixels."""
    limit = errors.boundary_px
    shift = int(generator.integers(-limit, limit + 1))
    smallest = int(min(stats[cv2.CC_STAT_WIDTH], stats[cv2.CC_STAT_HEIGHT]))
    shift = max(shift, -(smallest // 3))
    left, top = (max(0, int(stats[k]) - limit) for k in (cv2.CC_STAT_LEFT, cv2.CC_STAT_TOP))
    right = int(stats[cv2.CC_STAT_LEFT] + stats[cv2.CC_STAT_WIDTH]) + limit
    bottom = int(stats[cv2.CC_STAT_TOP] + stats[cv2.CC_STAT_HEIGHT]) + limit
    window = np.s_[top:bottom, left:right]
    side = 2 * abs(shift) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    operation = cv2.MORPH_DILATE if shift > 0 else cv2.MORPH_ERODE
    moved = cv2.morphologyEx(region[window].astype(np.uint8), operation, kernel)
    degraded[window][moved > 0] = class_id


def _paint_ellipse(
    degraded: np.ndarray,
    column: int,
    row: int,
    half_axes_px: tuple[int, int],
    class_id: int,
    generator: np.random.Generator,
) -> None:
    """Paint an ellipse with random half axes from the given range."""
    low, high = half_axes_px
    axes = [int(axis) for axis in generator.integers(low, max(low, high) + 1, size=2)]
    cv2.ellipse(degraded, (column, row), axes, 0, 0, 360, class_id, thickness=-1)
