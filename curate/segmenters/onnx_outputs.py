"""Parsing of the outputs of instance segmentation models: one `Instance` per object.

Two kinds of output are supported:

- Mask R-CNN: boxes with labels and scores, and a mask per box. A mask covers either its box (28 x
  28 cells) or the whole input.
- YOLO (Bolya et al. 2019): predictions [1, 4 + classes + coefficients, n] before non-maximum
  suppression, and prototypes [1, coefficients, h, w]. A mask is the sum of the prototypes, weighted
  with the object's coefficients.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from curate.errors import ModelError
from curate.files.onnx_session import without_batch
from curate.segmenters.pasting import Box

Outputs = Mapping[str, np.ndarray]
# Only the objects with the highest scores are read, up to this number.
_MAX_OBJECTS = 1000
_NMS_IOU = 0.45
# Largest accepted coordinate in pixels, and largest number of mask cells along a side.
_MAX_COORDINATE, _MAX_CELLS = 1e7, 8192


@dataclass(frozen=True)
class Instance:
    """One object, in pixels of the model's input.

    Attributes:
        label: the model's class of the object.
        box: left, top, right, bottom; pixels outside do not belong to the object.
        mask: (h, w) values from 0 to 1.
        is_whole: whether the mask covers the whole input; otherwise it covers the box.
    """

    label: int
    box: Box
    mask: np.ndarray
    is_whole: bool


def boxed_instances(
    outputs: Outputs, size: tuple[int, int], minimum_score: float
) -> Iterator[Instance]:
    """Yield the objects of a Mask R-CNN model, lowest score first.

    Args:
        outputs: `boxes` (n, 4), or (n, 5) with the score in the last column, `labels` (n,),
            `scores` (n,), and `masks` (n, h, w) or (n, 1, h, w). Each may have a leading batch axis
            of length 1.
        size: (width, height) of the input in pixels; masks of this size cover the whole input.
        minimum_score: objects with a lower score are dropped.

    Raises:
        ModelError: if a shape or a value is invalid.
    """
    boxes = without_batch(outputs["boxes"], 2)
    masks = outputs["masks"]
    masks = masks[0] if masks.ndim == 5 or (masks.ndim == 4 and masks.shape[1] != 1) else masks
    masks = masks[:, 0] if masks.ndim == 4 else masks
    labels = without_batch(outputs["labels"], 1)
    if "scores" in outputs:
        scores = without_batch(outputs["scores"], 1)
    else:
        scores = boxes[:, 4] if boxes.ndim == 2 and boxes.shape[1] == 5 else np.zeros(0)
    fits = boxes.ndim == 2 and boxes.shape[1] in (4, 5) and masks.ndim == 3
    if not fits or {labels.shape, scores.shape, masks.shape[:1]} != {boxes.shape[:1]}:
        expected = "boxes [n, 4], labels [n], scores [n], masks [n, h, w]"
        raise ModelError(_shape_error(outputs, expected))
    _check_instances(boxes, scores, labels.astype(np.float64))
    _check_masks(masks)
    whole = (0.0, 0.0, float(size[0]), float(size[1]))
    is_whole = masks.shape[1:] == (size[1], size[0])
    for i in _by_rising_score(scores, minimum_score):
        box = whole if is_whole else _box(boxes[i])
        yield Instance(int(labels[i]), box, _mask_values(masks[i]), is_whole)


def prototype_instances(
    outputs: Outputs, _size: tuple[int, int], minimum_score: float
) -> Iterator[Instance]:
    """Yield the objects of a YOLO model, lowest score first; see `boxed_instances`.

    The prototypes cover the whole input, so its size is not needed.
    """
    predictions, prototypes = outputs["predictions"], outputs["prototypes"]
    count = prototypes.shape[1] if prototypes.ndim == 4 else 0
    classes = predictions.shape[1] - 4 - count if predictions.ndim == 3 else 0
    if classes < 1 or count < 1 or {len(predictions), len(prototypes)} != {1}:
        expected = "predictions [1, 4 + classes + m, n] and prototypes [1, m, h, w]"
        raise ModelError(_shape_error(outputs, expected))
    rows = predictions[0].T.astype(np.float64)
    labels = rows[:, 4 : 4 + classes].argmax(axis=1)
    scores = rows[np.arange(len(rows)), 4 + labels]
    corners = np.column_stack([rows[:, :2] - rows[:, 2:4] / 2, rows[:, :2] + rows[:, 2:4] / 2])
    _check_instances(corners, scores, labels.astype(np.float64))
    _check_masks(prototypes)
    candidates = np.array(_by_rising_score(scores, minimum_score), dtype=np.int64)
    left_top_size = np.column_stack([corners[candidates, :2], rows[candidates, 2:4]])
    kept = cv2.dnn.NMSBoxesBatched(
        left_top_size.tolist(),
        scores[candidates].tolist(),
        labels[candidates].tolist(),
        0.0,
        _NMS_IOU,
    )
    for i in candidates[np.sort(np.asarray(kept, dtype=np.int64))].tolist():
        sums = np.tensordot(rows[i, 4 + classes :], prototypes[0].astype(np.float64), axes=1)
        # The logistic function in a form that does not overflow.
        mask = _mask_values((1 + np.tanh(sums / 2)) / 2)
        yield Instance(int(labels[i]), _box(corners[i]), mask, is_whole=True)


Reader = Callable[[Outputs, tuple[int, int], float], Iterator[Instance]]
KINDS: Mapping[frozenset[str], Reader] = {
    frozenset({"boxes", "labels", "scores", "masks"}): boxed_instances,
    frozenset({"boxes", "labels", "masks"}): boxed_instances,
    frozenset({"predictions", "prototypes"}): prototype_instances,
}
"""The function that parses each supported set of declared outputs."""


def _by_rising_score(scores: np.ndarray, minimum_score: float) -> list[int]:
    """Return the indices of the objects with at least the minimum score, lowest first."""
    order = np.argsort(scores, kind="stable")[-_MAX_OBJECTS:]
    rising: list[int] = order[scores[order] >= minimum_score].tolist()
    return rising


def _check_instances(boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray) -> None:
    """Raise ModelError if a box or score is not a sane number, or a label is not an integer."""
    if not (np.abs(boxes) < _MAX_COORDINATE).all() or not np.isfinite(scores).all():
        raise ModelError(
            f"returns a box or score that is NaN, infinite or beyond {_MAX_COORDINATE:g}"
        )
    valid = np.isfinite(labels) & (labels == np.floor(labels)) & (np.abs(labels) < 2**31)
    if not valid.all():
        raise ModelError(f"returns label {labels[~valid][0]}, which is not an integer")


def _check_masks(masks: np.ndarray) -> None:
    """Raise ModelError if the masks have no cells, or more than any image needs."""
    height, width = masks.shape[-2:]
    if len(masks) and not (0 < height <= _MAX_CELLS and 0 < width <= _MAX_CELLS):
        raise ModelError(
            f"returns masks of {width} x {height} cells; expected 1 to {_MAX_CELLS} along a side"
        )


def _box(row: np.ndarray) -> Box:
    left, top, right, bottom = row[:4].tolist()
    return left, top, right, bottom


def _mask_values(mask: np.ndarray) -> np.ndarray:
    """Return mask values from 0 to 1; of an integer mask, all values above 0 become 1.

    Raises:
        ModelError: if a value is NaN or infinite, which would otherwise count as background.
    """
    if not np.issubdtype(mask.dtype, np.floating):
        return mask > 0
    if not np.isfinite(mask).all():
        raise ModelError("returns a mask that contains NaN or infinite values")
    return mask


def _shape_error(outputs: Outputs, expected: str) -> str:
    shown = ", ".join(f"{name} {list(values.shape)}" for name, values in outputs.items())
    return f"returns {shown}; expected {expected}"
