"""Evaluations in the database: what became of every object, and the average precision."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from curate.detections import Detections
from curate.evaluation.kitti_ap import KittiEvaluation
from curate.evaluation.kitti_outcomes import Outcomes, object_outcomes
from curate.evaluation.kitti_rules import DIFFICULTIES
from db import bulk
from pipelines.assessment.evaluation import ValObjects
from pipelines.workspace.workspace import Workspace

OVERLAP, DIFFICULTY = "3d", "hard"


def store_evaluation(
    workspace: Workspace,
    source: str,
    found: Mapping[str, Detections],
    objects: ValObjects,
    figures: KittiEvaluation,
) -> Mapping[str, int]:
    """Replaces what is stored of a source, and counts the objects by their outcome.

    Detections of every score take part, so an object is missed only where none of them finds it.

    Args:
        workspace: see `Workspace`.
        source: whose detections, as people will ask for it.
        found: detections of the val frames.
        objects: the same in KITTI's form, with the ground truth.
        figures: their evaluation.
    """
    keys = workspace.frames("val")
    of_objects, of_detections = object_outcomes(
        *objects,
        metric=OVERLAP,
        difficulty=DIFFICULTY,
        min_overlaps=figures.min_overlaps,
    )
    truth = [annotations.boxes for annotations in workspace.ground_truth("val").values()]
    guesses = [found[name].boxes for name in keys]
    frame_ids = list(keys.values())
    rows = {
        "evaluation_object": [
            *_outcome_rows(source, "object", of_objects, frame_ids, truth),
            *_outcome_rows(source, "detection", of_detections, frame_ids, guesses),
        ],
        "evaluation_ap": list(_ap_rows(source, figures)),
    }
    with workspace.database.writing() as connection:
        for name, new in rows.items():
            table = bulk.table(name)
            connection.execute(table.delete().where(table.c.source == source))
            bulk.insert(connection, name, new)
    names, counts = np.unique(of_objects.outcomes, return_counts=True)
    return dict(zip(names.tolist(), counts.tolist(), strict=True))


def _outcome_rows(
    source: str,
    side: str,
    outcomes: Outcomes,
    frame_ids: Sequence[int],
    boxes: Sequence[np.ndarray],
) -> Iterator[bulk.Row]:
    """Rows of `evaluation_object`; frame_ids and boxes by position of the frame."""
    columns = (
        *(outcomes.frames, outcomes.indices, outcomes.categories, outcomes.outcomes),
        *(outcomes.matches, outcomes.overlaps, outcomes.scores),
    )
    for frame, k, category, outcome, match, iou, score in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        yield (
            *(source, frame_ids[frame], side, k, category, outcome),
            *(None if match < 0 else match, iou, None if math.isnan(score) else score),
            *(OVERLAP, DIFFICULTY, *boxes[frame][k].tolist()),
        )


def _ap_rows(source: str, figures: KittiEvaluation) -> Iterator[bulk.Row]:
    """Rows of `evaluation_ap`."""
    plain = figures.as_dict()
    for category, by_figure in plain["AP_R40"].items():
        for figure, r40 in by_figure.items():
            r11 = plain["AP_R11"][category][figure]
            for d, difficulty in enumerate(DIFFICULTIES):
                averages = (None, None) if r40 is None else (r40[d], r11[d])
                objects = plain["objects"][category][d]
                yield (source, category, figure, difficulty, objects, *averages)
