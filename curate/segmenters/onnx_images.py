"""ONNX models with one image as input: its type, axis order, size and scaling."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from curate.datasets.formats.images import MAX_PIXELS
from curate.errors import ConfigError, ModelError
from curate.files.onnx_providers import AUTO, ProviderOptions, Providers
from curate.files.onnx_session import ModelValue, OnnxModel, is_numeric_array
from curate.frames import Frame
from curate.ranges import AtLeastOne

# Mean and standard deviation of ImageNet's RGB, as used to train most published models.
_IMAGENET = (np.array([0.485, 0.456, 0.406]) * 255, np.array([0.229, 0.224, 0.225]) * 255)
Scaling = Literal["imagenet", "unit", "none"]
SCALINGS: Mapping[Scaling, tuple[np.ndarray, np.ndarray]] = {
    "imagenet": _IMAGENET,
    "unit": (np.zeros(3), np.full(3, 255.0)),
    "none": (np.zeros(3), np.ones(3)),
}
"""Mean and standard deviation by which pixels (0 to 255) are normalised for a float model."""

# Types of inputs of images.
_TYPES = {
    "tensor(uint8)": np.uint8,
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
}
_EXPECTED = (
    "expected one image [1, height, width, 3] or [1, 3, height, width], uint8, float16, float32 or "
    "double"
)


@dataclass(frozen=True)
class ImageInput:
    """The image input of a model.

    Attributes:
        name: name of the input.
        kind: numpy type of the values: uint8, float16, float32 or float64.
        channels_first: whether the axes are channels, height, width; otherwise the channels are
            last.
        batched: whether there is a leading batch axis.
        several: whether the batch axis may be longer than 1.
        height: height in pixels; None if any height is accepted.
        width: width in pixels; None if any width is accepted.
    """

    name: str
    kind: type
    channels_first: bool
    batched: bool
    several: bool
    height: int | None
    width: int | None

    def feed(self, images: Sequence[np.ndarray], scaling: Scaling) -> dict[str, np.ndarray]:
        """Return the session's inputs for (height, width, 3) uint8 RGB images of the input size.

        Several images need an input that takes several.
        """
        mean, deviation = SCALINGS[scaling]
        pixels = np.stack(
            [
                image if self.kind is np.uint8 else ((image - mean) / deviation).astype(self.kind)
                for image in images
            ]
        )
        if self.channels_first:
            pixels = pixels.transpose(0, 3, 1, 2)
        return {self.name: np.ascontiguousarray(pixels if self.batched else pixels[0])}


class ImageModel:
    """An ONNX model with one image as input.

    Args:
        path: the .onnx file.
        scaling: a name in `SCALINGS`.
        threads: number of threads of ONNX Runtime on the CPU.
        providers: where the model runs, see `curate.files.onnx_providers`.
        provider_options: options of the providers.
        single: whether an input without a batch axis, e.g. [3, height, width], is accepted too.

    Attributes:
        input: the image input, see `ImageInput`.
        outputs: the declared outputs.

    Raises:
        ConfigError: if there is no such scaling, or a listed provider cannot be used.
        ModelError: if the file is missing or not an ONNX model, or has another kind of input.
    """

    def __init__(
        self,
        path: Path,
        scaling: Scaling,
        threads: AtLeastOne,
        providers: Providers = AUTO,
        provider_options: ProviderOptions | None = None,
        *,
        single: bool = False,
    ) -> None:
        if scaling not in SCALINGS:
            raise ConfigError(
                f"segmenter.options.scaling {scaling!r}: use one of {', '.join(SCALINGS)}"
            )
        self.path = Path(path)
        self._scaling = scaling
        self._model = OnnxModel(self.path, threads, "segmenter", providers, provider_options)
        self.input = _image_input(self._model.inputs, self.path, single=single)
        self._takes_several = self.input.several
        self.outputs = self._model.outputs

    def run(self, pixels: np.ndarray, outputs: Sequence[str]) -> dict[str, Any]:
        """Return the named outputs for (height, width, 3) uint8 RGB pixels of the input size.

        Raises:
            ModelError: if the model fails.
        """
        return self._model.run(self.input.feed([pixels], self._scaling), outputs)

    def run_all(self, images: Sequence[np.ndarray], output: str) -> list[np.ndarray]:
        """Return an output for each of several images of the input size, with a batch axis of 1.

        They go through the model as one batch if it takes one, else one after the other.

        Raises:
            ModelError: if the model fails.
        """
        if len(images) > 1 and self._takes_several:
            try:
                values = self._model.run(self.input.feed(images, self._scaling), [output])[output]
            except ModelError:  # a free axis is declared, but another part of the model is fixed
                self._takes_several = False
            else:
                if is_numeric_array(values) and len(values) == len(images):
                    return [values[i : i + 1] for i in range(len(images))]
                self._takes_several = False
        return [self.run(image, [output])[output] for image in images]


def image_of(frame: Frame) -> np.ndarray:
    """Return the frame's image, (height, width, 3) uint8 RGB.

    Raises:
        ModelError: if the frame was read without its image.
    """
    if frame.image is None:
        raise ModelError(f"frame {frame.frame_id} was read without the image to segment")
    return frame.image


def _image_input(inputs: Sequence[ModelValue], model: Path, *, single: bool) -> ImageInput:
    """Return the image input of a model.

    Raises:
        ModelError: if the model has other inputs, or its image has an invalid size.
    """
    shown = ", ".join(map(str, inputs))
    invalid = ModelError(f"{model}: takes {shown}; {_EXPECTED}")
    if len(inputs) != 1 or len(inputs[0].shape) not in ({3, 4} if single else {4}):
        raise invalid
    image = inputs[0]
    sizes = [size if isinstance(size, int) else None for size in image.shape]
    batched = len(sizes) == 4
    batch, first, second, last = sizes if batched else (1, *sizes)
    channels_first = last != 3
    if (
        batch not in {1, None}
        or (first if channels_first else last) != 3
        or image.type not in _TYPES
    ):
        raise invalid
    height, width = (second, last) if channels_first else (first, second)
    if 0 in {height, width} or (height or 1) * (width or 1) > MAX_PIXELS:
        # Each frame would be enlarged to that size.
        raise ModelError(f"{model}: takes {shown}; expected an image of 1 to {MAX_PIXELS} pixels")
    kind = _TYPES[image.type]
    several = batched and batch is None
    return ImageInput(image.name, kind, channels_first, batched, several, height, width)
