"""Checks of the ground truth of labeled frames, for `curate doctor`."""

from collections.abc import Sequence

import numpy as np

from curate.detections import Annotations
from curate.evaluation.box_conventions import BoxesInSweep
from curate.evaluation.examination import Finding, judge_convention
from curate.evaluation.missing_boxes import describe_placeholder
from curate.frames import Frame
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.projection import image_rectangles

# Share of boxes without points that is suspect. Labels of KITTI and of simulated frames have 1 in
# 70 or less.
_EMPTY_SHARE = 0.25
# 2D boxes of labels may exceed the image by rounding; smaller ones say little about the scale.
_BORDER_PIXELS, _MIN_HEIGHT_PIXELS = 2.0, 10.0
_MIN_RECTANGLES, _RECTANGLE_LIMIT = 3, 1.25
# Of 2D boxes and projected 3D boxes; KITTI's labels have a median above 0.8.
_OVERLAP_LIMIT = 0.5


def examine_labels(labeled: Sequence[tuple[Frame, Annotations]]) -> list[Finding]:
    """Check the ground truth of some frames together.

    Args:
        labeled: frames with all their points, and their ground truth.
    """
    sweeps = []
    for frame, truth in labeled:
        objects = truth.select(~np.isnan(truth.boxes).any(axis=1))
        sweeps.append(
            BoxesInSweep(frame.points, objects.boxes, objects.categories, frame.calibration)
        )
    count = sum(len(each.boxes) for each in sweeps)
    names = f"{len(labeled)} frames" if len(labeled) > 1 else f"frame {labeled[0][0].frame_id}"
    where = f"the {count} labeled boxes of {names}"
    # With several cameras, 2D boxes are projections.
    pictured = [(frame, truth) for frame, truth in labeled if len(frame.cameras) == 1]
    if count == 0:
        return [Finding("labels", "ok", f"no labeled objects in {names}")]
    return [
        _label_points(sweeps, count, names),
        judge_convention("label boxes", sweeps, where, labels=True),
        *([_label_rectangles(pictured)] if pictured else []),
    ]


def _label_points(sweeps: Sequence[BoxesInSweep], count: int, names: str) -> Finding:
    empty = sum(int(np.sum(count_points_in_boxes(each.points, each.boxes) == 0)) for each in sweeps)
    summary = f"{empty} of {count} labeled boxes contain no points ({names})"
    if empty == count:
        return Finding("labels", "wrong", f"{summary}: do labels and calibration belong together?")
    suspect = empty > max(1, _EMPTY_SHARE * count)
    return Finding("labels", "suspect" if suspect else "ok", summary)


def _label_rectangles(labeled: Sequence[tuple[Frame, Annotations]]) -> Finding:
    """Compare the 2D boxes of labels with the image and with the projected 3D boxes."""
    drawn = np.concatenate([truth.boxes_2d[_has_rectangle(truth)] for _, truth in labeled])
    if not len(drawn):
        return Finding("label image", "ok", "no 2D boxes; the projected 3D boxes replace them")
    placeholder = describe_placeholder(drawn)
    if placeholder:
        return Finding("label image", "suspect", placeholder)
    beyond = next(filter(None, (_beyond_image(*each) for each in labeled)), None)
    return beyond or _compare_rectangles([_rectangle_pairs(*each) for each in labeled])


def _beyond_image(frame: Frame, truth: Annotations) -> Finding | None:
    """Return the finding if 2D boxes reach beyond the image."""
    size = np.asarray(frame.image_size)
    reach = truth.boxes_2d[:, 2:].max(axis=0, initial=0)
    if not (reach > size + _BORDER_PIXELS).any():
        return None
    message = (
        f"frame {frame.frame_id}: 2D boxes reach x {reach[0]:.0f}, y {reach[1]:.0f}, the "
        f"image is {size[0]} x {size[1]}: was it resized after it was labeled?"
    )
    return Finding("label image", "wrong", message)


def _compare_rectangles(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Finding:
    """Compare the sizes and places of 2D boxes and of projected 3D boxes, frame by frame."""
    drawn, projected = (np.concatenate(side) for side in zip(*pairs, strict=True))
    if len(drawn) < _MIN_RECTANGLES:
        return Finding("label image", "ok", "2D boxes lie within the image")
    ratio = float(np.median(_heights(drawn) / _heights(projected)))
    overlap = float(np.median(_ious(drawn, projected)))
    summary = f"2D boxes are {ratio:.2f} times as high as the projected 3D boxes (median)"
    if max(ratio, 1 / ratio) <= _RECTANGLE_LIMIT:
        if overlap >= _OVERLAP_LIMIT:
            return Finding("label image", "ok", summary)
        summary = f"{summary}, but their IoU is only {overlap:.2f}"
    doubt = "do labels and calibration belong to this image?"
    return Finding("label image", "suspect", f"{summary}: {doubt}")


def _rectangle_pairs(frame: Frame, truth: Annotations) -> tuple[np.ndarray, np.ndarray]:
    """Return 2D boxes and projected 3D boxes, both (n, 4), of objects with both, not truncated."""
    objects = truth.select(~np.isnan(truth.boxes).any(axis=1) & (truth.truncated <= 0))
    projected = np.nan_to_num(image_rectangles(objects.boxes, frame.calibration, frame.image_size))
    drawn = objects.boxes_2d
    both = (_heights(projected) > _MIN_HEIGHT_PIXELS) & (_heights(drawn) > _MIN_HEIGHT_PIXELS)
    return drawn[both], projected[both]


def _has_rectangle(truth: Annotations) -> np.ndarray:
    """Return (n,) bool, True for objects with a 3D box and a 2D box that has a height."""
    found: np.ndarray = ~np.isnan(truth.boxes).any(axis=1) & (_heights(truth.boxes_2d) > 0)
    return found


def _ious(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return (n,) IoU of the 2D boxes in the same row."""
    low = np.maximum(first[:, :2], second[:, :2])
    high = np.minimum(first[:, 2:], second[:, 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=1)
    areas = [np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) for boxes in (first, second)]
    found: np.ndarray = shared / np.maximum(areas[0] + areas[1] - shared, 1e-9)
    return found


def _heights(boxes_2d: np.ndarray) -> np.ndarray:
    found: np.ndarray = boxes_2d[:, 3] - boxes_2d[:, 1]
    return found
