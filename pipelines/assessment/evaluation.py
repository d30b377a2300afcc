"""Evaluate a detector on the val split, which is never trained on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from curate.category_names import listed
from curate.datasets.kitti.labels import (
    DONT_CARE,
    KittiObjects,
    from_annotations,
    from_detections,
)
from curate.detections import Annotations, Detections
from curate.errors import FramesFailed, WorkspaceError
from curate.evaluation.difficulties import Difficulty, open_difficulty
from curate.evaluation.kitti_ap import UNKNOWN_ALPHA, KittiEvaluation, evaluate
from curate.evaluation.kitti_matching import objects_in_lidar_frame
from curate.evaluation.missing_boxes import (
    ProjectedBoxes,
    describe_placeholder,
    with_projected_boxes,
    without_box,
)
from curate.frames import Frame
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.projection import box_rectangles
from pipelines.assembly import Place
from pipelines.engine.executors.base import FrameJob
from pipelines.engine.mapping import map_frames
from pipelines.engine.plan import Plan
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import choose_round, stored_round
from pipelines.engine.runner import open_executor
from pipelines.labels.matching import configured_overlaps
from pipelines.round import graph_of
from pipelines.stages.predict import Predict, as_detections
from pipelines.workspace.workspace import Workspace


@dataclass(frozen=True)
class ValObjects:
    """Ground truth and detections of the val frames, frame by frame, and the rules for them.

    Attributes:
        labels: the ground truth objects of each frame.
        results: the detections of each frame.
        difficulty: the levels of difficulty.
        overlaps: the IoU threshold of each category.
        points: the LiDAR points in each object of each frame; None if they are not needed.
        notes: what differs from KITTI's evaluation, one sentence each.
    """

    labels: list[KittiObjects]
    results: list[KittiObjects]
    difficulty: Difficulty
    overlaps: Mapping[str, float]
    points: list[np.ndarray] | None = None
    notes: tuple[str, ...] = ()

    def evaluate(
        self,
        overlaps: Mapping[str, float] | None = None,
        recall_overlaps: Sequence[float] = (0.3, 0.5, 0.7),
    ) -> KittiEvaluation:
        """Return the evaluation, by default at the configured IoU thresholds."""
        return evaluate(
            self.labels,
            self.results,
            min_overlaps=self.overlaps if overlaps is None else overlaps,
            recall_overlaps=recall_overlaps,
            difficulty=self.difficulty,
            points=self.points,
        )


def detect_val(
    workspace: Workspace, path: Path | None, progress: Progress
) -> dict[str, Detections]:
    """Return the detections of a checkpoint in the val frames, by frame name.

    Raises:
        FramesFailed: if the detector failed on some frames.
    """
    frames = workspace.frames("val")
    number, _ = choose_round(workspace, None, None)
    predict = Predict(workspace.config, path, Place(workspace.root, number))
    jobs = [FrameJob(key, name) for name, key in frames.items()]
    found: dict[str, Detections] = {}
    with progress.track("evaluate", len(jobs)) as advance, open_executor(workspace) as executor:
        for outcome in map_frames(executor, predict, jobs, len(jobs)):
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
            + ("; `curate status --failed` shows why frames failed" if states.failed else "")
        )
    stored = workspace.predictions(round_number, list(keys.values()))
    return {name: stored[key] for name, key in keys.items()}


def val_objects(workspace: Workspace, found: Mapping[str, Detections]) -> ValObjects:
    """Return ground truth and detections of the val frames, sorted by frame name.

    With KITTI's levels, ground truth without 2D boxes gets the projected 3D boxes. If a frame has
    no image, the levels by distance replace KITTI's, because they need no 2D boxes.

    Raises:
        WorkspaceError: if there are no val frames.
    """
    truth = workspace.ground_truth("val")
    if not truth:
        raise WorkspaceError("no val frames; set some aside with `curate init --val`")
    section = workspace.config.evaluation
    kind, notes = section.difficulty, []
    frames = {name: workspace.dataset.read(name, points=False) for name in truth}
    without_image = [name for name, frame in frames.items() if frame.image_size is None]
    if kind == "kitti" and without_image:
        kind = "distance"
        notes.append(
            f"{len(without_image)} of {len(frames)} frames have no image, and KITTI's levels need "
            "one: evaluated by distance instead (evaluation.difficulty)"
        )
    difficulty = open_difficulty(kind, section.minimum_points, section.distance_limits)
    overlaps = configured_overlaps(workspace.config)
    if difficulty.in_image:
        labels, results, projected = _in_camera_frame(frames, truth, found)
        notes += [*projection_notes(projected, (0, 0)), *placeholder_notes(labels, ())]
        return ValObjects(labels, results, difficulty, overlaps, None, tuple(notes))
    points = None
    if difficulty.kind == "points":
        points = [
            count_points_in_boxes(workspace.dataset.read(name).points, annotations.boxes)
            for name, annotations in truth.items()
        ]
    labels = [objects_in_lidar_frame(each.boxes, each.categories) for each in truth.values()]
    results = [
        objects_in_lidar_frame(found[name].boxes, found[name].categories, found[name].scores)
        for name in truth
    ]
    return ValObjects(labels, results, difficulty, overlaps, points, tuple(notes))


def kitti_objects(annotations: Annotations, frame: Frame) -> ProjectedBoxes:
    """Return ground truth as KITTI objects; missing 2D boxes are the projected 3D boxes."""
    objects = from_annotations(annotations, frame.calibration)
    return with_projected_boxes(objects, frame.calibration.projection, frame.image_size)


def projection_notes(labels: tuple[int, int], results: tuple[int, int]) -> list[str]:
    """Return a sentence if missing 2D boxes were replaced by projected 3D boxes.

    Args:
        labels: the number of objects without a 2D box, and of those that have one now.
        results: the same for the detections.
    """
    if not labels[1] + results[1]:
        return []
    sides = ((labels, "objects"), (results, "results"))
    parts = [
        f"{projected} of {missing} {side} without one"
        for (missing, projected), side in sides
        if missing
    ]
    return [f"2D boxes from the projected 3D boxes: {' and '.join(parts)}"]


def placeholder_notes(labels: Sequence[KittiObjects], results: Sequence[KittiObjects]) -> list[str]:
    """Return a sentence for each side that has the same 2D box for all objects."""
    found = []
    for side, frames in (("objects", labels), ("results", results)):
        boxes = [
            each.boxes_2d[(each.categories != DONT_CARE) & ~without_box(each)] for each in frames
        ]
        if boxes and (problem := describe_placeholder(np.concatenate(boxes))):
            found.append(f"{side}: {problem}")
    return found


def orientation_notes(results: Sequence[KittiObjects], difficulty: Difficulty) -> list[str]:
    """Return a sentence if results without an observation angle prevent aos."""
    unknown = [np.flatnonzero(frame.alpha == UNKNOWN_ALPHA) for frame in results]
    count = sum(map(len, unknown))
    if not count or not difficulty.in_image:
        return []
    names = {
        str(frame.categories[i]) for frame, rows in zip(results, unknown, strict=True) for i in rows
    }
    total = sum(map(len, results))
    shown = listed(sorted(names))
    return [f"aos is not computed: {count} of {total} results have alpha -10, unknown ({shown})"]


def _in_camera_frame(
    frames: Mapping[str, Frame],
    truth: Mapping[str, Annotations],
    found: Mapping[str, Detections],
) -> tuple[list[KittiObjects], list[KittiObjects], tuple[int, int]]:
    """Return ground truth, detections, and the numbers of missing and of projected 2D boxes."""
    sides: list[ProjectedBoxes] = []
    results: list[KittiObjects] = []
    for name, annotations in truth.items():
        frame = frames[name]
        sides.append(kitti_objects(annotations, frame))
        objects = from_detections(found[name], frame.calibration, frame.image_size)
        rectangles = box_rectangles(found[name].boxes, frame)
        results.append(replace(objects, boxes_2d=np.where(np.isnan(rectangles), -1.0, rectangles)))
    totals = sum(each.missing for each in sides), sum(each.projected for each in sides)
    return [each.objects for each in sides], results, totals
