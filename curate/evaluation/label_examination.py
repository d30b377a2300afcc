"""Checks of the ground truth of labeled frames, for `curate doctor`."""

from collections.abc import Sequence

import numpy as np

from curate.detections import Annotations
from curate.evaluation.box_conventions import BoxesInSweep
from curate.evaluation.examination import Finding, judge_convention
from curate.frames import Frame
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.projection import image_rectangles

# Share of boxes without points that is suspect. Labels of KITTI and of simulated frames have 1 in
# 70 or less.
_EMPTY_SHARE = 0.25
# 2D boxes of labels may exceed the image by rounding; smaller ones say little about the scale.
_BORDER_PIXELS, _MIN_HEIGHT_PIXELS = 2.0, 10.0
_MIN_RECTANGLES, _RECTANGLE_LIMIT = 3, 1.25


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
    ratios: list[float] = []
    for frame, truth in labeled:
        size = np.asarray(frame.image_size)
        reach = truth.boxes_2d[:, 2:].max(axis=0, initial=0)
        if (reach > size + _BORDER_PIXELS).any():
            message = (
                f"frame {frame.frame_id}: 2D boxes reach x {reach[0]:.0f}, y {reach[1]:.0f}, the "
                f"image is {size[0]} x {size[1]}: was it resized after it was labeled?"
            )
            return Finding("label image", "wrong", message)
        ratios += _height_ratios(frame, truth)
    if len(ratios) < _MIN_RECTANGLES:
        return Finding("label image", "ok", "2D boxes lie within the image")
    ratio = float(np.median(ratios))
    summary = f"2D boxes are {ratio:.2f} times as high as the projected 3D boxes (median)"
    if max(ratio, 1 / ratio) > _RECTANGLE_LIMIT:
        return Finding(
            "label image", "suspect", f"{summary}: do labels and calibration belong to this image?"
        )
    return Finding("label image", "ok", summary)


def _height_ratios(frame: Frame, truth: Annotations) -> list[float]:
    """Return height of the 2D box / height of the projected 3D box, of objects with both."""
    objects = truth.select(~np.isnan(truth.boxes).any(axis=1) & (truth.truncated <= 0))
    if len(np.unique(objects.boxes_2d, axis=0)) < len(objects):
        return []  # placeholders of a data set without 2D boxes
    rectangles = image_rectangles(objects.boxes, frame.calibration, frame.image_size)
    heights = np.nan_to_num(rectangles[:, 3] - rectangles[:, 1])
    labeled = objects.boxes_2d[:, 3] - objects.boxes_2d[:, 1]
    both = (heights > _MIN_HEIGHT_PIXELS) & (labeled > _MIN_HEIGHT_PIXELS)
    found: list[float] = (labeled[both] / heights[both]).tolist()
    return found
