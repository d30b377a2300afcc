"""Any instance segmentation model that was exported to ONNX, its masks laid over each other.

The model takes one RGB image, see `ImageInput`. Into a fixed size the image is shrunk with its
proportions kept, in the upper left corner of a grey one. Where masks overlap, the higher score is
on top; a mask of a class that means no category hides what is behind it.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from curate.errors import ConfigError, ModelError
from curate.files.onnx_session import is_numeric_array
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.segmenters.base import SemanticMap
from curate.segmenters.classes import checked_classes, free_id
from curate.segmenters.onnx_images import ImageModel, image_of
from curate.segmenters.onnx_outputs import KINDS, Instance
from curate.segmenters.pasting import Box, paste_mask

_OUTPUTS = {name: name for name in ("boxes", "labels", "scores", "masks")}
_GREY = 114


class OnnxInstanceSegmenter:
    """A `Segmenter` that runs an ONNX model of instance segmentation on the CPU.

    Args:
        model: the .onnx file.
        classes: the model's labels that count for each category.
        outputs: the names of its outputs: `boxes`, `labels`, `scores` and `masks`, without scores
            where they stand behind the boxes; or `predictions` and `prototypes`.
        minimum_score: objects below it are left out.
        mask_threshold: a pixel is the object's where its mask is above.
        scaling: what a float model wants: "imagenet", "unit" (0 to 1) or "none" (0 to 255).
        threads: of ONNX Runtime.

    Raises:
        ModelError: the file is missing or no ONNX model, or its input is no image.
        ConfigError: an option or a class id is out of range, or there is no such output.
    """

    needs_image = True
    needs_points = False

    def __init__(
        self,
        model: StrPath,
        classes: Mapping[str, Sequence[int]],
        *,
        outputs: Mapping[str, str] | None = None,
        minimum_score: float = 0.5,
        mask_threshold: float = 0.5,
        scaling: str = "unit",
        threads: int = 1,
    ) -> None:
        if not 0 <= minimum_score <= 1:
            raise ConfigError(f"segmenter minimum_score {minimum_score}: 0 to 1")
        self.classes = checked_classes(classes)
        self.minimum_score = minimum_score
        self.mask_threshold = mask_threshold
        self._model = ImageModel(Path(model), scaling, threads, single=True)
        self._outputs = self._declared(dict(outputs or _OUTPUTS))

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's masks as a semantic map.

        Raises:
            ModelError: if the frame has no image, or the model's answer is of another kind.
        """
        image = image_of(frame)
        height, width = image.shape[:2]
        pixels, scale = self._fitted(image)
        size = (pixels.shape[1], pixels.shape[0])
        class_ids = np.full((height, width), free_id(self.classes), dtype=np.uint8)
        wanted = {one for ids in self.classes.values() for one in ids}
        for one in self._instances(self._run_model(pixels), size):
            within = _scaled(one.box, scale)
            covers = _scaled((0, 0, *size), scale) if one.is_whole else within
            part, mask = paste_mask(
                one.mask,
                covers,
                within,
                (width, height),
                self.mask_threshold,
                extended=one.is_whole,
            )
            class_ids[part][mask] = one.label if one.label in wanted else free_id(self.classes)
        return SemanticMap(class_ids, self.classes)

    def _declared(self, outputs: dict[str, str]) -> dict[str, str]:
        """The outputs as declared, which must be there and together say what an object is."""
        if frozenset(outputs) not in KINDS:
            kinds = "; or ".join(", ".join(sorted(kind)) for kind in KINDS)
            raise ConfigError(f"segmenter outputs {', '.join(outputs)}: declare {kinds}")
        there = [one.name for one in self._model.outputs]
        missing = [name for name in outputs.values() if name not in there]
        if missing:
            raise ConfigError(
                f"{self._model.path}: has no output {', '.join(missing)} but {', '.join(there)}; "
                "say which is which in segmenter.options.outputs"
            )
        return outputs

    def _fitted(self, image: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the image in the size that the model takes, and by what it was scaled."""
        height, width = image.shape[:2]
        shape = self._model.input
        target = (shape.height or height, shape.width or width)
        if target == (height, width):
            return image, 1.0
        scale = min(target[0] / height, target[1] / width)
        kept = max(round(width * scale), 1), max(round(height * scale), 1)
        kind = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        fitted = np.full((*target, 3), _GREY, dtype=np.uint8)
        fitted[: kept[1], : kept[0]] = cv2.resize(image, kept, interpolation=kind)
        return fitted, scale

    def _run_model(self, pixels: np.ndarray) -> dict[str, np.ndarray]:
        """What the model answers, by what it means."""
        found = self._model.run(pixels, tuple(self._outputs.values()))
        answer = dict(zip(self._outputs, found, strict=True))
        for name, values in answer.items():
            if not is_numeric_array(values):
                raise ModelError(f"{self._model.path}: answers {name} that are no array of numbers")
        return answer

    def _instances(
        self, answer: dict[str, np.ndarray], size: tuple[int, int]
    ) -> Iterator[Instance]:
        """Yield the objects of an answer, one at a time: their masks together may be large."""
        try:
            yield from KINDS[frozenset(self._outputs)](answer, size, self.minimum_score)
        except ModelError as error:
            raise ModelError(f"{self._model.path}: {error}") from None


def _scaled(box: Box, scale: float) -> Box:
    """Return a box of the model's input in the image."""
    left, top, right, bottom = (value / scale for value in box)
    return left, top, right, bottom
