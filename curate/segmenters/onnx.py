"""A segmenter that runs any semantic segmentation model in ONNX format.

The model takes one RGB image, uint8 or float, [1, height, width, 3] or [1, 3, height, width], of
a fixed or a free size. It returns class ids [1, h, w], or class scores with the channels first or
last. h and w have the proportions of the input.

If the model has a fixed, nearly square input, a wide image has to be squeezed and small objects
get lost. Such a model is run on crops instead, each as high as the image, evenly spread over its
width. Two rules decide where crops overlap:

1. A pixel takes its class from the crop with the nearest centre: it shows most of the pixel's
   surroundings.
2. If that class counts for no category, but the class from another crop does, the pixel takes the
   class of the other crop.

DeepLab v3 on 45 cars in 24 KITTI frames labels this share of the pixels in their 2D boxes as car:
0.17 with the whole image, 0.59 with rule 1, 0.62 with both rules (five crops). As many crops as
cover the image are used unless more are configured: docs/segmenters.md has the measurements.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from curate.datasets.formats.images import MAX_PIXELS
from curate.errors import ConfigError, ModelError
from curate.files.onnx_providers import AUTO, ProviderOptions, Providers
from curate.files.onnx_session import is_numeric_array
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.ranges import AtLeastOne
from curate.segmenters.base import Segmenter, SemanticMap
from curate.segmenters.classes import checked_classes
from curate.segmenters.onnx_images import ImageModel, Scaling, image_of

# An image is cut into crops if it would have to be squeezed by more than this factor.
_SQUEEZE_LIMIT = 1.5

_EXPECTED = "expected class ids [1, h, w], or scores [1, classes, h, w] or [1, h, w, classes]"
# Outputs that are the map where a model has several: of torchvision ("aux" is the other) and of
# Hugging Face.
_USUAL_NAMES = ("out", "logits")
Layout = Literal["first", "last"]
_MAX_CROPPED_PIXELS = 4 * MAX_PIXELS  # of all crops of an image
# h and w are those of the input up to a common factor, rounded or padded by at most this ratio.
_MAX_ASPECT_ERROR = 1.25


class OnnxSegmenter(Segmenter):
    """A `Segmenter` that runs an ONNX model.

    Args:
        model: the .onnx file.
        classes: the class ids that count for each category.
        tiles: number of crops for an image that is too wide for the model's input; more are used if
            that many do not cover the image. None: as many as cover it. 1: the whole image is
            always squeezed.
        scaling: how pixels are scaled for a float model: "imagenet" (mean 0, standard deviation 1),
            "unit" (0 to 1) or "none" (0 to 255).
        output: name of the output with the map; not needed if there is one.
        channels: whether scores have their class axis "first" or "last"; not needed where only one
            of them leaves axes in the proportions of the input.
        threads: number of threads of ONNX Runtime on the CPU.
        providers: where the model runs: "auto", a provider such as "cuda", or several.
        provider_options: options of ONNX Runtime's providers by their names.

    Raises:
        ModelError: if the file is missing or not an ONNX model, its input is not an image, or
            several outputs can be the map.
        ConfigError: if an option or a class id is out of range, or a listed provider cannot be
            used.
    """

    needs_image = True
    needs_points = False
    map_version = 1

    def __init__(
        self,
        model: StrPath,
        classes: Mapping[str, Sequence[int]],
        *,
        tiles: AtLeastOne | None = None,
        scaling: Scaling = "imagenet",
        output: str | None = None,
        channels: Layout | None = None,
        threads: AtLeastOne = 1,
        providers: Providers = AUTO,
        provider_options: ProviderOptions | None = None,
    ) -> None:
        if tiles is not None and tiles < 1:
            raise ConfigError(f"segmenter.options.tiles {tiles}: expected at least 1")
        if channels not in {None, *get_args(Layout)}:
            raise ConfigError(f"segmenter.options.channels {channels!r}: use first or last")
        self.classes = checked_classes(classes)
        self.tiles = tiles
        self._model = ImageModel(Path(model), scaling, threads, providers, provider_options)
        self._output = _map_output(self._model, output)
        self._channels = channels

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's semantic map.

        Raises:
            ModelError: if the frame has no image, or the model's output is not a semantic map.
        """
        image = image_of(frame)
        height, width = image.shape[:2]
        crops = self._crops(width, height)
        tiles = self._run([image[:, crop.left : crop.right] for crop in crops])
        return SemanticMap(self._merge(crops, tiles), self.classes)

    def _merge(self, crops: list["Crop"], tiles: list[np.ndarray]) -> np.ndarray:
        """Merge the class ids of the crops to (height, width) by the module's two rules."""
        class_ids = np.hstack(
            [
                tile[:, crop.own_left - crop.left : crop.own_right - crop.left]
                for crop, tile in zip(crops, tiles, strict=True)
            ]
        )
        has_category = np.zeros(256, dtype=bool)
        has_category[[class_id for ids in self.classes.values() for class_id in ids]] = True
        for crop, tile in zip(crops, tiles, strict=True):
            part = class_ids[:, crop.left : crop.right]
            missed = has_category[tile] & ~has_category[part]
            part[missed] = tile[missed]
        return class_ids

    def _crops(self, width: int, height: int) -> list["Crop"]:
        """Return the crops of an image; a single one if the model's input shape fits the image."""
        shape = self._model.input
        whole = [Crop(0, width, 0, width)]
        if shape.height is None or shape.width is None or self.tiles == 1:
            return whole
        squeeze = (width / height) / (shape.width / shape.height)
        if squeeze <= _SQUEEZE_LIMIT:
            return whole
        crop_width = max(round(width / squeeze), 1)
        count = max(self.tiles or 1, ceil(width / crop_width))
        if count * shape.width * shape.height > _MAX_CROPPED_PIXELS:
            raise ModelError(
                f"{self._model.path}: takes images of {shape.width} x {shape.height} pixels, so an "
                f"image of {width} x {height} needs {count} crops; use a model with another shape"
            )
        return cut_along(width, crop_width, count)

    def _run(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the (h, w) uint8 class ids of (h, w, 3) images of one size."""
        import cv2

        height, width = images[0].shape[:2]
        shape = self._model.input
        target = (shape.width or width, shape.height or height)
        shrinks = target[0] < width or target[1] < height
        interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        pixels = [cv2.resize(image, target, interpolation=interpolation) for image in images]
        outputs = self._model.run_all(pixels, self._output)
        try:
            maps = [_class_ids(output, target, self._channels) for output in outputs]
        except ModelError as error:
            raise ModelError(f"{self._model.path}: {error}") from None
        return [cv2.resize(each, (width, height), interpolation=cv2.INTER_NEAREST) for each in maps]


@dataclass(frozen=True)
class Crop:
    """The columns [left, right) of an image; the crop owns the columns [own_left, own_right)."""

    left: int
    right: int
    own_left: int
    own_right: int


def cut_along(width: int, crop_width: int, count: int) -> list[Crop]:
    """Return `count` crops spread evenly over an image's width.

    Each crop owns the columns that are nearer to its centre than to any other centre. For example,
    three crops of 6 columns from an image of 12 start at 0, 3 and 6 and own the columns [0, 4),
    [4, 7) and [7, 12).
    """
    lefts = np.round(np.linspace(0, width - crop_width, count)).astype(int)
    middles = (lefts[:-1] + lefts[1:] + crop_width) // 2
    borders = [0, *middles.tolist(), width]
    return [
        Crop(left, left + crop_width, *own)
        for left, own in zip(lefts.tolist(), pairwise(borders), strict=True)
    ]


def _map_output(model: ImageModel, declared: str | None) -> str:
    """Return the name of the output with the map.

    Raises:
        ModelError: if there is none, or several can be it.
    """
    shown = ", ".join(map(str, model.outputs))
    names = [output.name for output in model.outputs]
    if declared is not None:
        if declared not in names:
            raise ModelError(
                f"{model.path}: the outputs are {shown}; there is no output {declared}; set "
                "segmenter.options.output"
            )
        return declared
    # The shape is empty if the model does not declare it.
    maps = [each.name for each in model.outputs if len(each.shape) in {0, 3, 4}]
    usual = [name for name in _USUAL_NAMES if name in maps]
    if not maps:
        raise ModelError(f"{model.path}: returns {shown}; {_EXPECTED}")
    if len(maps) > 1 and len(usual) != 1:
        raise ModelError(
            f"{model.path}: returns {shown}; several can be the map; set segmenter.options.output"
        )
    return (usual or maps)[0]


def _class_ids(output: np.ndarray, size: tuple[int, int], channels: str | None) -> np.ndarray:
    """Return (h, w) uint8 class ids from the model's output.

    Args:
        output: class ids [1, h, w], or scores [1, classes, h, w] or [1, h, w, classes].
        size: (width, height) of the model's input in pixels.
        channels: whether the class axis is "first" or "last", None if the shape decides.

    Raises:
        ModelError: if it is neither.
    """
    returned = f"returns {output.dtype} {list(output.shape)}"
    if (
        not is_numeric_array(output)
        or output.ndim not in {3, 4}
        or len(output) != 1
        or 0 in output.shape
    ):
        raise ModelError(f"{returned}; {_EXPECTED}")
    values = output[0]
    if np.isnan(values.max()):  # argmax would return the class of a NaN
        raise ModelError("returns scores that are NaN; fix the model or its scaling")
    if values.ndim == 3:
        axis = _class_axis(returned, values.shape, size, channels)
        values = values.squeeze(axis) if values.shape[axis] == 1 else values.argmax(axis)
    elif not _is_in_proportion(values.shape, size):
        raise ModelError(_proportions(returned, size))
    if not np.issubdtype(values.dtype, np.integer) or values.min() < 0 or values.max() > 255:
        raise ModelError(f"{returned}; {_EXPECTED}")
    class_ids: np.ndarray = values.astype(np.uint8)
    return class_ids


def _class_axis(
    returned: str, shape: tuple[int, ...], size: tuple[int, int], channels: str | None
) -> int:
    """Return the class axis of scores: the other two have the size or proportions of the input.

    For example, an input of 1248 x 384 and scores [96, 312, 19]: 312 / 96 are the proportions, so
    the classes are last.

    Raises:
        ModelError: if both or neither have them, and the layout is not declared.
    """
    if channels is not None:
        return -1 if channels == "last" else 0
    maps = {0: shape[1:], -1: shape[:2]}
    fitting = [axis for axis, (height, width) in maps.items() if (width, height) == size]
    if not fitting:
        fitting = [axis for axis, own in maps.items() if _is_in_proportion(own, size)]
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        raise ModelError(_proportions(returned, size))
    raise ModelError(
        f"{returned}, which can be {shape[0]} classes first or {shape[2]} classes last; set "
        "segmenter.options.channels to first or last"
    )


def _is_in_proportion(shape: Sequence[int], size: tuple[int, int]) -> bool:
    """Return whether (height, width) of a map has about the proportions of (width, height)."""
    error = shape[1] / shape[0] / (size[0] / size[1])
    return max(error, 1 / error) <= _MAX_ASPECT_ERROR


def _proportions(returned: str, size: tuple[int, int]) -> str:
    return (
        f"{returned} for an image of {size[0]} x {size[1]} pixels; {_EXPECTED}, in its proportions"
    )
