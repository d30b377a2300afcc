"""Detector that runs any 3D detector exported to ONNX, with configured inputs and outputs.

The model takes the points of a sweep, [n, 3 or 4] or [1, n, 3 or 4] (x, y, z, intensity). It
returns boxes [n, >=7] with either scores and labels [n], or scores per class [n, classes]; see
`onnx_outputs`. If the export leaves out voxelisation or the decoding of anchors, the user
provides them as two functions, each configured as `package.module:function`.
"""

import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curate.detections import Detections, as_categories
from curate.detectors.conventions import BoxConvention
from curate.detectors.onnx_outputs import find_outputs, raw_boxes
from curate.detectors.scores import describe_invalid_scores, to_probabilities
from curate.errors import ConfigError, ModelError
from curate.files.onnx_providers import AUTO, ProviderOptions, Providers
from curate.files.onnx_session import OnnxModel
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.geometry.nms import nms_bev
from curate.option_values import describe_wrong_values
from curate.ranges import AboveZero, AtLeastOne, Count, Share

# Types of inputs of points.
_FLOATS = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(double)": np.float64}


class OnnxDetector:
    """A `Detector` that runs an ONNX model.

    Args:
        model: the .onnx file.
        classes: the categories in the order of the model's labels or score columns.
        categories: the categories of the project; used if `classes` is not given.
        minimum_score: boxes with a lower score are left out.
        points: name of the input that takes the points; not needed if there is one input.
        outputs: names of the outputs for `boxes`, `scores` and, unless scores are per class,
            `labels`; not needed if names, types or shapes show which is which.
        convention: meaning of the numbers of a box, see `BoxConvention`.
        intensity_scale: factor from [0, 1] to the intensity range of the model, e.g. 255.
        first_label: the number of the first class.
        sigmoid: whether scores are logits.
        nms_iou: BEV IoU above which the higher-scored box of a category suppresses the other; None
            if the model suppresses boxes itself.
        nms_across: whether boxes of all categories suppress each other.
        preprocess: `package.module:function` from (n, 4) points to the model's inputs by name.
        postprocess: `package.module:function` from the outputs by name to `boxes`, `scores` and
            `labels` by name.
        threads: number of threads of ONNX Runtime on the CPU.
        providers: where the model runs: "auto", a provider such as "cuda", or several.
        provider_options: options of ONNX Runtime's providers by their names.

    Raises:
        ModelError: if the file is missing or not an ONNX model, or its inputs or outputs do not
            fit.
        ConfigError: if an option is invalid, a function cannot be imported, or a listed provider
            cannot be used.
    """

    def __init__(
        self,
        model: StrPath,
        *,
        classes: Sequence[str] | None = None,
        categories: Sequence[str] = (),
        minimum_score: Share = 0.1,
        points: str | None = None,
        outputs: Mapping[str, str] | None = None,
        convention: Mapping[str, Any] | None = None,
        intensity_scale: AboveZero = 1.0,
        first_label: Count = 0,
        sigmoid: bool = False,
        nms_iou: Share | None = None,
        nms_across: bool = False,
        preprocess: str | None = None,
        postprocess: str | None = None,
        threads: AtLeastOne = 1,
        providers: Providers = AUTO,
        provider_options: ProviderOptions | None = None,
    ) -> None:
        self.model = Path(model)
        self.classes = tuple(classes or categories)
        self.minimum_score = minimum_score
        self.convention = _convention(convention or {})
        self.intensity_scale = intensity_scale
        self.first_label = first_label
        self.sigmoid = sigmoid
        self.nms_iou = nms_iou
        self.nms_across = nms_across
        self._preprocess = _import_function(preprocess) if preprocess else None
        self._postprocess = _import_function(postprocess) if postprocess else None
        self._network = OnnxModel(self.model, threads, "detector", providers, provider_options)
        if not self._preprocess:
            self._input, self._shape = self._find_input(points)
        self._names = {} if self._postprocess else self._find_outputs(outputs or {})

    def category_names(self) -> tuple[str, ...]:
        """See `curate.detectors.base.NamesCategories`."""
        return self.classes

    def predict(self, frame: Frame) -> Detections:
        """See `curate.detectors.base.Detector`; a sweep without points has no boxes.

        Raises:
            ModelError: if the model fails, or its outputs do not have the configured form.
        """
        if len(frame.points) == 0:
            return Detections.empty()
        outputs = self._network.run(self._inputs(frame.points))
        if self._postprocess:
            named = _call(self._postprocess, outputs, self.model)
        else:
            named = {key: outputs[name] for key, name in self._names.items()}
        found = self._detections(named)
        found = found.select(np.flatnonzero(found.scores >= self.minimum_score))
        if self.nms_iou is not None:
            found = _suppress(found, self.nms_iou, across=self.nms_across)
        return found.select(np.argsort(-found.scores, kind="stable"))

    def _inputs(self, points: np.ndarray) -> Mapping[str, np.ndarray]:
        """Return the model's inputs by name."""
        scaled = points.astype(np.float32)  # a copy
        scaled[:, 3] *= self.intensity_scale
        if self._preprocess:
            return _call(self._preprocess, scaled, self.model)
        columns = self._shape[-1] if isinstance(self._shape[-1], int) else 4
        rows = np.ascontiguousarray(scaled[:, :columns], dtype=self._kind)
        return {self._input: rows[None] if len(self._shape) == 3 else rows}

    def _detections(self, named: Mapping[str, np.ndarray]) -> Detections:
        """Return the outputs as detections; raise ModelError if their shapes do not fit."""
        try:
            raw = raw_boxes(named, self.first_label, len(self.classes))
        except ModelError as error:
            raise ModelError(f"{self.model}: {error}") from None
        scores, labels = raw.scores, raw.labels
        scores = to_probabilities(scores, sigmoid=self.sigmoid)
        self._check_values(scores, labels)
        boxes = self.convention.to_boxes(raw.rows)
        index = labels.astype(np.int64) - self.first_label
        return Detections(boxes, scores, as_categories([self.classes[i] for i in index.tolist()]))

    def _check_values(self, scores: np.ndarray, labels: np.ndarray) -> None:
        """Raise ModelError if a score is not in [0, 1] or a label is not a configured class."""
        if len(scores) == 0:
            return
        if problem := describe_invalid_scores(scores.min(), scores.max()):
            raise ModelError(f"{self.model}: {problem}")
        last = self.first_label + len(self.classes) - 1
        within = labels.min() >= self.first_label and labels.max() <= last
        if not within or (labels != np.floor(labels)).any():
            raise ModelError(
                f"{self.model}: labels {labels.min()} to {labels.max()}, but classes "
                f"{', '.join(self.classes)} are {self.first_label} to {last}; set classes and "
                "first_label in detector.options"
            )

    def _find_input(self, name: str | None) -> tuple[str, Sequence[int | str | None]]:
        """Return name and shape of the input that takes the points."""
        inputs = self._network.inputs
        described = ", ".join(map(str, inputs))
        chosen = next((each for each in inputs if name in {None, each.name}), None)
        if chosen is None:
            raise ModelError(
                f"{self.model}: the inputs are {described}; there is no input {name}; "
                "set detector.options.points"
            )
        shape = chosen.shape
        fits = len(shape) in {2, 3} and (
            len(shape) == 2 or shape[0] in {1, None} or _free(shape[0])
        )
        if (
            len(inputs) != 1
            or not fits
            or chosen.type not in _FLOATS
            or not _free(shape[-2])
            or not (_free(shape[-1]) or shape[-1] in {3, 4})
        ):
            raise ModelError(
                f"{self.model}: the inputs are {described}; expected one tensor [n, 4] of points "
                "with a free n, float16, float or double; set detector.options.preprocess to a "
                "function that makes the inputs"
            )
        self._kind = _FLOATS[chosen.type]
        return chosen.name, shape

    def _find_outputs(self, declared: Mapping[str, str]) -> Mapping[str, str]:
        """Return the output names of boxes, scores and, if the model has them, labels."""
        try:
            return find_outputs(self._network.outputs, declared)
        except ModelError as error:
            raise ModelError(f"{self.model}: {error}") from None


