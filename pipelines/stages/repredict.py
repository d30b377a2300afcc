"""repredict: l' = A^-1 f(A(x); w), and how far it disagrees with l (the loss L of Eqs. 4 to 11)."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from curate.consistency import Consistency, consistency, mean_over_views
from curate.detections import Detections
from curate.detectors.base import RecordedViews
from curate.errors import WorkspaceError
from curate.geometry.similarity import Similarity
from pipelines.assembly import consistency_settings
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.stage import RoundContext, Settings
from pipelines.stages.predict import Predict, checked, prediction_rows, visible
from pipelines.workspace.config import RepredictSection
from pipelines.workspace.workspace import Workspace

View = tuple[Similarity, Detections]


class Repredict(Predict):
    """Answers again for augmented copies of a frame."""

    def __init__(self, predict: Predict, seed: int, round_number: int) -> None:
        super().__init__(predict.config, predict.teacher)
        self.seed = seed
        self.round_number = round_number

    def __call__(self, job: FrameJob) -> FrameRows:
        """The rows of `reprediction_view`, `reprediction` and `consistency`."""
        if job.predictions is None:
            raise WorkspaceError(f"frame {job.frame} came without its predictions")
        views = self.views(job.frame)
        settings = consistency_settings(self.config)
        losses = [consistency(job.predictions, found, settings) for _, found in views]
        return {
            "reprediction_view": [
                (v, int(a.flip_y), a.rotation_rad, a.scale) for v, (a, _) in enumerate(views)
            ],
            "reprediction": [
                (v, *row)
                for v, ((_, found), loss) in enumerate(zip(views, losses, strict=True))
                for row in _reprediction_rows(found, loss)
            ],
            "consistency": _consistency_rows(losses, len(job.predictions)),
        }

    def views(self, frame_id: str) -> list[View]:
        """Each A with the detections mapped back into the frame."""
        if isinstance(self.detector, RecordedViews):
            answers = list(self.detector.views(frame_id))
        else:
            frame = visible(self.dataset.read(frame_id), self.config)
            drawn = draw(self.seed, self.round_number, frame_id, self.config.repredict)
            answers = [
                (a, self.detector.predict(frame.with_points(a.apply_to_points(frame.points))))
                for a in drawn
            ]
        return [
            (a, checked(replace(found, boxes=a.invert_boxes(found.boxes)), self.config))
            for a, found in answers
        ]


def draw(
    seed: int, round_number: int, frame_id: str, section: RepredictSection
) -> list[Similarity]:
    """The similarities of a frame; they depend on seed, round and frame alone."""
    digest = hashlib.sha256(frame_id.encode()).digest()
    generator = np.random.default_rng([seed, round_number, *digest])
    return [
        Similarity.draw(
            generator,
            flip_probability=section.flip_probability,
            rotation_limit_rad=section.rotation_limit_rad,
            scale_range=section.scale_range,
        )
        for _ in range(section.views)
    ]


def settings(workspace: Workspace, context: RoundContext) -> Settings:
    """What repredictions depend on beside predictions and teacher."""
    section = workspace.config.repredict.model_dump(mode="json")
    return {**section, "seed": context.seed, "round": context.number}


def function(workspace: Workspace, context: RoundContext) -> Repredict:
    """What repredict does with a frame."""
    predict = Predict(workspace.config, context.teacher.path)
    return Repredict(predict, context.seed, context.number)


def _reprediction_rows(found: Detections, loss: Consistency) -> list[tuple[Any, ...]]:
    """The rows of one view, each with what matched it."""
    matched = {int(i): k for k, i in enumerate(loss.matched) if i >= 0}
    rows: list[tuple[Any, ...]] = []
    for i, (category, score, *box) in enumerate(prediction_rows(found)):
        k = matched.get(i)
        match: tuple[Any, ...] = (None,) * 4
        if k is not None:
            match = (k, *(float(of[k]) for of in (loss.iou, loss.score_loss, loss.box_loss)))
        rows.append((i, category, score, *match, *box))
    return rows


def _consistency_rows(losses: Sequence[Consistency], count: int) -> list[tuple[Any, ...]]:
    """A row per label; without any view each says that there is no evidence."""
    if not losses:
        return [(k, None, 0, 0) for k in range(count)]
    mean = mean_over_views(losses)
    return [
        (k, None if np.isnan(loss) else float(loss), len(losses), int(matched))
        for k, (loss, matched) in enumerate(zip(mean.loss, mean.views_matched, strict=True))
    ]
