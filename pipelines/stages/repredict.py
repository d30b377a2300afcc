"""repredict: l' = A^-1 f(A(x); w), and its disagreement with l, the loss L of Eqs. 4 to 11."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from curate.consistency import Consistency, consistency, mean_over_views
from curate.detections import Detections
from curate.detectors.base import CopiesDetector, RecordedViews
from curate.detectors.option_names import name_results_options
from curate.errors import CurateError, ModelError, WorkspaceError
from curate.evaluation.copy_examination import (
    CopiedFrame,
    examine_view,
)
from curate.frames import RotationY
from curate.geometry.similarity import Similarity
from curate.warnings_once import warn_once
from pipelines.assembly import Place, consistency_settings, copies_folder, runs_elsewhere
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.stage import RoundContext, Settings
from pipelines.stages.copies import augmented_views, copies_fingerprint
from pipelines.stages.labeled_copies import read_as
from pipelines.stages.predict import (
    Predict,
    detection_columns,
    for_each,
    raise_errors_of_detector,
)
from pipelines.workspace.workspace import Workspace

View = tuple[Similarity, Detections | CurateError]


class Repredict(Predict):
    """Predicts augmented copies of frames, and compares them with the frames' predictions."""

    def __init__(self, predict: Predict, seed: int) -> None:
        super().__init__(predict.config, predict.teacher, predict.place)
        self.seed = seed

    @property
    def batch_size(self) -> int:
        """How many frames have together as many copies as the detector gets at a time.

        A command gets one view at a time.
        """
        size = super().batch_size
        return size if runs_elsewhere(self.config) else max(1, size // self.config.repredict.views)

    def trial(self, jobs: Sequence[FrameJob]) -> list[FrameRows | CurateError]:
        """Return the rows of the first frames.

        Raises:
            CurateError: if the detector is wrong, all frames fail, or the results do not belong to
                the copies.
        """
        views = self.views([job.frame for job in jobs])
        rows = for_each(lambda each: self._compared(*each), zip(jobs, views, strict=True))
        raise_errors_of_detector(rows)
        if isinstance(self.detector, CopiesDetector):
            for view in range(self.config.repredict.views):
                self._check_copies(self.detector, jobs, views, view)
        return rows

    def batch(self, jobs: Sequence[FrameJob]) -> list[FrameRows | CurateError]:
        """Return the rows of `reprediction_view`, `reprediction` and `consistency`, by frame."""
        views = self.views([job.frame for job in jobs])
        return for_each(lambda each: self._compared(*each), zip(jobs, views, strict=True))

    def views(self, frame_ids: Sequence[str]) -> list[Sequence[View]]:
        """Return for each frame its similarities A, with what the detector finds in A(x)."""
        if isinstance(self.detector, RecordedViews):
            return [self.detector.views(frame_id) for frame_id in frame_ids]
        drawn = augmented_views(self.config, self.seed, self.place.round_number)
        if isinstance(self.detector, CopiesDetector):
            return self._views_elsewhere(
                self.detector, {each: drawn.draw(each) for each in frame_ids}
            )
        copies = [[*drawn.copies(self.read(frame_id))] for frame_id in frame_ids]
        found = iter(self.detect([copy for each in copies for _, copy in each]))
        return [[(a, next(found)) for a, _ in each] for each in copies]

    def _views_elsewhere(
        self, detector: CopiesDetector, drawn: Mapping[str, Sequence[Similarity]]
    ) -> list[Sequence[View]]:
        found = [
            detector.predict_copies({name: each[view] for name, each in drawn.items()}, view + 1)
            for view in range(self.config.repredict.views)
        ]
        return [
            list(zip(similarities, of_frame, strict=True))
            for similarities, of_frame in zip(drawn.values(), zip(*found, strict=True), strict=True)
        ]

    def _check_copies(
        self,
        detector: CopiesDetector,
        jobs: Sequence[FrameJob],
        views: Sequence[Sequence[View]],
        view: int,
    ) -> None:
        """Check that the results of a view belong to its copies.

        Raises:
            ModelError: if they do not, or their headings have another meaning.
        """

        def read(meaning: RotationY | None) -> list[CopiedFrame]:
            frames = []
            for job, found in zip(jobs, views, strict=True):
                similarity, copy = found[view]
                if isinstance(copy, CurateError) or job.predictions is None:
                    continue
                copy = self.checked(copy)
                if meaning is not None:
                    calibration = self.dataset.read(job.frame, points=False).calibration
                    copy = read_as(meaning, detector, calibration, similarity, copy)
                frames.append(CopiedFrame(job.predictions, copy, [a for a, _ in found]))
            return frames

        problem, remark = examine_view(view, read)
        if problem:
            problem = name_results_options(problem)
            raise ModelError(f"detector.options.command, view {view + 1}: {problem}")
        if remark:
            warn_once(f"detector.options.command, view {view + 1}: {remark}")

    def _compared(self, job: FrameJob, found: Sequence[View]) -> FrameRows:
        """Return the rows of a frame."""
        if job.predictions is None:
            raise WorkspaceError(f"frame {job.frame}: the job has no predictions")
        views = [(a, self._in_frame(a, each)) for a, each in found]
        settings = consistency_settings(self.config)
        losses = [consistency(job.predictions, each, settings) for _, each in views]
        return {
            "reprediction_view": {
                "view": list(range(len(views))),
                "flip_y": [int(a.flip_y) for a, _ in views],
                "rotation_rad": [a.rotation_rad for a, _ in views],
                "scale": [a.scale for a, _ in views],
            },
            "reprediction": _concatenate(
                [
                    _reprediction_columns(view, each, loss)
                    for view, ((_, each), loss) in enumerate(zip(views, losses, strict=True))
                ]
            ),
            "consistency": _consistency_columns(losses, len(job.predictions)),
        }

    def _in_frame(self, similarity: Similarity, found: Detections | CurateError) -> Detections:
        """Return the detections of an augmented copy in the frame's own frame of reference."""
        if isinstance(found, CurateError):
            raise found
        return self.checked(replace(found, boxes=similarity.invert_boxes(found.boxes)))


def settings(workspace: Workspace, context: RoundContext) -> Settings:
    """Return what repredictions depend on besides predictions and teacher."""
    section = workspace.config.repredict.model_dump(mode="json", exclude={"fuse"})
    folder = copies_folder(workspace.config, context.number, context.split)
    copies = {} if folder is None else {"copies": copies_fingerprint(folder)}
    return {**section, **copies, "seed": context.seed, "round": context.number}


def function(workspace: Workspace, context: RoundContext) -> Repredict:
    """Return what repredict does with a frame."""
    place = Place(workspace.root, context.number, copies=context.split)
    return Repredict(Predict(workspace.config, context.teacher.path, place), context.seed)


def _reprediction_columns(view: int, found: Detections, loss: Consistency) -> dict[str, list[Any]]:
    """Return the columns of one view's repredictions, with their matched predictions."""
    matched: list[int | None] = [None] * len(found)
    for k, i in enumerate(loss.matched.tolist()):
        if i >= 0:
            matched[i] = k
    of_match = {"iou": loss.iou, "score_loss": loss.score_loss, "box_loss": loss.box_loss}
    return {
        "view": [view] * len(found),
        **detection_columns(found),
        "matched_k": matched,
        **{
            name: [None if k is None else float(values[k]) for k in matched]
            for name, values in of_match.items()
        },
    }


def _concatenate(parts: Sequence[Mapping[str, list[Any]]]) -> dict[str, list[Any]]:
    """Return the concatenated columns of several views."""
    names = parts[0] if parts else ()
    return {name: [value for part in parts for value in part[name]] for name in names}


def _consistency_columns(losses: Sequence[Consistency], count: int) -> dict[str, list[Any]]:
    """Return the columns of `consistency`; without views, every loss is null (no evidence)."""
    loss: list[float | None] = [None] * count
    matched = [0] * count
    if losses:
        mean = mean_over_views(losses)
        loss = [None if np.isnan(each) else each for each in mean.loss.tolist()]
        matched = mean.views_matched.tolist()
    return {
        "k": list(range(count)),
        "loss": loss,
        "views": [len(losses)] * count,
        "matched_views": matched,
    }
