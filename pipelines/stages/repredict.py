"""repredict: l' = A^-1 f(A(x); w), and its disagreement with l, the loss L of Eqs. 4 to 11."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from curate.consistency import Consistency, consistency, mean_over_views
from curate.detections import Detections
from curate.detectors.base import RecordedViews
from curate.errors import WorkspaceError
from curate.geometry.similarity import Similarity
from pipelines.assembly import consistency_settings, copies_folder
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.stage import RoundContext, Settings
from pipelines.stages.copies import augmented_views, copies_fingerprint
from pipelines.stages.predict import Predict, checked, detection_columns, visible
from pipelines.workspace.workspace import Workspace

View = tuple[Similarity, Detections]


class Repredict(Predict):
    """Predicts augmented copies of a frame, and compares them with the frame's predictions."""

    def __init__(self, predict: Predict, seed: int, round_number: int) -> None:
        super().__init__(predict.config, predict.teacher, round_number)
        self.seed = seed
        self.round_number = round_number

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the rows of `reprediction_view`, `reprediction` and `consistency`."""
        if job.predictions is None:
            raise WorkspaceError(f"frame {job.frame}: the job has no predictions")
        views = self.views(job.frame)
        settings = consistency_settings(self.config)
        losses = [consistency(job.predictions, found, settings) for _, found in views]
        return {
            "reprediction_view": {
                "view": list(range(len(views))),
                "flip_y": [int(a.flip_y) for a, _ in views],
                "rotation_rad": [a.rotation_rad for a, _ in views],
                "scale": [a.scale for a, _ in views],
            },
            "reprediction": _concatenate(
                [
                    _reprediction_columns(view, found, loss)
                    for view, ((_, found), loss) in enumerate(zip(views, losses, strict=True))
                ]
            ),
            "consistency": _consistency_columns(losses, len(job.predictions)),
        }

    def views(self, frame_id: str) -> list[View]:
        """Return each similarity A with its detections, mapped back to the frame by A^-1."""
        if isinstance(self.detector, RecordedViews):
            views = list(self.detector.views(frame_id))
        else:
            frame = visible(self.dataset.read(frame_id), self.config)
            copies = augmented_views(self.config, self.seed, self.round_number).copies(frame)
            views = [(a, self.detector.predict(copy)) for a, copy in copies]
        return [(a, self._checked(a, found)) for a, found in views]

    def _checked(self, similarity: Similarity, found: Detections) -> Detections:
        """Return the detections of an augmented copy in the frame's own frame of reference."""
        boxes = similarity.invert_boxes(found.boxes)
        return checked(replace(found, boxes=boxes), self.config, self.detector)


def settings(workspace: Workspace, context: RoundContext) -> Settings:
    """Return what repredictions depend on besides predictions and teacher."""
    section = workspace.config.repredict.model_dump(mode="json")
    folder = copies_folder(workspace.config, context.number)
    copies = {} if folder is None else {"copies": copies_fingerprint(folder)}
    return {**section, **copies, "seed": context.seed, "round": context.number}


def function(workspace: Workspace, context: RoundContext) -> Repredict:
    """Return what repredict does with a frame."""
    predict = Predict(workspace.config, context.teacher.path)
    return Repredict(predict, context.seed, context.number)


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
