"""A stored calibration, without the ground truth that it would be fitted to."""

import numpy as np

from curate.calibration.model import Calibration, fit_calibration
from db import bulk
from pipelines.workspace.workspace import Workspace
from support.simulated_evidence import CATEGORIES, SIZES, random_evidence, true_probability


def simulated_fit() -> Calibration:
    """Return a fit to simulated labels."""
    evidence = random_evidence(400)
    correct = np.random.default_rng(0).random(400) < true_probability(evidence)
    return fit_calibration(
        evidence, correct, np.arange(400) % 20, categories=CATEGORIES, sizes=SIZES
    )


def store_calibration(
    workspace: Workspace, fit: Calibration | None, fallback: str | None = None, number: int = 1
) -> None:
    """Store the calibration of a round, as the stage calibrate does."""
    row = {
        "round": number, "source": "calibration", "folds": 0, "overlap": "bev",
        "thresholds": "kitti", "teacher": "", "frames": 20, "labels": 400, "neutral": 0,
        "right_labels": 100, "fit": fit.as_json() if fit else None, "fallback": fallback,
        "unit": "frame", "held_out_frames": 0,
    }  # fmt: skip
    table = bulk.table("calibration")
    with workspace.database.writing() as connection:
        connection.execute(table.delete().where(table.c.round == number))
        bulk.insert_rows(connection, "calibration", [row])


def store_held_out(
    workspace: Workspace, labels: list[tuple[int, int, float, int | None]], number: int = 1
) -> None:
    """Store held-out labels: frame key, k, probability, and 1 if correct, 0 if wrong, or None."""
    names = {key: name for name, key in workspace.frames("val").items()}
    rows = [
        {
            "round": number, "frame_id": frame, "k": k, "probability": p, "correct": correct,
            "unit": names[frame],
        }
        for frame, k, p, correct in labels
    ]  # fmt: skip
    # The predictions that these labels refer to are not needed.
    with workspace.database.writing(keys_known=True) as connection:
        bulk.insert_rows(connection, "calibration_label", rows)
