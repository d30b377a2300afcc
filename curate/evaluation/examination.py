"""Checks of a frame's data and of a detector's boxes, for `curate doctor`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.detections import Detections
from curate.evaluation.box_conventions import BoxesInSweep, suspect_convention
from curate.frames import Frame
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.projection import box_rectangles, in_camera_view

_TOP_BOXES = 20
# Share of boxes without points that is suspect.
_EMPTY_SHARE = 0.5
# Share of boxes outside the image above which they are reported: some are cut by its border.
_OUTSIDE_LIMIT = 0.1
# A sweep without a point of at least this intensity was divided by too large a scale.
_DARK = 0.02
_MISPLACED = (
    "lie beside the points: the model has hardly been trained, or for another LiDAR, mounting "
    "height or range of intensities"
)


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        check: name of the check.
        state: "ok", "suspect" (may be correct) or "wrong".
        message: one line.
    """

    check: str
    state: str
    message: str


def examine_frame(frame: Frame) -> list[Finding]:
    """Check the points, the calibration and the image of a frame.

    Args:
        frame: a frame with all its points.
    """
    count = len(frame.points)
    if count == 0:
        return [Finding("points", "wrong", "the sweep has no points")]
    low, high = frame.points[:, :3].min(axis=0), frame.points[:, :3].max(axis=0)
    ranges = ", ".join(
        f"{axis} {a:.1f}..{b:.1f}" for axis, a, b in zip("xyz", low, high, strict=True)
    )
    tall = np.ptp(frame.points[:, 2]) > max(np.ptp(frame.points[:, 0]), np.ptp(frame.points[:, 1]))
    seen = float(in_camera_view(frame).mean())
    return [
        Finding("points", "ok", f"{count} points, {ranges} m")
        if not tall
        else Finding("points", "suspect", f"higher than wide ({ranges} m): is z up?"),
        _intensity(float(frame.points[:, 3].max())),
        Finding("camera", "ok", "none: nothing is compared with images")
        if not frame.cameras
        else Finding("calibration", "ok", f"{seen:.0%} of the points appear in the image")
        if seen > 0.02
        else Finding(
            "calibration", "wrong", f"{seen:.1%} of the points appear in the image: is x forward, "
            "and does the calibration belong to these sensors?",
        ),
    ]  # fmt: skip


def _intensity(highest: float) -> Finding:
    """Judge the highest intensity of a sweep."""
    if highest == 0:
        return Finding(
            "intensity", "suspect", "all 0; the files may have none, or in another column"
        )
    if highest < _DARK:
        return Finding(
            "intensity", "suspect", f"up to {highest:.2g} of 1; dataset.intensity_scale may be "
            "larger than the value of full intensity in the files",
        )  # fmt: skip
    if highest > 1:
        return Finding(
            "intensity", "suspect", f"up to {highest:.2f}: expected in [0, 1]; set "
            "dataset.intensity_scale to the value of full intensity in the files",
        )  # fmt: skip
    return Finding("intensity", "ok", f"up to {highest:.2f}")


def examine_detections(
    frame: Frame,
    found: Detections,
    categories: Sequence[str],
    others: Sequence[tuple[Frame, Detections]] = (),
    *,
    trainable: bool = False,
) -> list[Finding]:
    """Check the output of a detector.

    Args:
        frame: the frame with the points that the detector was given.
        found: the complete output, before it is filtered by category and score.
        categories: the configured categories of the workspace.
        others: more frames with their outputs, for the check of the convention: on a straight
            street, many boxes look the same if their yaw is negated.
        trainable: whether curate trains such a detector: then its convention is curate's, and boxes
            beside the points have another cause.
    """
    if len(found) == 0:
        return [Finding("detections", "suspect", "the detector finds nothing in this frame")]
    low, high = found.scores.min(), found.scores.max()
    return [
        Finding("detections", "ok", f"{len(found)} boxes, scores {low:.2f} to {high:.2f}"),
        _names(found, categories),
        _points(frame, found, trainable=trainable),
        *([_projections(frame, found)] if frame.cameras else []),
        _convention([(frame, found), *others], trainable=trainable),
    ]


def _names(found: Detections, categories: Sequence[str]) -> Finding:
    names, counts = np.unique(found.categories, return_counts=True)
    summary = ", ".join(f"{name} {n}" for name, n in zip(names, counts.tolist(), strict=True))
    unknown = sorted(set(names.tolist()) - set(categories))
    if len(unknown) == len(names):
        expected = ", ".join(categories)
        return Finding("names", "wrong", f"{summary}: none is in dataset.categories ({expected})")
    if unknown:
        return Finding("names", "suspect", f"{summary}: {', '.join(unknown)} will be dropped")
    return Finding("names", "ok", summary)


def _points(frame: Frame, found: Detections, *, trainable: bool) -> Finding:
    empty = int(np.sum(count_points_in_boxes(frame.points, found.boxes) == 0))
    summary = f"{empty} of {len(found)} boxes contain no points"
    if empty == len(found):
        cause = f"they {_MISPLACED}" if trainable else "they are not in the LiDAR frame"
        return Finding("boxes", "wrong", f"{summary}: {cause}")
    return Finding("boxes", "suspect" if empty > len(found) / 2 else "ok", summary)


def _projections(frame: Frame, found: Detections) -> Finding:
    rectangles = box_rectangles(found.boxes, frame)
    outside = int(np.isnan(rectangles).any(axis=1).sum())
    summary = f"{outside} of {len(found)} boxes project outside the image"
    if outside == len(found):
        return Finding("image", "wrong", summary)
    if outside > _OUTSIDE_LIMIT * len(found):
        evidence = "no image evidence can confirm or refute them (semantic.outside)"
        return Finding("image", "suspect", f"{summary}: {evidence}")
    return Finding("image", "ok", summary)


def _convention(outputs: Sequence[tuple[Frame, Detections]], *, trainable: bool) -> Finding:
    sweeps = []
    for frame, found in outputs:
        top = found.select(np.argsort(-found.scores, kind="stable")[:_TOP_BOXES])
        sweeps.append(BoxesInSweep(frame.points, top.boxes, top.categories, frame.calibration))
    count = sum(len(each.boxes) for each in sweeps)
    frames = f" of {len(sweeps)} frames" if len(sweeps) > 1 else ""
    where = f"the {count} boxes with the highest scores{frames}"
    if trainable and suspect_convention(sweeps, labels=False).mistake:
        return Finding("placement", "suspect", f"{where} {_MISPLACED}")
    return judge_convention("convention", sweeps, where, labels=False)


def judge_convention(
    check: str, sweeps: Sequence[BoxesInSweep], where: str, *, labels: bool
) -> Finding:
    """Return the finding on the convention of boxes.

    Args:
        check: name of the check.
        sweeps: the boxes.
        where: describes the boxes, for the message.
        labels: whether they are labels, not boxes of a detector.
    """
    found = suspect_convention(sweeps, labels=labels)
    summary = f"{found.inside} points in {where}"
    if found.mistake:
        state = "wrong" if found.certain else "suspect"
        return Finding(check, state, f"{summary}; {found.mistake}")
    if found.undecided:
        state = "ok" if labels else "suspect"
        return Finding(check, state, f"{summary}: too few to decide; try another frame")
    return Finding(check, "ok", f"{summary}; no other convention explains them better")
