"""Do recorded results belong to the augmented copies for which they are given?

Boxes found in the copy A(x), mapped back by A^-1, lie where those of x lie, whatever the detector
missed. Over many frames, results of other clouds match better under another transform:

| best match | what happened |
|---|---|
| by A^-1 of this view | nothing, the results belong to the copies |
| as they are | the detector ran on x, or the boxes were mapped back already |
| by A^-1 of another view | results of another view |

Files in KITTI's form are in the frame of a camera that turns with the cloud. Those of x, read by
the calibration of a copy, are therefore turned like the copy, but neither flipped nor scaled; those
of another view are turned like this copy, but flipped and scaled like the other one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from curate.consistency import match
from curate.detections import Detections
from curate.frames import RotationY
from curate.geometry.similarity import Similarity, wrap_angle

# So many boxes of the frames must match in some way before anything is concluded.
_LEAST_MATCHES = 20
# Another transform must match so many times as many boxes.
_MARGIN = 1.3
_MINIMUM_IOU = 0.3
# Even a weak detector finds more of its boxes again.
_FEW = 0.2
# Headings of one object agree to a few degrees, apart from half turns. Copies are turned by up to
# a quarter of pi and more, and results read in a wrong meaning of rotation_y by the same angle.
_MEANINGS: tuple[RotationY, ...] = ("openpcdet", "calibration", "nuscenes")
_WRONG_HEADING_RAD, _GOOD_HEADING_RAD = np.deg2rad(8), np.deg2rad(5)


@dataclass(frozen=True)
class CopiedFrame:
    """The detections of a frame and of one of its copies.

    Attributes:
        plain: detections of the frame x.
        copy: detections of the copy, in its frame of reference.
        similarities: A of every view of the frame.
    """

    plain: Detections
    copy: Detections
    similarities: Sequence[Similarity]


def examine_view(
    view: int, read_as: Callable[[RotationY | None], Sequence[CopiedFrame]]
) -> tuple[str, str]:
    """Return what is wrong with the results of a view, and what may be; "" for nothing.

    Args:
        view: number of the view, from 0.
        read_as: returns some frames with results read in a meaning of rotation_y; None for the
            configured one.
    """
    frames = read_as(None)
    problem = examine_copies(view, frames) or examine_rotation_y(view, frames, read_as)
    return problem, describe_few_matches(view, frames) or describe_headings(view, frames)


def examine_copies(view: int, frames: Sequence[CopiedFrame]) -> str:
    """Return what is wrong with the results of a view; "" if nothing is.

    Args:
        view: number of the view, from 0.
        frames: some frames.
    """
    if not frames:
        return ""
    own = _matches(frames, [frame.similarities[view] for frame in frames])
    others = {
        other: _matches_of_others(view, frames, [each.similarities[other] for each in frames])
        for other in range(len(frames[0].similarities))
        if other != view
    }
    untouched = _matches_of_others(view, frames, [Similarity()] * len(frames))
    total = sum(len(frame.plain) for frame in frames)
    best = max(untouched, *others.values()) if others else untouched
    if best < _LEAST_MATCHES or best <= _MARGIN * own:
        return ""
    if best == untouched:
        return (
            f"{untouched} of {total} boxes lie where those of the original frames lie, but only "
            f"{own} do after A^-1: these are results of the original frames, or their boxes were "
            "mapped back already; run the detector on the copies, and leave its boxes as they are"
        )
    other = max(others, key=lambda each: others[each])
    return (
        f"these are results of view-{other + 1}: {best} of {total} boxes match its copies, {own} "
        f"those of view-{view + 1}"
    )


def _matches_of_others(
    view: int, frames: Sequence[CopiedFrame], similarities: Sequence[Similarity]
) -> int:
    """Return how many boxes match if the results are those of other clouds; see the module."""
    turned = [
        Similarity(each.flip_y, frame.similarities[view].rotation_rad, each.scale)
        for frame, each in zip(frames, similarities, strict=True)
    ]
    return max(_matches(frames, similarities), _matches(frames, turned))


def examine_rotation_y(
    view: int,
    frames: Sequence[CopiedFrame],
    read_as: Callable[[RotationY], Sequence[CopiedFrame]],
) -> str:
    """Return which meaning of rotation_y fits a view if the one it was read in does not.

    Args:
        view: number of the view, from 0.
        frames: some frames.
        read_as: returns the same frames with results read in another meaning of rotation_y.
    """
    errors = _heading_errors(view, frames)
    if len(errors) < _LEAST_MATCHES or np.median(errors) < _WRONG_HEADING_RAD:
        return ""
    for meaning in _MEANINGS:
        others = _heading_errors(view, read_as(meaning))
        if len(others) and np.median(others) < _GOOD_HEADING_RAD:
            return (
                f"headings differ by {np.rad2deg(np.median(errors)):.0f} degrees (median) from "
                f'those of the original frames, but not if rotation_y is read as "{meaning}"; set '
                f'detector.options.rotation_y = "{meaning}"'
            )
    return ""


def describe_headings(view: int, frames: Sequence[CopiedFrame]) -> str:
    """Return a warning if the headings of a view do not turn with the copies; "" otherwise."""
    errors = _heading_errors(view, frames)
    if len(errors) < _LEAST_MATCHES or np.median(errors) < _WRONG_HEADING_RAD:
        return ""
    return (
        f"headings differ by {np.rad2deg(np.median(errors)):.0f} degrees (median) from those of "
        "the original frames; were the boxes turned back in part?"
    )


def describe_few_matches(view: int, frames: Sequence[CopiedFrame]) -> str:
    """Return a warning if a view has no boxes, or hardly one matches; "" otherwise."""
    total = sum(len(frame.plain) for frame in frames)
    if total >= _LEAST_MATCHES and not any(len(frame.copy) for frame in frames):
        return (
            f"no boxes in {len(frames)} copies, but {total} in their frames; does the detector "
            "read the copies?"
        )
    own = _matches(frames, [frame.similarities[view] for frame in frames])
    possible = sum(min(len(frame.plain), len(frame.copy)) for frame in frames)
    if possible < _LEAST_MATCHES or own >= _FEW * possible:
        return ""
    return (
        f"only {own} of {possible} boxes match those of the original frames; are the files named "
        "by the frames, not by their position?"
    )


def _matches(frames: Sequence[CopiedFrame], similarities: Sequence[Similarity]) -> int:
    """Return how many boxes of x match boxes of the copies that are mapped back by A^-1."""
    pairs = zip(frames, similarities, strict=True)
    return sum(int((_matched(frame, similarity) >= 0).sum()) for frame, similarity in pairs)


def _matched(frame: CopiedFrame, similarity: Similarity) -> np.ndarray:
    """Return (n,) the box of the copy that matches each box of x, -1 for none."""
    back = replace(frame.copy, boxes=similarity.invert_boxes(frame.copy.boxes))
    return match(frame.plain, back, _MINIMUM_IOU)[0]


def _heading_errors(view: int, frames: Sequence[CopiedFrame]) -> np.ndarray:
    """Return the differences of matched headings apart from half turns, of longish boxes."""
    found = [np.zeros(0)]
    for frame in frames:
        similarity = frame.similarities[view]
        matched = _matched(frame, similarity)
        rows = np.flatnonzero(matched >= 0)
        boxes = similarity.invert_boxes(frame.copy.boxes)[matched[rows]]
        plain = frame.plain.boxes[rows]
        is_long = plain[:, 3] > 1.3 * plain[:, 4]
        difference = wrap_angle(2 * (boxes[:, 6] - plain[:, 6])) / 2
        found.append(np.abs(difference)[is_long])
    return np.concatenate(found)
