"""Any semantic segmentation model that was exported to ONNX.

The model takes one RGB image, uint8 or float32, [1, height, width, 3] or [1, 3, height, width], of
a fixed or a free size, and answers class ids [1, h, w] or scores of classes, channels first or
last.

A model of a fixed, nearly square shape sees a wide image squeezed, and loses what is small in it.
Such a model is therefore run on crops as high as the image, evenly spread along it. Where crops
overlap, each pixel takes its class from the crop whose centre is nearest, which shows most of what
is around the pixel; where that class counts for no category, but that of another crop does, from
the other. (DeepLab v3 on 45 cars in 24 KITTI frames: whole image 0.17 of the pixels of their 2D
boxes, nearest crop 0.59, with the second rule 0.62.)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from pathlib import Path

import cv2
import numpy as np

from curate.errors import ConfigError, ModelError
from curate.files.onnx_session import is_numeric_array
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.segmenters.base import SemanticMap
from curate.segmenters.classes import checked_classes
from curate.segmenters.onnx_images import ImageModel, image_of

# A whole image may be squeezed by this factor before it is cut into crops.
_SQUEEZE_LIMIT = 1.5

_ANSWER = "expected class ids [1, h, w], or scores [1, classes, h, w] or [1, h, w, classes]"


class OnnxSegmenter:
    """A `Segmenter` that runs an ONNX model on the CPU.

    Args:
        model: the .onnx file.
        classes: the class ids that count for each category.
        tiles: crops along an image that is too wide for the model's shape; more where so many do
            not cover the image, 1 to always squeeze the whole image.
        scaling: what a float model wants: "imagenet" (mean 0, deviation 1), "unit" (0 to 1) or
            "none" (0 to 255).
        threads: of ONNX Runtime.

    Raises:
        ModelError: the file is missing or no ONNX model, or its input is no image.
        ConfigError: an option or a class id is out of range.
    """

    needs_image = True
    needs_points = False

    def __init__(
        self,
        model: StrPath,
        classes: Mapping[str, Sequence[int]],
        *,
        tiles: int = 5,
        scaling: str = "imagenet",
        threads: int = 1,
    ) -> None:
        if tiles < 1:
            raise ConfigError(f"segmenter tiles {tiles}: at least 1")
        self.classes = checked_classes(classes)
        self.tiles = tiles
        self._model = ImageModel(Path(model), scaling, threads)
        self._output = _map_output(self._model)

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's semantic map.

        Raises:
            ModelError: if the frame has no image, or the model's answer is no semantic map.
        """
        image = image_of(frame)
        height, width = image.shape[:2]
        crops = self._crops(width, height)
        tiles = [self._run(image[:, crop.left : crop.right]) for crop in crops]
        return SemanticMap(self._merge(crops, tiles), self.classes)

    def _merge(self, crops: list["Crop"], tiles: list[np.ndarray]) -> np.ndarray:
        """Return (height, width) class ids from those of the crops; see above for the rule."""
        class_ids = np.hstack(
            [
                tile[:, crop.own_left - crop.left : crop.own_right - crop.left]
                for crop, tile in zip(crops, tiles, strict=True)
            ]
        )
        counts = np.zeros(256, dtype=bool)
        counts[[one for ids in self.classes.values() for one in ids]] = True
        for crop, tile in zip(crops, tiles, strict=True):
            part = class_ids[:, crop.left : crop.right]
            lost = counts[tile] & ~counts[part]
            part[lost] = tile[lost]
        return class_ids

    def _crops(self, width: int, height: int) -> list["Crop"]:
        """Return the crops of an image; a single one where the model's shape suits it."""
        shape = self._model.input
        whole = [Crop(0, width, 0, width)]
        if shape.height is None or shape.width is None or self.tiles == 1:
            return whole
        squeeze = (width / height) / (shape.width / shape.height)
        if squeeze <= _SQUEEZE_LIMIT:
            return whole
        crop_width = max(round(width / squeeze), 1)
        return cut_along(width, crop_width, max(self.tiles, ceil(squeeze)))

    def _run(self, image: np.ndarray) -> np.ndarray:
        """Return (h, w) uint8 class ids of an (h, w, 3) image."""
        height, width = image.shape[:2]
        shape = self._model.input
        target = (shape.width or width, shape.height or height)
        shrinks = target[0] < width or target[1] < height
        kind = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        pixels = cv2.resize(image, target, interpolation=kind)
        (answer,) = self._model.run(pixels, [self._output])
        class_ids = _class_ids(answer, target, self._model.path)
        return cv2.resize(class_ids, (width, height), interpolation=cv2.INTER_NEAREST)


@dataclass(frozen=True)
class Crop:
    """Columns [left, right) of an image, of which [own_left, own_right) are taken from it."""

    left: int
    right: int
    own_left: int
    own_right: int


def cut_along(width: int, crop_width: int, count: int) -> list[Crop]:
    """`count` crops spread evenly over an image's width, each owning the columns nearest to it."""
    lefts = np.round(np.linspace(0, width - crop_width, count)).astype(int)
    middles = (lefts[:-1] + lefts[1:] + crop_width) // 2
    borders = [0, *middles.tolist(), width]
    return [
        Crop(left, left + crop_width, *own)
        for left, own in zip(lefts.tolist(), pairwise(borders), strict=True)
    ]


def _map_output(model: ImageModel) -> str:
    """Return the output that is the map; ModelError where the model says that it is none."""
    output = model.outputs[0]
    if output.shape and len(output.shape) not in {3, 4}:
        raise ModelError(f"{model.path}: answers {output.name} {output.shape}; {_ANSWER}")
    name: str = output.name
    return name


def _class_ids(answer: np.ndarray, size: tuple[int, int], model: Path) -> np.ndarray:
    """Return (h, w) uint8 class ids from the model's answer.

    Scores of classes are told from positions by the shape of the input: of both ways to read the
    answer, the one whose h : w is nearer to the input's is right.
    """
    fault = ModelError(f"{model}: answers {answer.dtype} {list(answer.shape)}; {_ANSWER}")
    if (
        not is_numeric_array(answer)
        or answer.ndim not in {3, 4}
        or answer.shape[0] != 1
        or 0 in answer.shape
    ):
        raise fault
    scores = answer[0]
    if np.isnan(scores.max()):  # the highest of them would be class 0, or any other
        raise ModelError(f"{model}: answers scores that are NaN; mend the model or its scaling")
    if scores.ndim == 3:
        first, second, third = scores.shape
        aspect = np.log(size[1] / size[0])
        last = abs(np.log(first / second) - aspect) < abs(np.log(second / third) - aspect)
        axis = 2 if last else 0
        single = scores.shape[axis] == 1
        scores = scores.squeeze(axis) if single else scores.argmax(axis)
    if not np.issubdtype(scores.dtype, np.integer) or scores.min() < 0 or scores.max() > 255:
        raise fault
    class_ids: np.ndarray = scores.astype(np.uint8)
    return class_ids
