"""Turned copies of labeled frames, in which a command shows how its headings are meant.

If the camera looks along x, all meanings of rotation_y agree in the frames themselves, but not in
copies that are turned. They are compared with the labels before any prediction is stored.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from curate.datasets.base import Dataset
from curate.detections import Annotations, Detections
from curate.detectors.base import CopiesDetector
from curate.detectors.option_names import name_results_options
from curate.errors import CurateError
from curate.evaluation.copy_examination import (
    CopiedFrame,
    describe_few_matches,
    examine_copies,
    examine_rotation_y,
)
from curate.evaluation.examination import Finding
from curate.evaluation.heading_examination import examine_headings
from curate.frames import Calibration, RotationY
from curate.geometry.augmented_views import augmented_calibration
from curate.geometry.mounting import rotations_y_of_yaws, yaws_of_rotations_y
from curate.geometry.similarity import Similarity
from pipelines.workspace.config import Config
from pipelines.workspace.splits import WITH_TRUTH
from pipelines.workspace.workspace import Workspace, read_truth

TURNED = Similarity(flip_y=True, rotation_rad=0.4, scale=1.03)
"""A of the copies."""

_FRAMES = 12


def labeled_frames(workspace: Workspace) -> tuple[str, ...]:
    """Return the names of some labeled frames, spread over all of them."""
    names = tuple(workspace.frames(*WITH_TRUTH))
    return names[:: max(1, len(names) // _FRAMES)][:_FRAMES]


def examine_labeled_copies(
    config: Config, dataset: Dataset, detector: CopiesDetector, found: Mapping[str, Detections]
) -> tuple[str, Sequence[Finding]]:
    """Return what is wrong with the results of turned labeled frames, and the other findings.

    Args:
        config: the configuration.
        dataset: the data set.
        detector: the detector.
        found: its detections in the copies by `TURNED`, by frame.
    """
    truth = {}
    for name in found:
        with suppress(CurateError):  # its labels were checked at init, and are not needed here
            truth[name] = read_truth(config, dataset, name)

    def copied(name: str, meaning: RotationY | None) -> CopiedFrame:
        plain, copy = _as_detections(config, truth[name]), found[name]
        if meaning is None:
            return CopiedFrame(plain, copy, [TURNED])
        calibration = dataset.read(name, points=False).calibration
        other = read_as(meaning, detector, calibration, TURNED, copy)
        return CopiedFrame(plain, other, [TURNED])

    def read(meaning: RotationY | None) -> list[CopiedFrame]:
        return [copied(name, meaning) for name in truth]

    frames = read(None)
    problem = examine_copies(0, frames) or examine_rotation_y(0, frames, read)
    findings = examine_headings(
        [
            (replace(found[name], boxes=TURNED.invert_boxes(found[name].boxes)), labels)
            for name, labels in truth.items()
        ]
    )
    if remark := describe_few_matches(0, frames):
        findings = [Finding("headings", "suspect", remark)]
    return name_results_options(problem), findings


def read_as(
    meaning: RotationY,
    detector: CopiesDetector,
    calibration: Calibration,
    similarity: Similarity,
    found: Detections,
) -> Detections:
    """Return the detections of a copy with rotation_y of their file in another meaning.

    Args:
        meaning: the meaning.
        detector: the detector, which has read them in a meaning of its own.
        calibration: calibration of the frame.
        similarity: A of the copy.
        found: the detections.
    """
    copied = augmented_calibration(calibration, similarity)
    boxes = found.boxes.copy()
    own = detector.rotation_y_of_copies(calibration)
    rotations_y = rotations_y_of_yaws(boxes[:, 6], copied, own)
    boxes[:, 6] = yaws_of_rotations_y(rotations_y, copied, meaning)
    return replace(found, boxes=boxes)


def _as_detections(config: Config, truth: Annotations) -> Detections:
    """Return the objects of the configured categories as detections of score 1."""
    counts = np.isin(truth.categories, config.dataset.categories)
    objects = truth.select(counts & ~np.isnan(truth.boxes).any(axis=1))
    return Detections(objects.boxes, np.ones(len(objects)), objects.categories)
