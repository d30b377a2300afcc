"""What instance segmentation models answer, in one form: boxes, labels, scores, masks.

Two kinds. Mask R-CNN's: boxes with labels and scores, and a mask per box, either of the box (28 x
28 cells) or of the whole input. YOLO's: predictions [1, 4 + classes + coefficients, n], whose masks
are sums of prototypes [1, coefficients, h, w], before non-maximum suppression (Bolya et al. 2019).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from curate.errors import ModelError
from curate.segmenters.pasting import Box

Answer = Mapping[str, np.ndarray]
# No image shows more objects; what is below the first ones is not looked at.
_MOST_OBJECTS = 1000
_NMS_IOU = 0.45
# Pixels; no input is so large, and no mask has so many cells along a side.
_FARTHEST, _MOST_CELLS = 1e7, 8192


@dataclass(frozen=True)
class Instance:
    """An object in the pixels of the model's input.

    Attributes:
        label: its class.
        box: left, top, right, bottom; pixels outside are not the object's.
        mask: (h, w) values from 0 to 1.
        is_whole: whether the mask covers the whole input, not the box.
    """

    label: int
    box: Box
    mask: np.ndarray
    is_whole: bool


def boxed_instances(
    answer: Answer, size: tuple[int, int], minimum_score: float
) -> Iterator[Instance]:
    """Yield the objects of a model of Mask R-CNN's kind, the lowest score first.

    Args:
        answer: boxes (n, 4), or (n, 5) with the score behind them, labels (n,), scores (n,), masks
            (n, h, w) or (n, 1, h, w); each may have one more axis of length 1 before the others.
        size: (width, height) of the input; masks of this size cover all of it.
        minimum_score: objects below it are left out.

    Raises:
        ModelError: if a shape or a number cannot be.
    """
    boxes = _without_batch(answer["boxes"], 2)
    masks = answer["masks"]
    masks = masks[0] if masks.ndim == 5 or (masks.ndim == 4 and masks.shape[1] != 1) else masks
    masks = masks[:, 0] if masks.ndim == 4 else masks
    labels = _without_batch(answer["labels"], 1)
    if "scores" in answer:
        scores = _without_batch(answer["scores"], 1)
    else:
        scores = boxes[:, 4] if boxes.ndim == 2 and boxes.shape[1] == 5 else np.zeros(0)
    fits = boxes.ndim == 2 and boxes.shape[1] in (4, 5) and masks.ndim == 3
    if not fits or {labels.shape, scores.shape, masks.shape[:1]} != {boxes.shape[:1]}:
        raise ModelError(_misfit(answer, "boxes [n, 4], labels [n], scores [n], masks [n, h, w]"))
    _check_instances(boxes, scores, labels.astype(np.float64))
    _check_masks(masks)
    whole = (0.0, 0.0, float(size[0]), float(size[1]))
    is_whole = masks.shape[1:] == (size[1], size[0])
    for i in _rising(scores, minimum_score):
        box = whole if is_whole else _box(boxes[i])
        yield Instance(int(labels[i]), box, _cells(masks[i]), is_whole)


def prototype_instances(
    answer: Answer, _size: tuple[int, int], minimum_score: float
) -> Iterator[Instance]:
    """Yield the objects of a model of YOLO's kind, the lowest score first; see `boxed_instances`.

    Prototypes cover the whole input, whatever its size.
    """
    found, prototypes = answer["predictions"], answer["prototypes"]
    count = prototypes.shape[1] if prototypes.ndim == 4 else 0
    classes = found.shape[1] - 4 - count if found.ndim == 3 else 0
    if classes < 1 or count < 1 or {len(found), len(prototypes)} != {1}:
        expected = "predictions [1, 4 + classes + m, n] and prototypes [1, m, h, w]"
        raise ModelError(_misfit(answer, expected))
    rows = found[0].T.astype(np.float64)
    labels = rows[:, 4 : 4 + classes].argmax(axis=1)
    scores = rows[np.arange(len(rows)), 4 + labels]
    corners = np.column_stack([rows[:, :2] - rows[:, 2:4] / 2, rows[:, :2] + rows[:, 2:4] / 2])
    _check_instances(corners, scores, labels.astype(np.float64))
    _check_masks(prototypes)
    first = np.array(_rising(scores, minimum_score), dtype=np.int64)
    left_top = np.column_stack([corners[first, :2], rows[first, 2:4]])
    kept = cv2.dnn.NMSBoxesBatched(
        left_top.tolist(), scores[first].tolist(), labels[first].tolist(), 0.0, _NMS_IOU
    )
    for i in first[np.sort(np.asarray(kept, dtype=np.int64))].tolist():
        sums = np.tensordot(rows[i, 4 + classes :], prototypes[0].astype(np.float64), axes=1)
        # The logistic function, which does not overflow in this form.
        mask = _cells((1 + np.tanh(sums / 2)) / 2)
        yield Instance(int(labels[i]), _box(corners[i]), mask, is_whole=True)


Reader = Callable[[Answer, tuple[int, int], float], Iterator[Instance]]
KINDS: Mapping[frozenset[str], Reader] = {
    frozenset({"boxes", "labels", "scores", "masks"}): boxed_instances,
    frozenset({"boxes", "labels", "masks"}): boxed_instances,
    frozenset({"predictions", "prototypes"}): prototype_instances,
}
"""How an answer is read, by what is declared of it."""


def _without_batch(values: np.ndarray, axes: int) -> np.ndarray:
    """Without the axis of images, of which there is one."""
    return values[0] if values.ndim == axes + 1 and len(values) == 1 else values


def _rising(scores: np.ndarray, minimum_score: float) -> list[int]:
    """Return the objects from the lowest score that counts to the highest."""
    order = np.argsort(scores, kind="stable")[-_MOST_OBJECTS:]
    rising: list[int] = order[scores[order] >= minimum_score].tolist()
    return rising


def _check_instances(boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray) -> None:
    """ModelError for numbers that are none, or labels that are no whole ones."""
    if not (np.abs(boxes) < _FARTHEST).all() or not np.isfinite(scores).all():
        raise ModelError(f"answers a box or score that is NaN, infinite or beyond {_FARTHEST:g}")
    whole = np.isfinite(labels) & (labels == np.floor(labels)) & (np.abs(labels) < 2**31)
    if not whole.all():
        raise ModelError(f"answers label {labels[~whole][0]}, which is no whole number")


def _check_masks(masks: np.ndarray) -> None:
    """ModelError for masks without cells, or with more than any image needs."""
    height, width = masks.shape[-2:]
    if len(masks) and not (0 < height <= _MOST_CELLS and 0 < width <= _MOST_CELLS):
        raise ModelError(f"answers masks of {width} x {height} cells; up to {_MOST_CELLS} are read")


def _box(row: np.ndarray) -> Box:
    left, top, right, bottom = row[:4].tolist()
    return left, top, right, bottom


def _cells(mask: np.ndarray) -> np.ndarray:
    """Values from 0 to 1 of a mask that may be of whole numbers, where all above 0 are 1.

    ModelError where one is NaN: it would pass for a pixel that is not the object's.
    """
    if not np.issubdtype(mask.dtype, np.floating):
        return mask > 0
    if np.isnan(mask).any():
        raise ModelError("answers a mask that holds NaN")
    return mask


def _misfit(answer: Answer, expected: str) -> str:
    shown = ", ".join(f"{name} {list(values.shape)}" for name, values in answer.items())
    return f"answers {shown}; expected {expected}"