def _free(size: int | str | None) -> bool:
    """Return whether a dimension of a shape is not fixed."""
    return not isinstance(size, int)


def _convention(options: Mapping[str, Any]) -> BoxConvention:
    if wrong := describe_wrong_values(BoxConvention, options):
        raise ConfigError(f"detector.options.convention.{wrong}")
    try:
        return BoxConvention(**options)
    except TypeError as error:
        raise ConfigError(f"detector.options.convention: {error}") from None


def _import_function(name: str) -> Callable[[Any], Any]:
    """Return the function at `package.module:function`."""
    module_name, _, function_name = name.partition(":")
    try:
        found = getattr(importlib.import_module(module_name), function_name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"detector.options: '{name}' cannot be imported: {error}") from error
    if not callable(found):
        raise ConfigError(f"detector.options: '{name}' is not a function")
    return found  # type: ignore[no-any-return]


def _call(function: Callable[[Any], Any], argument: Any, model: Path) -> Mapping[str, np.ndarray]:
    """Return the result of the user's function; raise ModelError if it is not a mapping."""
    result = function(argument)
    if not isinstance(result, Mapping):
        raise ModelError(
            f"{model}: {function.__name__} returned {type(result).__name__}, expected a dict"
        )
    return result


def _suppress(found: Detections, nms_iou: float, *, across: bool) -> Detections:
    """Return the detections that remain after suppression, per category or across them."""
    kept = [np.zeros(0, dtype=np.int64)]
    groups = np.zeros(len(found)) if across else found.categories
    for group in np.unique(groups):
        index = np.flatnonzero(groups == group)
        kept.append(index[nms_bev(found.boxes[index], found.scores[index], nms_iou)])
    return found.select(np.sort(np.concatenate(kept)))
