"""A segmenter that runs any instance segmentation model in ONNX format.

The model takes one RGB image, see `ImageInput`. If its input has a fixed size, the image is resized
with its aspect ratio kept and placed in the upper left corner of a grey image (letterbox). The
masks are combined into a semantic map. Where masks overlap, the mask with the higher score is on
top; a mask of a class without a category becomes background and hides the masks below it.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from curate.errors import ConfigError, ModelError
from curate.files.onnx_providers import AUTO, ProviderOptions, Providers
from curate.files.onnx_session import is_numeric_array
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.ranges import AtLeastOne, Share
from curate.segmenters.base import Segmenter, SemanticMap
from curate.segmenters.classes import background_id, checked_classes
from curate.segmenters.onnx_images import ImageModel, Scaling, image_of
from curate.segmenters.onnx_outputs import KINDS, Instance
from curate.segmenters.pasting import Box, paste_mask

_OUTPUTS = {name: name for name in ("boxes", "labels", "scores", "masks")}
_GREY = 114


class OnnxInstanceSegmenter(Segmenter):
    """A `Segmenter` that runs an ONNX model of instance segmentation.

    Args:
        model: the .onnx file.
        classes: the model's labels that count for each category.
        outputs: the model's output names, by meaning: `boxes`, `labels`, `scores` and `masks`
            (omit `scores` if they are the fifth column of the boxes), or `predictions` and
            `prototypes`.
        minimum_score: objects with a lower score are dropped.
        mask_threshold: a pixel belongs to the object if its mask value is above this.
        scaling: how pixels are scaled for a float model: "imagenet", "unit" (0 to 1) or "none" (0
            to 255).
        threads: number of threads of ONNX Runtime on the CPU.
        providers: where the model runs: "auto", a provider such as "cuda", or several.
        provider_options: options of ONNX Runtime's providers by their names.

    Raises:
        ModelError: if the file is missing or not an ONNX model, or its input is not an image.
        ConfigError: if an option or a class id is out of range, an output does not exist, or a
            listed provider cannot be used.
    """

    needs_image = True
    needs_points = False
    map_version = 1

    def __init__(
        self,
        model: StrPath,
        classes: Mapping[str, Sequence[int]],
        *,
        outputs: Mapping[str, str] | None = None,
        minimum_score: Share = 0.5,
        mask_threshold: float = 0.5,
        scaling: Scaling = "unit",
        threads: AtLeastOne = 1,
        providers: Providers = AUTO,
        provider_options: ProviderOptions | None = None,
    ) -> None:
        if not 0 <= minimum_score <= 1:
            raise ConfigError(f"segmenter.options.minimum_score {minimum_score}: expected 0 to 1")
        self.classes = checked_classes(classes)
        self.minimum_score = minimum_score
        self.mask_threshold = mask_threshold
        self._model = ImageModel(
            Path(model), scaling, threads, providers, provider_options, single=True
        )
        self._outputs = self._check_outputs(dict(outputs or _OUTPUTS))

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's masks as a semantic map.

        Raises:
            ModelError: if the frame has no image, or the model's output is of another kind.
        """
        image = image_of(frame)
        height, width = image.shape[:2]
        pixels, scale = self._letterbox(image)
        size = (pixels.shape[1], pixels.shape[0])
        background = background_id(self.classes)
        class_ids = np.full((height, width), background, dtype=np.uint8)
        used_ids = {class_id for ids in self.classes.values() for class_id in ids}
        for instance in self._instances(self._run_model(pixels), size):
            within = _scaled(instance.box, scale)
            covers = _scaled((0, 0, *size), scale) if instance.is_whole else within
            part, mask = paste_mask(
                instance.mask,
                covers,
                within,
                (width, height),
                self.mask_threshold,
                extended=instance.is_whole,
            )
            class_ids[part][mask] = instance.label if instance.label in used_ids else background
        return SemanticMap(class_ids, self.classes)

    def _check_outputs(self, outputs: dict[str, str]) -> dict[str, str]:
        """Return the declared outputs after a check that they exist and form a supported kind."""
        if frozenset(outputs) not in KINDS:
            kinds = "; or ".join(", ".join(sorted(kind)) for kind in KINDS)
            raise ConfigError(f"segmenter.options.outputs {', '.join(outputs)}: declare {kinds}")
        existing = [output.name for output in self._model.outputs]
        missing = [name for name in outputs.values() if name not in existing]
        if missing:
            raise ConfigError(
                f"{self._model.path}: has no output {', '.join(missing)}; its outputs are "
                f"{', '.join(existing)}; assign them in segmenter.options.outputs"
            )
        return outputs

    def _letterbox(self, image: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the image in the model's input size, and the scale factor."""
        height, width = image.shape[:2]
        shape = self._model.input
        target = (shape.height or height, shape.width or width)
        if target == (height, width):
            return image, 1.0
        scale = min(target[0] / height, target[1] / width)
        resized = max(round(width * scale), 1), max(round(height * scale), 1)
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        canvas = np.full((*target, 3), _GREY, dtype=np.uint8)
        canvas[: resized[1], : resized[0]] = cv2.resize(image, resized, interpolation=interpolation)
        return canvas, scale

    def _run_model(self, pixels: np.ndarray) -> dict[str, np.ndarray]:
        """Return the model's outputs by their meaning."""
        values = self._model.run(pixels, tuple(self._outputs.values()))
        values_of = {meaning: values[name] for meaning, name in self._outputs.items()}
        for name, values in values_of.items():
            if not is_numeric_array(values):
                raise ModelError(f"{self._model.path}: output {name} is not an array of numbers")
        return values_of

    def _instances(
        self, outputs: dict[str, np.ndarray], size: tuple[int, int]
    ) -> Iterator[Instance]:
        """Yield the objects one at a time, because all masks together may be large."""
        try:
            yield from KINDS[frozenset(self._outputs)](outputs, size, self.minimum_score)
        except ModelError as error:
            raise ModelError(f"{self._model.path}: {error}") from None


def _scaled(box: Box, scale: float) -> Box:
    """Convert a box from pixels of the model's input to pixels of the image."""
    left, top, right, bottom = (value / scale for value in box)
    return left, top, right, bottom
