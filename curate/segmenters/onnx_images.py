"""ONNX models that take an image: its type, the order of its axes, its size, its scaling."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curate.datasets.formats.images import MOST_PIXELS
from curate.errors import ConfigError, ModelError, first_line
from curate.files.onnx_session import open_session, runtime_errors
from curate.frames import Frame

# Mean and standard deviation of ImageNet's RGB, with which most published models were trained.
_IMAGENET = (np.array([0.485, 0.456, 0.406]) * 255, np.array([0.229, 0.224, 0.225]) * 255)
SCALINGS = {
    "imagenet": _IMAGENET,
    "unit": (np.zeros(3), np.full(3, 255.0)),
    "none": (np.zeros(3), np.ones(3)),
}
"""What a float model wants, as mean and deviation of pixels from 0 to 255."""

_EXPECTED = "expected one image [1, height, width, 3] or [1, 3, height, width], uint8 or float32"


@dataclass(frozen=True)
class ImageInput:
    """What a model wants.

    Attributes:
        name: of the input.
        is_float: float32, not uint8.
        channels_first: of the order of its axes.
        batched: whether there is an axis of images, of which one is given.
        height: None where it is free.
        width: likewise.
    """

    name: str
    is_float: bool
    channels_first: bool
    batched: bool
    height: int | None
    width: int | None

    def feed(self, pixels: np.ndarray, scaling: str) -> dict[str, np.ndarray]:
        """What the session takes for (height, width, 3) uint8 RGB pixels of the model's size."""
        if self.is_float:
            mean, deviation = SCALINGS[scaling]
            pixels = ((pixels - mean) / deviation).astype(np.float32)
        if self.channels_first:
            pixels = pixels.transpose(2, 0, 1)
        return {self.name: np.ascontiguousarray(pixels[None] if self.batched else pixels)}


class ImageModel:
    """An ONNX model that takes one image.

    Args:
        path: the .onnx file.
        scaling: see `SCALINGS`.
        threads: of ONNX Runtime.
        single: whether an image without an axis of images is taken too, [3, height, width].

    Attributes:
        input: see `ImageInput`.
        outputs: what it answers, as ONNX Runtime describes it.

    Raises:
        ConfigError: there is no such scaling.
        ModelError: the file is missing or no ONNX model, or it takes something else.
    """

    def __init__(self, path: Path, scaling: str, threads: int, *, single: bool = False) -> None:
        if scaling not in SCALINGS:
            raise ConfigError(f"segmenter scaling {scaling!r}: use one of {', '.join(SCALINGS)}")
        self.path = Path(path)
        self._scaling = scaling
        self._session = open_session(self.path, threads, "segmenter")
        self.input = _image_input(self._session, self.path, single=single)
        self.outputs = self._session.get_outputs()

    def run(self, pixels: np.ndarray, outputs: Sequence[str]) -> list[Any]:
        """Return the named outputs for (height, width, 3) uint8 RGB pixels of the model's size.

        Raises:
            ModelError: if the model fails.
        """
        try:
            found: list[Any] = self._session.run(
                list(outputs), self.input.feed(pixels, self._scaling)
            )
        except runtime_errors() as error:
            raise ModelError(f"{self.path}: {first_line(error)}") from error
        return found


def image_of(frame: Frame) -> np.ndarray:
    """Return (height, width, 3) uint8 RGB, what a frame's camera saw.

    Raises:
        ModelError: if the frame was read without it.
    """
    if frame.image is None:
        raise ModelError(f"frame {frame.frame_id} was read without the image to segment")
    return frame.image


def _image_input(session: Any, model: Path, *, single: bool) -> ImageInput:
    """The input of a model that takes one image; ModelError where it takes something else."""
    inputs = session.get_inputs()
    found = ", ".join(f"{one.name} {one.type}{one.shape}" for one in inputs)
    fault = ModelError(f"{model}: takes {found}; {_EXPECTED}")
    if len(inputs) != 1 or len(inputs[0].shape) not in ({3, 4} if single else {4}):
        raise fault
    one = inputs[0]
    sizes = [size if isinstance(size, int) else None for size in one.shape]
    batched = len(sizes) == 4
    batch, first, second, last = sizes if batched else (1, *sizes)
    channels_first = last != 3
    if (
        batch not in {1, None}
        or (first if channels_first else last) != 3
        or one.type not in {"tensor(uint8)", "tensor(float)"}
    ):
        raise fault
    height, width = (second, last) if channels_first else (first, second)
    if 0 in {height, width} or (height or 1) * (width or 1) > MOST_PIXELS:
        # Each frame would be blown up to that size.
        raise ModelError(f"{model}: takes {found}; images of 1 to {MOST_PIXELS} pixels are made")
    return ImageInput(one.name, one.type == "tensor(float)", channels_first, batched, height, width)
