"""Evaluate a detector on the val split, which is never trained on."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from curate.datasets.kitti.labels import KittiObjects, from_annotations, from_detections
from curate.detections import Detections
from curate.errors import FramesFailed, WorkspaceError
from curate.geometry.projection import box_rectangles
from pipelines.engine.executors.base import FrameJob
from pipelines.engine.plan import Plan
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import stored_round
from pipelines.engine.runner import open_executor
from pipelines.round import graph_of
from pipelines.stages.predict import Predict, as_detections
from pipelines.workspace.workspace import Workspace

ValObjects = tuple[list[KittiObjects], list[KittiObjects]]
"""Ground truth and detections of the val frames, frame by frame."""


def detect_val(workspace: Workspace, path: Path, progress: Progress) -> dict[str, Detections]:
    """Return the detections of a checkpoint in the val frames, by frame name.

    Raises:
        FramesFailed: if the detector failed on some frames.
    """
    frames = workspace.frames("val")
    predict = Predict(workspace.config, path)
    jobs = [FrameJob(key, name) for name, key in frames.items()]
    found: dict[str, Detections] = {}
    with progress.track("evaluate", len(jobs)) as advance, open_executor(workspace) as executor:
        for outcome in executor.map(predict, jobs):
            if outcome.error is not None:
                raise FramesFailed(f"val {outcome.job.title}: {outcome.error}")
            for frame, rows in zip(outcome.job.frames, outcome.rows, strict=True):
                found[frame.frame] = as_detections(rows["prediction"])
            advance(1, "")
    return found


def stored_val(workspace: Workspace, round_number: int) -> dict[str, Detections]:
    """Return the stored detections of a round's teacher in the val frames, by frame name.

    `curate predict --split val` stores them.

    Raises:
        WorkspaceError: if the round has no teacher, or lacks predictions for some val frames.
    """
    keys = workspace.frames("val")
    context = stored_round(workspace, round_number)
    if context is None:
        raise WorkspaceError(f"round {round_number} has no teacher yet; run `curate run`")
    plan = Plan(workspace, context, graph_of(workspace))
    states = plan.counts(plan.graph.frames_stage("predict"), "val")
    missing = states.waiting + states.failed
    if missing:
        raise WorkspaceError(
            f"round {round_number} has no predictions for {missing} of {len(keys)} val frames; "
            f"run `curate predict --split val --round {round_number}`"
        )
    stored = workspace.predictions(round_number, list(keys.values()))
    return {name: stored[key] for name, key in keys.items()}


def val_objects(workspace: Workspace, found: Mapping[str, Detections]) -> ValObjects:
    """Return ground truth and detections of the val frames as KITTI objects, sorted by frame name.

    Raises:
        WorkspaceError: if there are no val frames.
    """
    truth = workspace.ground_truth("val")
    if not truth:
        raise WorkspaceError("no val frames; set some aside with `curate init --val`")
    labels: list[KittiObjects] = []
    results: list[KittiObjects] = []
    for name, annotations in truth.items():
        frame = workspace.dataset.read(name, points=False)
        labels.append(from_annotations(annotations, frame.calibration))
        objects = from_detections(found[name], frame.calibration, frame.image_size)
        rectangles = box_rectangles(found[name].boxes, frame)
        results.append(replace(objects, boxes_2d=np.where(np.isnan(rectangles), -1.0, rectangles)))
    return labels, results
