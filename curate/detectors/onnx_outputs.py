"""Outputs of exported detectors: which is which, and their shapes.

Exporters name outputs as they like. An output is taken by its declared name in the options, by its
own name (boxes, scores, labels, or a usual other one), or else by what only it can be: boxes are
numbers [n, 7 or more], labels are integers [n], scores are numbers [n], or [n, classes] without
labels. Each may have a batch axis of length 1 in front.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from curate.errors import ConfigError, ModelError
from curate.files.onnx_session import ModelValue, is_numeric_array, without_batch

KEYS = ("boxes", "scores", "labels")
# Names in the exports of OpenPCDet, mmdetection3d and mmdeploy.
_USUAL_NAMES: Mapping[str, tuple[str, ...]] = {
    "boxes": ("boxes", "pred_boxes", "bboxes_3d", "boxes_3d"),
    "scores": ("scores", "pred_scores", "scores_3d"),
    "labels": ("labels", "pred_labels", "labels_3d"),
}
_FLOATS = ("tensor(float)", "tensor(float16)", "tensor(double)")
_INTEGERS = ("tensor(int64)", "tensor(int32)", "tensor(uint8)", "tensor(int8)", "tensor(int16)")


def find_outputs(outputs: Sequence[ModelValue], declared: Mapping[str, str]) -> Mapping[str, str]:
    """Return the output names of boxes, scores and, if the model has them, labels.

    Args:
        outputs: as the model declares them.
        declared: names by key, from the options.

    Raises:
        ConfigError: if `declared` has another key.
        ModelError: if an output does not exist, or none or several can be boxes or scores.
    """
    unknown = sorted(set(declared) - set(KEYS))
    if unknown:
        raise ConfigError(f"detector.options.outputs: {unknown[0]}: use {', '.join(KEYS)}")
    shown = ", ".join(map(str, outputs))
    available = {output.name for output in outputs}
    names: dict[str, str] = {}
    for key in KEYS:
        own = (declared[key],) if key in declared else _USUAL_NAMES[key]
        found = [name for name in own if name in available]
        if found:
            names[key] = found[0]
        elif key in declared:
            raise ModelError(f"the outputs are {shown}; there is no output {declared[key]}")
    for key in KEYS:
        if key in names:
            continue
        rest = [output for output in outputs if output.name not in names.values()]
        fitting = [output.name for output in rest if _can_be(key, output, has_labels=True)]
        if key == "scores" and not fitting:
            fitting = [output.name for output in rest if _can_be(key, output, has_labels=False)]
        if len(fitting) == 1:
            names[key] = fitting[0]
        elif fitting or key != "labels":
            several = f"several can be {key}" if fitting else f"there is no output {key}"
            raise ModelError(
                f"the outputs are {shown}; {several}; map boxes, scores and labels in "
                "detector.options.outputs"
            )
    return names


def _can_be(key: str, output: ModelValue, *, has_labels: bool) -> bool:
    """Return whether type and shape of an output are those of boxes, scores or labels."""
    shape = output.shape
    if key == "boxes":
        last = shape[-1] if shape else None
        rank = len(shape) in {2, 3}
        return output.type in _FLOATS and rank and isinstance(last, int) and last >= 7
    if key == "labels":
        return output.type in _INTEGERS and _is_column(shape)
    return output.type in _FLOATS and (_is_column(shape) or (not has_labels and len(shape) > 1))


def _is_column(shape: Sequence[int | str | None]) -> bool:
    """Return whether a shape is [n], [1, n] or [n, 1]; an axis with a name may be of any length."""
    others = [size for size in shape if size != 1]
    return len(shape) in {1, 2} and len(others) <= 1


@dataclass(frozen=True)
class RawBoxes:
    """The outputs of a model in a common form.

    Attributes:
        rows: (n, 7 or more) numbers of the boxes, in the model's convention.
        scores: (n,) float64, probabilities or logits.
        labels: (n,) numbers of classes.
    """

    rows: np.ndarray
    scores: np.ndarray
    labels: np.ndarray


def raw_boxes(named: Mapping[str, np.ndarray], first_label: int, classes: int) -> RawBoxes:
    """Return the outputs of one frame.

    Args:
        named: `boxes`, `scores` and, unless scores are per class or there is one class, `labels`.
        first_label: the number of the first class.
        classes: number of classes.

    Raises:
        ModelError: if an output is not an array of numbers, or the shapes do not fit.
    """
    arrays = {key: np.asarray(named[key]) for key in KEYS if key in named}
    for values in arrays.values():
        if not is_numeric_array(values):
            raise ModelError(f"an output is {values.dtype}, expected numbers")
    rows = without_batch(arrays["boxes"], 2)
    count = len(rows) if rows.ndim == 2 else -1
    labels = arrays.get("labels")
    candidates = list(_score_shapes(arrays["scores"], count, classes, labels is None))
    if labels is None and candidates and candidates[0].ndim == 2:
        best = candidates[0].argmax(axis=1)
        scores, labels = candidates[0].max(axis=1), best + first_label
    else:
        scores = candidates[0] if candidates else np.zeros(0)
        labels = np.full(len(scores), first_label) if labels is None else labels.reshape(-1)
    if count < 0 or rows.shape[1] < 7 or not candidates or labels.shape != (count,):
        described = ", ".join(f"{key} {list(values.shape)}" for key, values in arrays.items())
        raise ModelError(
            f"the outputs are {described}; expected boxes [n, 7 or more] with scores [n] and "
            f"labels [n], or scores [n, {classes}], a column per class of detector.options.classes"
        )
    return _without_padding(RawBoxes(rows, scores.astype(np.float64), labels), first_label)


def _score_shapes(
    scores: np.ndarray, count: int, classes: int, per_class: bool
) -> Iterator[np.ndarray]:
    """Yield the scores as (n, classes) or (n,), if their shape allows it."""
    scores = without_batch(scores, 2)
    if per_class and scores.shape == (count, classes):
        yield scores
    if (not per_class or classes == 1) and scores.shape in {(count,), (count, 1), (1, count)}:
        yield scores.reshape(-1)


def _without_padding(found: RawBoxes, first_label: int) -> RawBoxes:
    """Return the boxes without rows of label -1 and no score, which fill a fixed size."""
    padding = (found.labels == -1) & (found.scores <= 0) & (first_label >= 0)
    kept = np.flatnonzero(~padding)
    return RawBoxes(found.rows[kept], found.scores[kept], found.labels[kept])
