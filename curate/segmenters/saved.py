"""A segmenter that reads precomputed semantic maps: one PNG of class ids per frame."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from curate.datasets.formats.images import decode_image
from curate.datasets.frame_names import files_by_frame
from curate.errors import ConfigError, DataError
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.segmenters.base import SemanticMap, image_size_of
from curate.segmenters.classes import checked_classes, describe_unexpected_ids

_MAX_CLASSES = 256


class SavedSegmenter:
    """A `Segmenter` that reads DIRECTORY/FRAME.png with a single channel: a class id per pixel.

    Args:
        directory: the folder of the maps, or of folders CAMERA of maps for several cameras; if
            no map is in it, they are in its subfolders.
        classes: the class ids that count for each category.
        divisor: for 16-bit maps of class * divisor + instance number: 1000 for Cityscapes'
            instanceIds, 256 for KITTI's. A value below the divisor is a class id without instance.
        frame_ids: the frames of the data set, with which the names of the maps are matched in the
            spellings of `curate.datasets.frame_names`; without them, names are frame ids.

    Raises:
        DataError: if the folder does not exist, or no map is of a frame of the data set.
        ConfigError: if a class id or the divisor is out of range.
    """

    needs_image = False
    needs_points = False

    def __init__(
        self,
        directory: StrPath,
        classes: Mapping[str, Sequence[int]],
        *,
        divisor: int | None = None,
        frame_ids: Sequence[str] = (),
    ) -> None:
        if divisor is not None and not (isinstance(divisor, int) and divisor > 1):
            raise ConfigError(f"segmenter divisor {divisor!r}: expected an integer above 1")
        self.directory = Path(directory)
        self.classes = checked_classes(classes)
        self.divisor = divisor
        if not self.directory.is_dir():
            raise DataError(f"{self.directory}: no such folder of semantic maps")
        self._frame_ids = frame_ids
        self._found: dict[str, Mapping[str, Path]] = {}
        if any(path.suffix.lower() == ".png" for path in self.directory.iterdir()):
            self._maps("")

    def _maps(self, camera: str) -> Mapping[str, Path]:
        """Return the map of each frame from a camera; "" for the only one."""
        if camera not in self._found:
            folder = self.directory / camera
            self._found[camera] = files_by_frame(folder, "*.png", self._frame_ids)
        return self._found[camera]

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's saved map.

        Raises:
            DataError: if the map is missing, has another size than the frame's image, or contains
                ids that its class set does not have.
        """
        path = self._maps(frame.camera).get(
            frame.frame_id, self.directory / frame.camera / f"{frame.frame_id}.png"
        )
        class_ids = self._class_ids(path, decode_image(path, cv2.IMREAD_UNCHANGED))
        width, height = image_size_of(frame)
        if class_ids.shape != (height, width):
            raise DataError(
                f"{path}: the map is {class_ids.shape[1]} x {class_ids.shape[0]} pixels, "
                f"the image of the frame is {width} x {height}"
            )
        if problem := describe_unexpected_ids(class_ids, self.classes):
            raise DataError(f"{path}: {problem}")
        return SemanticMap(class_ids, self.classes)

    def _class_ids(self, path: Path, pixels: np.ndarray) -> np.ndarray:
        """Return the (h, w) uint8 class ids of a decoded PNG."""
        if pixels.ndim == 2 and pixels.dtype == np.uint8:
            return pixels
        if pixels.ndim == 2 and pixels.dtype == np.uint16 and self.divisor is not None:
            class_ids = np.where(pixels < self.divisor, pixels, pixels // self.divisor)
            if class_ids.max(initial=0) < _MAX_CLASSES:
                return class_ids.astype(np.uint8)
            raise DataError(
                f"{path}: class {class_ids.max()} with divisor {self.divisor}, expected 0 to "
                f"{_MAX_CLASSES - 1}; check segmenter.options.divisor"
            )
        raise DataError(
            f"{path}: expected one channel of 8 bits, a class id per pixel; for 16-bit maps of "
            "class and instance, set segmenter.options.divisor"
        )
